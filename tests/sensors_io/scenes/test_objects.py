"""Procedural objects: labels follow the thresholds, materials inform without deciding, skins move rigidly."""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors_io.scenes import objects, properties, surface
from sensors_io.schema import MATERIALS, UNKNOWN

ALL = {**properties.PROPERTIES, **properties.DYNAMIC}
OLD = (7, 7, 1, 6.169470845, 0.106939634, 0.349118311, 2.499351735, 4.172926426)
"""Material, apparent material, pattern, modulus, rms, height, turn and last phase of the first object ever drawn."""

GAP = jax.jit(surface.gap)

KINDS = ((1, "part"), (2, "graded"))
SUMS = (698.749806, 758.587112, 921.512811)
"""Sums of all numbers of that object, of the second if it has a part, and of the third if it is graded."""


def _numbers(made) -> Iterator[np.ndarray]:
    for value in vars(made).values():
        if dataclasses.is_dataclass(value):
            yield from _numbers(value)
        elif value is not None and np.asarray(value).dtype.kind in "fiu":
            yield np.asarray(value)


def _sample(count: int, lie_share: float = 0.3) -> list[objects.Solid]:
    return [objects.sample(np.random.default_rng(i), lie_share, 0.8) for i in range(count)]


@pytest.fixture(scope="module")
def solids() -> list[objects.Solid]:
    """Enough for statistics."""
    return _sample(3000)


@pytest.mark.parametrize("name", ALL)
@given(latent=st.floats(-6, 6))
def test_level_follows_the_thresholds(name: str, latent: float) -> None:
    prop = ALL[name]
    value = prop.value(latent)
    assert prop.extremes[0] <= value <= prop.extremes[1]
    assert prop.level(value) == sum(value >= t for t in prop.thresholds)
    for threshold in prop.thresholds:
        assert abs(np.log(value / threshold)) >= 0.999 * np.log(prop.gap) / 2  # no value lies in the gap


@pytest.mark.parametrize("name", ALL)
def test_values_grow_with_the_latent_on_both_sides_of_each_threshold(name: str) -> None:
    prop = ALL[name]
    values = np.array([prop.value(x) for x in np.linspace(-3, 3, 400)])
    assert np.all(np.diff(values) > 0)
    for threshold in prop.thresholds:
        near = np.log(values / threshold)
        assert np.any((near > 0) & (near < 0.25))
        assert np.any((near < 0) & (near > -0.25))


@pytest.mark.parametrize("name", ALL)
def test_material_informs_but_does_not_decide(name: str) -> None:
    odds = properties.level_odds(ALL[name])
    np.testing.assert_allclose(odds.sum(1), 1)
    assert 0.50 <= odds.max(1).mean() <= 0.58  # what a guesser gets that knows the material alone
    assert np.all((odds.mean(0) > 0.28) & (odds.mean(0) < 0.38))
    assert odds.min() > 0.005  # the ranges of all materials overlap


@pytest.mark.long
def test_frequencies_follow_the_odds(solids: list[objects.Solid]) -> None:
    for name, prop in ALL.items():
        levels = np.array([s.levels()[name] for s in solids])
        np.testing.assert_allclose(np.bincount(levels) / 3000, properties.level_odds(prop).mean(0), atol=0.035)


def test_truth_explains_the_labels(solids: list[objects.Solid]) -> None:
    explained = {
        "hardness": ("modulus_mpa", properties.HARDNESS_MPA),
        "roughness": ("rms_mm", properties.ROUGHNESS_MM),
        "protrusion": ("feature_height_mm", properties.PROTRUSION_MM),
    }
    for solid in solids[:50]:
        levels = {name: sum(solid.truth()[of] >= t for t in limits) for name, (of, limits) in explained.items()}
        assert solid.labels() == levels | {"material": solid.material}


def test_lies_are_told_at_their_rate_and_contradict(solids: list[objects.Solid]) -> None:
    lies = [s for s in solids if s.looks_like != s.material]
    assert len(lies) / 3000 == pytest.approx(0.3, abs=0.04)
    for solid in lies:
        own, shown = objects.typical_levels(solid.material), objects.typical_levels(solid.looks_like)
        assert sum(a != b for a, b in zip(own, shown, strict=True)) >= 2
    assert all(objects.lie_materials(m) for m in range(len(MATERIALS)))
    assert not [s for s in _sample(200, 0.0) if s.looks_like != s.material]


def test_roughness_has_the_rms_and_the_band_asked_for() -> None:
    k, a, phase = objects.rough_waves(np.random.default_rng(0), 0.05, 0.8)
    wavelength = 2 * np.pi / np.linalg.norm(k, axis=1)
    assert wavelength.min() > 0.799
    assert wavelength.max() < 4.001
    x = np.linspace(0, 200, 400)
    z = np.sum(a[:, None] * np.cos(k[:, :1] * x + k[:, 1:] * 0.7 * x + phase[:, None]), 0)
    assert z.std() == pytest.approx(0.05, rel=0.15)
    assert np.sqrt(np.sum(a**2) / 2) == pytest.approx(0.05, rel=1e-5)


@settings(max_examples=15, deadline=None)
@given(dx=st.integers(-8, 8), dy=st.integers(-8, 8), seed=st.integers(0, 50))
def test_skins_move_rigidly(dx: int, dy: int, seed: int) -> None:
    spacing, n = 0.25, 48
    skin = surface.make_skin(objects.sample(np.random.default_rng(seed), 0.3, 0.8), np.array([1.0, -2.0]), 1.0)
    x = (jnp.arange(n) + 0.5) * spacing - n * spacing / 2

    offsets = ((0.0, 0.0), (dx * spacing, dy * spacing))
    here, there = (np.asarray(GAP(skin, _pose(0.4, offset), x)) for offset in offsets)
    rows, columns = slice(max(0, -dy), n - max(0, dy)), slice(max(0, -dx), n - max(0, dx))
    moved = there[max(0, dy) : n + min(0, dy), max(0, dx) : n + min(0, dx)]
    difference = moved - here[rows, columns]
    np.testing.assert_allclose(difference, difference.mean(), atol=2e-4)
    assert there.min() == 0


def _pose(turn: float = 0.0, offset: tuple[float, float] = (0.0, 0.0)) -> surface.SensorPose:
    return surface.SensorPose(offset_mm=jnp.array(offset), turn_rad=jnp.array(turn), tilt=jnp.zeros(2))


def test_roughness_and_relief_show_in_the_gap() -> None:
    x = (jnp.arange(64) + 0.5) * 0.25 - 8.0
    for seed in range(5):
        solid = objects.sample(np.random.default_rng(seed), 0.0, 0.8)
        skin = surface.make_skin(solid, np.zeros(2), 1.0)
        smooth = skin.replace(wave_amplitudes_mm=jnp.zeros_like(skin.wave_amplitudes_mm))
        bare = smooth.replace(feature_height_mm=jnp.array(0.0))
        rough, even, flat = (np.asarray(GAP(s, _pose(), x)) for s in (skin, smooth, bare))
        assert (rough - even).std() == pytest.approx(solid.rms_mm, rel=0.35)
        assert np.ptp(flat - even) == pytest.approx(solid.feature_height_mm, rel=0.2)


def test_an_object_of_old_is_the_same_today() -> None:
    solid = objects.sample(np.random.default_rng(0), 0.3, 0.8)
    assert (solid.material, solid.looks_like, solid.pattern) == OLD[:3]
    numbers = (solid.modulus_mpa, solid.rms_mm, solid.feature_height_mm, solid.turn_rad, solid.wave_phases_rad[-1])
    np.testing.assert_allclose(numbers, OLD[3:], rtol=1e-6)
    varied = (objects.sample(np.random.default_rng(n), 0.3, 0.8, **{f"{kind}_share": 1.0}) for n, kind in KINDS)
    sums = [sum(np.sum(x) for x in _numbers(solid)) for solid in (solid, *varied)]
    np.testing.assert_allclose(sums, SUMS, rtol=1e-6)


def test_a_part_has_its_own_values_and_the_object_no_common_label() -> None:
    solids = [objects.sample(np.random.default_rng(i), 0.0, 0.8, part_share=1.0) for i in range(60)]
    differing = 0
    for solid in solids:
        v = solid.variation
        assert v is not None
        along = np.array([np.cos(v.direction_rad), np.sin(v.direction_rad)])
        near, far = (solid.at(along * (v.offset_mm + side)) for side in (-3, 3))
        assert near.modulus_mpa == pytest.approx(solid.modulus_mpa, rel=1e-3)
        assert far.modulus_mpa == pytest.approx(v.modulus_mpa, rel=1e-3)
        same = near.labels()["hardness"] == far.labels()["hardness"]
        assert solid.labels()["hardness"] == (near.labels()["hardness"] if same else UNKNOWN)
        differing += not same
    assert 10 < differing < 50


def test_a_graded_object_changes_geometrically_and_steadily() -> None:
    solid = objects.sample(np.random.default_rng(2), 0.0, 0.8, graded_share=1.0)
    v = solid.variation
    assert v is not None
    along = np.array([np.cos(v.direction_rad), np.sin(v.direction_rad)])
    values = [solid.at(along * (v.offset_mm + s)).rms_mm for s in np.linspace(-40, 40, 33)]
    assert values[16] == pytest.approx(np.sqrt(solid.rms_mm * v.rms_mm))
    assert np.all(np.diff(values) > 0) or np.all(np.diff(values) < 0)


@pytest.mark.parametrize("shares", [(-0.1, 0.0), (0.6, 0.6)])
def test_shares_that_are_none_are_refused(shares: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="part_share, graded_share are"):
        objects.sample(np.random.default_rng(0), 0.3, 0.8, *shares)


def test_what_came_later_leaves_the_rest_as_it_was() -> None:
    """The same object, whatever the shares of objects that vary, and the same generator afterwards."""
    rngs = [np.random.default_rng(4) for _ in range(2)]
    plain, varied = objects.sample(rngs[0], 0.3, 0.8), objects.sample(rngs[1], 0.3, 0.8, part_share=1.0)
    for field in dataclasses.fields(objects.Solid):
        if field.name != "variation":
            np.testing.assert_array_equal(getattr(plain, field.name), getattr(varied, field.name))
    assert plain.variation is None
    assert varied.variation is not None
    assert rngs[0].random() == rngs[1].random()


def test_the_skin_over_a_seam_is_that_of_each_side() -> None:
    solid = objects.sample(np.random.default_rng(9), 0.0, 0.8, part_share=1.0)
    v = solid.variation
    assert v is not None
    direction = np.array([np.cos(v.direction_rad), np.sin(v.direction_rad)])
    site = direction * v.offset_mm
    x = (jnp.arange(96) + 0.5) * 0.25 - 12.0
    parts = (solid, solid.at(-99 * direction), solid.at(99 * direction))
    both, near, far = (np.asarray(GAP(surface.make_skin(s, site, 0.0), _pose(), x)) for s in parts)
    x_n = np.asarray(x)
    along = x_n[None] * np.cos(v.direction_rad) + x_n[:, None] * np.sin(v.direction_rad)
    for side, alone in ((along < -2, near), (along > 2, far)):
        difference = (both - alone)[side]
        np.testing.assert_allclose(difference, difference.mean(), atol=1e-3)
