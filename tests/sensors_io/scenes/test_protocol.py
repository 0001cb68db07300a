"""The generated data set: valid, deterministic, resumable, honest about itself, and worth learning from."""

import dataclasses
import itertools

import numpy as np
import pytest

from sensors_io.scenes import press as press_module
from sensors_io.scenes import readout
from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig, config_hash
from sensors_io.scenes.draws import site_of
from sensors_io.scenes.protocol import contacts, make_contact
from sensors_io.scenes.sensors import MODELS
from sensors_io.schema import SENSORS, UNKNOWN, Flag, Sequence
from tests.sensors_io.checks import refused

SMALL = SceneConfig(objects=60, sites=2, frames=3, image_px=24, contact_grid=24, view_px=32, min_force_n=1.0)


def one_per_object(objects: int) -> list[list[Sequence]]:
    """The first contact of each of the first objects of the small set."""
    return [make_contact(SMALL, object_index * SMALL.sites) for object_index in range(objects)]


@pytest.fixture(scope="module")
def some() -> list[list[Sequence]]:
    """Enough for statistics."""
    return one_per_object(SMALL.objects)


def _arrays(sequence: Sequence) -> dict[str, np.ndarray]:
    return {k: v for k, v in vars(sequence).items() if isinstance(v, np.ndarray)}


def _assert_same(a: list[Sequence], b: list[Sequence]) -> None:
    for left, right in zip(a, b, strict=True):
        assert left.key == right.key
        assert _arrays(left).keys() == _arrays(right).keys()
        for name, array in _arrays(left).items():
            np.testing.assert_array_equal(array, _arrays(right)[name], err_msg=name)


@pytest.mark.long
def test_generation_resumes_anywhere_with_the_same_values(some: list[list[Sequence]]) -> None:
    whole = list(itertools.islice(contacts(SMALL), 5))
    tail = list(itertools.islice(contacts(SMALL, start=2), 3))
    for a, b in zip(whole[2:], tail, strict=True):
        _assert_same(a, b)
    for index in (0, 2, 4):
        _assert_same(whole[index], some[index // 2])


@pytest.mark.long
def test_generation_ends_and_refuses_a_start_outside() -> None:
    assert len(list(contacts(SMALL, start=SMALL.contact_count - 2))) == 2
    assert list(contacts(SMALL, start=SMALL.contact_count)) == []
    refused(ValueError, r"start is 121: must lie in \[0, 120\]", contacts, SMALL, start=121)


@pytest.mark.long
def test_each_contact_holds_the_four_sensors_in_order() -> None:
    for contact in one_per_object(5):
        assert tuple(s.sensor for s in contact) == SENSORS
        assert [s.sensor for s in contact if s.frames is None] == ["tac3d"]
        assert [s.sensor for s in contact if s.mm_per_px is None] == ["tac3d"]
        assert [s.sensor for s in contact if s.shear_mm is None] == ["gelsight_mini"]
        for sequence in contact:
            assert sequence.depth_mm.shape == (SMALL.frame_count, 20, 20)
            x, y, width, height = sequence.contact_region_px
            assert 0 <= x < x + width <= SMALL.view_px
            assert 0 <= y < y + height <= SMALL.view_px


@pytest.mark.long
def test_measured_force_presses_down_with_the_stated_error(some: list[list[Sequence]]) -> None:
    force = np.array([[s.force_n for s in contact] for contact in some])
    target = np.array([[s.target_force_n for s in contact] for contact in some])
    assert np.all(force[..., 2] < 0)
    relative = -force[..., 2] / target - 1
    assert relative[..., -1].std() == pytest.approx(np.hypot(SMALL.force_jitter, SMALL.force_gain_error), rel=0.25)
    assert abs(relative.mean()) < 0.01
    np.testing.assert_allclose(target[0, 0], np.geomspace(1, 20, 3), rtol=1e-6)


@pytest.mark.long
def test_fields_carry_noise_and_markers_spread(some: list[list[Sequence]]) -> None:
    x = np.linspace(-1, 1, 20)
    for order in (1, 2, 3):
        model = MODELS[order]
        shear = np.concatenate([c[order].shear_mm[c[order].valid] for c in some])
        assert shear.std() == pytest.approx(model.lateral_noise_mm, rel=0.05)
        spread = [np.mean(c[order].deformation_mm[-1, ..., 0] * x) for c in some]
        assert np.mean(np.array(spread) > 0) > 0.95  # an almost incompressible layer flows outwards
    lost = np.mean([~s.valid for c in some for s in c])
    assert lost == pytest.approx(readout.LOST_NODE_SHARE, rel=0.3)


@pytest.mark.long
def test_flags_say_what_happened(some: list[list[Sequence]]) -> None:
    flags = np.array([[s.flags for s in c] for c in some])
    assert not np.any(flags & Flag.NOT_CONVERGED)
    strain = (flags & Flag.STRAIN_LIMIT) > 0
    border = (flags & Flag.BORDER_CONTACT) > 0
    for flag in (strain, border):
        share = flag.mean((0, 1))
        assert share[0] < share[-1]
    deepest = np.array([[s.depth_mm.max((1, 2)) for s in c] for c in some])
    limit = 0.3 * np.array([m.gel.thickness_mm for m in MODELS])[:, None]
    assert np.all(strain[deepest > 1.35 * limit])
    assert not np.any(strain[deepest < 0.6 * limit])


def test_labels_of_the_cards_match_the_truth() -> None:
    cards = object_cards(SMALL)
    assert [c.object_id for c in cards] == [f"g{i:06d}" for i in range(SMALL.objects)]
    for card in cards:
        assert card.labels["hardness"] == (card.truth["modulus_mpa"] >= 0.5) + (card.truth["modulus_mpa"] >= 5.0)
        assert (card.view.shape, card.annotator) == ((32, 32, 3), "generator")
    assert np.mean([c.visual_lies for c in cards]) == pytest.approx(SMALL.visual_lie_share, abs=0.12)


def test_splits_are_exact_and_follow_the_seed() -> None:
    first, again, other = ([c.split for c in object_cards(dataclasses.replace(SMALL, seed=s))] for s in (0, 0, 1))
    assert [first.count(s) for s in ("train", "val", "test")] == [42, 6, 12]
    assert first == again != other


def test_the_hash_tells_configs_apart_and_later_fields_leave_it_as_it_was() -> None:
    """The default's hash is that of the records which were made before there were such fields."""
    early = ({"seed": 1}, {"image_px": 64}, {"split_shares": (0.6, 0.2, 0.2)}, {"solver_tolerance": 1e-4})
    later = ({"past_limit": "flag"}, {"coupled": True}, {"part_share": 0.5}, {"graded_share": 0.5})
    hashes = {config_hash(dataclasses.replace(SMALL, **change)) for change in ({}, *early, *later)}
    assert len(hashes) == 9
    assert config_hash(SceneConfig()) == "4b723b89e461cd0c"


def test_bad_configs_are_refused_by_name() -> None:
    """The last value that is taken, and the first ones that are not."""
    edges: dict[str, tuple] = {
        "objects": (1, 0), "sites": (1, 0), "frames": (1, 0), "contact_grid": (24, 22, 25), "image_px": (16, 15),
        "view_px": (16, 15), "error": (1.0, 0.0, 1.01), "visual_lie_share": (1.0, -0.01, 1.01),
        "min_force_n": (20.0, 0.0, 20.1), "force_jitter": (0.1, -0.01, 0.11), "force_gain_error": (1.0, -0.01, 1.01),
        "force_noise_n": (0.0, -0.01, 1e15), "ramp_s": (0.01, 0.0, 1e-20, 1e15), "max_force_n": (1e4, 1e15),
        "adhesion_j_per_m2": (0.0, -1.0),
        "adhesion_tolerance": (0.01, 0.0), "part_share": (1.0, -0.01), "graded_share": (1.0, -0.01, 1.01),
        "split_shares": ((0.0, 0.5, 0.5), (0.5, 0.2, 0.2), (-0.2, 0.6, 0.6)), "solver_tolerance": (0.99, 0.0, 1.0),
        "solver_max_iterations": (1, 0), "seed": (0, -1),
    }  # fmt: skip
    for name, (edge, *wrong) in edges.items():
        assert getattr(dataclasses.replace(SMALL, **{name: edge}), name) == edge
        for value in wrong:
            refused(ValueError, f"{name} is .*must", dataclasses.replace, SMALL, **{name: value})
    refused(ValueError, "graded_share is .*must", SceneConfig, part_share=0.5, graded_share=0.6)
    assert SMALL.contact_count == 120


def test_padding_is_two_thicknesses_and_smooth() -> None:
    """2, 3 and 5 are its only primes, so that it divides a power of 30."""
    for model in MODELS:
        size = press_module.padded_size(64, model.window_mm, model.gel.thickness_mm)
        assert (size - 64) * model.window_mm / 64 >= 2 * model.gel.thickness_mm
        assert size <= 110
        assert 30**7 % size == 0


def _leave_one_out(features: np.ndarray, labels: np.ndarray) -> float:
    """Accuracy of linear discriminants with pooled covariance, each object judged by all others."""
    hits = 0
    for i in range(len(labels)):
        rest = np.arange(len(labels)) != i
        x, y = features[rest], labels[rest]
        means = np.array([x[y == k].mean(0) for k in range(3)])
        within = np.cov((x - means[y]).T) + 1e-4 * np.eye(x.shape[1])
        apart = features[i] - means
        hits += int(np.argmin(np.einsum("kd,de,ke->k", apart, np.linalg.inv(within), apart)) == labels[i])
    return hits / len(labels)


@pytest.mark.long
def test_touch_tells_hardness_and_force_alone_does_not(some: list[list[Sequence]]) -> None:
    labels = np.array([c.labels["hardness"] for c in object_cards(SMALL)])
    force = np.array([c[2].force_n[:, 2] for c in some])
    depth = np.array([np.maximum(c[2].depth_mm, 1e-3) for c in some])
    touch = np.concatenate([np.log(depth.max((2, 3))), np.log(depth.mean((2, 3)))], 1)
    assert _leave_one_out(touch, labels) > 0.58
    assert _leave_one_out(force, labels) < 0.46


def test_objects_may_vary_and_their_sites_do_not() -> None:
    varied = dataclasses.replace(SMALL, objects=40, part_share=0.5, graded_share=0.5)
    cards = object_cards(varied)
    assert all("far_modulus_mpa" in (card.truth or {}) for card in cards)
    assert any(UNKNOWN in card.labels.values() for card in cards)
    site = site_of(varied, 0, 0, 0)
    assert site.solid.variation is None
    with pytest.raises(ValueError, match=r"graded_share is 0\.6: must be ≤ 1 − part_share = 0\.5"):
        dataclasses.replace(varied, graded_share=0.6)
