"""The chooser: what it promises, that it keeps it, and what it refuses."""

import dataclasses
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io import layer
from sensors_io.layer import Layer
from sensors_io.scenes import chooser, chooser_law, contact, nested
from sensors_io.scenes.batching import CHUNK, chunks, gather, map_live
from sensors_io.scenes.chooser_law import LAW, LOOK, MENU, SLACK, Setting
from sensors_io.scenes.chooser_survey import FEATURES, survey
from sensors_io.scenes.sensors import BODY, TAC3D
from tests.sensors_io.checks import refused
from tests.sensors_io.scenes.references import off

WINDOW_MM, GEL = TAC3D.window_mm, TAC3D.gel
STAGE = chooser.ContactScene(gel=GEL, body=BODY, window_mm=WINDOW_MM)

surveyed = jax.jit(survey, static_argnums=(4, 5))  # as the chooser calls it; each operation alone compiles for long
log_error, pick = jax.jit(chooser_law.log_error, static_argnums=2), jax.jit(chooser_law.pick)
resample, refine = jax.jit(nested.resample, static_argnums=1), jax.jit(nested.refine)


def _ball(grid: int) -> jnp.ndarray:
    x = (np.arange(grid) + 0.5) * WINDOW_MM / grid - WINDOW_MM / 2
    return jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / 16, jnp.float32)


def _bumps(grid: int) -> jnp.ndarray:
    x = (np.arange(grid) + 0.5) * WINDOW_MM / grid - WINDOW_MM / 2
    ripple = np.cos(2 * np.pi * x / 2.5)
    return jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / 40 + 0.15 * ripple[None] * ripple[:, None], jnp.float32)


def _choose(
    error: float, gap: chooser.Gap = _ball, force_n: float = 2.0, body: Layer | None = None
) -> chooser.ContactSettings:
    return chooser.choose(error, gap, force_n, GEL, body, WINDOW_MM)


def _setting(choice: chooser.ContactSettings) -> Setting:
    return Setting(grid=choice.grid, padded=choice.padded, tolerance=choice.tolerance)


def _spectrum(padded: int, grid: int) -> jnp.ndarray:
    q = np.hypot(*layer.wave_numbers(padded, WINDOW_MM / grid))
    return jnp.asarray(layer.normal_compliance(q, GEL), jnp.float32)


def _survey(gap, force_n: float = 2.0):
    soft = _spectrum(LOOK.padded, LOOK.grid)
    found = contact.solve(gap(LOOK.grid), force_n, soft, 0 * soft, WINDOW_MM / LOOK.grid, LOOK.tolerance)
    gaps = tuple(gap(n) for n in chooser.LOOK_GRIDS)
    one = jnp.float32(1.0)
    return surveyed(found.pressure_mpa, found.displacement_mm, gaps, one, WINDOW_MM, GEL.thickness_mm)


def test_law_and_menu_are_those_that_were_fitted() -> None:
    """By `pareto_chooser`; fitted anew, they have other checksums."""
    law = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(LAW)])
    assert (zlib.crc32(law.tobytes()), zlib.crc32(repr(MENU).encode())) == (3328676224, 3141607366)


def test_errors_add_in_quadrature() -> None:
    """By hand: with all coefficients 0 each of the three parts is e⁰ = 1."""
    law = jax.tree.map(np.zeros_like, LAW)
    found = log_error(_survey(_ball), law, MENU)
    np.testing.assert_allclose(found, np.full(len(MENU), np.log(3) / 2), rtol=1e-6)


def test_each_part_follows_its_formula() -> None:
    """The two others are e⁻⁵⁰, nothing compared with it."""
    seen, menu, first = _survey(_ball), MENU[:5], np.eye(len(FEATURES))[0]
    silent = dataclasses.replace(
        jax.tree.map(np.zeros_like, LAW), grid=-50 * first, stop=np.append(-50 * first, [0, 0]), wrap=-50 * np.eye(5)[0]
    )
    x = np.log(np.array([s.grid for s in menu]) / 48)
    clearance = [(WINDOW_MM * s.padded / s.grid - 2 * float(seen.radius_mm)) / GEL.thickness_mm for s in menu]
    for part, wanted in (
        ({"grid": 0 * first, "rate": -first, "bend": 0.5 * first}, -x + x**2 / 2),
        ({"stop": np.append(0 * first, [0, 1.0])}, np.log([s.tolerance for s in menu])),
        ({"wrap": np.array([0.0, 1.0, 0.0, 0.0, 0.0])}, clearance),
    ):
        found = log_error(seen, dataclasses.replace(silent, **part), menu)
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("expected", "index", "promised", "met"),
    [
        ([0.2, 0.09, 0.05], 1, 1.5 * 0.09, True),
        ([0.3, 0.11, 0.12], 1, 0.165, True),  # doubtful: 1.2 × .11 is within .15, 1.5 × .11 is not
        ([0.3, 0.2, 0.19], 2, 1.5 * 0.19, False),
    ],
)
def test_the_first_setting_that_promises_enough_is_picked(expected, index, promised, met) -> None:
    """By hand: margin 3 · (10 % / 5 %)^−1 = 1.5 and a slack of 1.5 ask for ê ≤ the error."""
    law = dataclasses.replace(LAW, margin=np.array(3.0), ease=np.array(1.0), doubt=np.array(1.2))
    found = pick(0.1, np.log(np.float32(expected)), law)
    assert (int(found[0]), bool(found[2])) == (index, met)
    assert float(found[1]) == pytest.approx(promised, rel=1e-5)


def test_a_survey_by_hand() -> None:
    """A square punch of 4 × 4 of 8 pixels under a flat gap: no detail, 32 edges of 16 pixels, an extent of a half."""
    pressure = np.pad(np.ones((4, 4), np.float32), 2)
    flat = tuple(np.zeros((n, n), np.float32) for n in (8, 16, 32))
    seen = surveyed(pressure, pressure, flat, jnp.float32(0.5), 8.0, 2.0)
    feature = dict(zip(FEATURES, np.asarray(seen.features), strict=True))
    least = np.log(1e-3)
    assert feature["1"] == 1
    assert feature["ln d₂"] == feature["ln d₄"] == pytest.approx(least)
    assert feature["ln edge/area"] == pytest.approx(np.log(16 / 16))  # 4 sides of 4 pixels
    assert feature["ln gel's share"] == pytest.approx(np.log(0.5))
    assert feature["extent"] == 0.5
    assert feature["border"] == 0
    assert feature["ln a/h"] == pytest.approx(np.log(4 / np.sqrt(np.pi) / 2))
    assert feature["ln d₂ · ln d₄"] == pytest.approx(least**2)
    assert float(seen.radius_mm) == pytest.approx(4 / np.sqrt(np.pi))


@pytest.mark.long
@pytest.mark.parametrize("gap", [_ball, _bumps])
def test_the_promise_is_kept(gap) -> None:
    """Against 192² at a tight tolerance; the displacement is compared on the chosen grid."""
    fine = gap(384)
    choice, found = chooser.solve(0.1, fine, 3.0, GEL, None, WINDOW_MM)
    assert choice.met
    assert choice.tier == contact.Tier.SPG
    assert found.displacement_mm.shape == (choice.grid, choice.grid)
    soft = _spectrum(384, 192)
    exact = contact.solve(nested.coarsen(fine, 2), 3.0, soft, 0 * soft, WINDOW_MM / 192, 1e-4)
    true = chooser.gap_on(exact.displacement_mm, choice.grid)
    assert np.linalg.norm(found.displacement_mm - true) <= SLACK * 0.1 * np.linalg.norm(true)


@pytest.mark.long
def test_many_scenes_are_solved_as_each_alone() -> None:
    forces, moduli = np.array([1.0, 6.0, 12.0]), np.array([0.5, 3.0, 50.0])
    shapes = (_ball, _bumps, _bumps)
    gaps = lambda n, rows: np.stack([chooser.gap_on(shapes[i](384), n) for i in rows])
    solved = chooser.solve_many(0.15, gaps, forces, moduli, STAGE)
    assert sorted(np.concatenate([b.rows for b in solved.buckets]).tolist()) == [0, 1, 2]
    for bucket in solved.buckets:
        for at, i in enumerate(bucket.rows):
            body = dataclasses.replace(BODY, modulus_mpa=float(moduli[i]))
            choice, alone = chooser.solve(0.15, shapes[i](384), float(forces[i]), GEL, body, WINDOW_MM)
            assert _setting(choice) == _setting(solved.choices[i])
            assert (bucket.grid, bucket.padded) == (choice.grid, choice.padded)
            scale = np.abs(alone.displacement_mm).max()
            np.testing.assert_allclose(bucket.contacts.displacement_mm[at], alone.displacement_mm, atol=1e-3 * scale)


@pytest.mark.long
def test_resuming_ends_where_solving_does() -> None:
    soft, fine = _spectrum(36, 24), _spectrum(64, 32)
    first = contact.solve(_bumps(24), 3.0, soft, 0 * soft, WINDOW_MM / 24, 3e-2)
    known = contact.Known(gap_mm=_bumps(24) + 1.0, pressure_mpa=first.pressure_mpa)
    resumed = contact.resume(known, _bumps(32), 3.0, fine, 0 * fine, WINDOW_MM / 32, 1e-3)
    solved = contact.solve(_bumps(32), 3.0, fine, 0 * fine, WINDOW_MM / 32, 1e-3)
    assert resumed.converged
    assert off(resumed.displacement_mm, solved.displacement_mm) < 2e-3
    assert float(resumed.pressure_mpa.sum()) * (WINDOW_MM / 32) ** 2 == pytest.approx(3.0, rel=1e-4)


def test_bad_input_is_refused() -> None:
    soft, known = _spectrum(36, 24), contact.Known(gap_mm=_ball(48), pressure_mpa=_ball(48))
    said = "known is on 48²: must be no finer than gap_mm on 24²"
    refused(ValueError, said, contact.resume, known, _ball(24), 1.0, soft, 0 * soft, WINDOW_MM / 24)
    for error in (0.0, -0.1, 1.5, float("nan")):
        refused(ValueError, r"error is .*: must lie in \(0, 1\]", _choose, error)
    for field, force, window in (("force_n", 0.0, 20.0), ("window_mm", 1.0, 0.0)):
        refused(ValueError, f"{field} is .*0.*: must be > 0", chooser.choose, 0.1, _ball, force, GEL, None, window)
    for shape in ((50, 50), (48, 96), (48,)):
        refused(ValueError, r"gap is .*multiple of", _choose, 0.1, np.zeros(shape))


def test_resampling_keeps_planes_and_doubles_as_refining_does() -> None:
    plane = np.add.outer(np.arange(12.0), 2 * np.arange(12.0)).astype(np.float32)
    np.testing.assert_allclose(resample(plane, 24), refine(plane), atol=1e-5)
    at = (np.arange(16) + 0.5) * 12 / 16 - 0.5
    found = np.asarray(resample(plane, 16))
    np.testing.assert_allclose(found[1:-1, 1:-1], np.add.outer(at, 2 * at)[1:-1, 1:-1], atol=1e-4)


def test_chunks_hold_every_row_once_and_what_fills_one_up_is_dropped() -> None:
    rows = np.arange(1, CHUNK + 4)
    parts = list(chunks(rows))
    assert [len(chunk) for chunk, _ in parts] == [CHUNK, CHUNK]
    np.testing.assert_array_equal(np.concatenate([chunk[live] for chunk, live in parts]), rows)
    assert [len(chunk) for chunk, _ in chunks(rows[:1])] == [1]
    square = jax.jit(lambda live, x: map_live(lambda v: {"y": v**2}, live, x))
    squares = [square(live, chunk.astype(np.float32)) for chunk, live in parts]
    assert float(squares[-1]["y"][-1]) == 0  # never computed
    np.testing.assert_array_equal(gather(squares, len(rows))["y"], rows.astype(np.float32) ** 2)
