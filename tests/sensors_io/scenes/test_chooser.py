"""The chooser: what it promises, that it keeps it, and what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.scenes import chooser, contact
from sensors_io.scenes.layer import Layer
from sensors_io.scenes.sensors import BODY, TAC3D

WINDOW_MM, GEL = TAC3D.window_mm, TAC3D.gel


def _ball(grid: int, radius_mm: float = 8.0) -> jnp.ndarray:
    x = (np.arange(grid) + 0.5) * WINDOW_MM / grid - WINDOW_MM / 2
    return jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / (2 * radius_mm), jnp.float32)


def _bumps(grid: int) -> jnp.ndarray:
    x = (np.arange(grid) + 0.5) * WINDOW_MM / grid - WINDOW_MM / 2
    ripple = np.cos(2 * np.pi * x / 2.5)
    return _ball(grid, 20.0) + jnp.asarray(0.15 * ripple[None] * ripple[:, None], jnp.float32)


def _choose(error: float, gap: chooser.Gap = _ball, force_n: float = 2.0, body: Layer | None = None) -> chooser.Choice:
    return chooser.choose(error, gap, force_n, GEL, body, WINDOW_MM)


def _cost(choice: chooser.Choice) -> float:
    return chooser.Setting(grid=choice.grid, padded=choice.padded, tolerance=choice.tolerance).cost


def _survey(gap: jnp.ndarray, force_n: float = 2.0) -> chooser.Survey:
    gel = chooser.look_compliance(GEL, WINDOW_MM)
    return chooser.survey(gap, jnp.float32(force_n), gel, 0 * gel, WINDOW_MM, GEL.thickness_mm)


# The menu ------------------------------------------------------------------------------------------------------------


def test_the_menu_is_sorted_and_can_be_solved() -> None:
    costs = [s.cost for s in chooser.MENU]
    assert costs == sorted(costs)
    assert len(set(chooser.MENU)) == len(chooser.MENU)
    for s in chooser.MENU:
        assert s.grid % 2 == 0
        assert s.padded >= s.grid
        assert s.padded % 2 == 0


def test_the_look_has_grids_twice_and_four_times_coarser() -> None:
    assert chooser.LOOK_GRID % 4 == 0


# The law -------------------------------------------------------------------------------------------------------------


def test_errors_add_in_quadrature() -> None:
    """By hand: with all coefficients 0 each of the three parts is e⁰ = 1."""
    law = jax.tree.map(np.zeros_like, chooser.LAW)
    found = chooser.log_error(_survey(_ball(chooser.LOOK_GRID)), law, chooser.MENU)
    np.testing.assert_allclose(found, np.full(len(chooser.MENU), np.log(3) / 2), rtol=1e-6)


def test_each_part_follows_its_formula() -> None:
    seen = _survey(_ball(chooser.LOOK_GRID))
    never = np.float32(-50.0)  # e⁻⁵⁰ is nothing beside the part under test
    silent = jax.tree.map(np.zeros_like, chooser.LAW)
    silent = dataclasses.replace(
        silent,
        grid=silent.grid + never * (np.arange(len(silent.grid)) == 0),
        stop=silent.stop + never * (np.arange(len(silent.stop)) == 0),
        wrap=silent.wrap + never * (np.arange(3) == 0),
    )
    menu = chooser.MENU[:5]
    by_stop = dataclasses.replace(silent, stop=np.eye(len(silent.stop))[-1])
    np.testing.assert_allclose(chooser.log_error(seen, by_stop, menu), np.log([s.tolerance for s in menu]), rtol=1e-4)
    by_wrap = dataclasses.replace(silent, wrap=np.array([0.0, 1.0, 0.0]))
    clearance = [(WINDOW_MM * s.padded / s.grid - 2 * float(seen.radius_mm)) / GEL.thickness_mm for s in menu]
    np.testing.assert_allclose(chooser.log_error(seen, by_wrap, menu), clearance, rtol=1e-4)


def test_more_work_promises_less_error() -> None:
    for gap in (_ball, _bumps):
        for force in (0.3, 3.0, 15.0):
            promised = dict(zip(chooser.MENU, chooser.promise(_survey(gap(chooser.LOOK_GRID), force)), strict=True))
            for s, error in promised.items():
                finer = [chooser.Setting(grid=s.grid, padded=s.padded, tolerance=t) for t in chooser.TOLERANCES]
                assert all(promised[f] <= error * 1.001 for f in finer if f.tolerance < s.tolerance)
                ratio = s.padded / s.grid
                wider = [
                    chooser.Setting(grid=s.grid, padded=round(s.grid * r), tolerance=s.tolerance)
                    for r in chooser.PADDINGS
                    if r > ratio
                ]
                assert all(promised[w] <= error * 1.001 for w in wider)
                grids = [
                    chooser.Setting(grid=n, padded=round(n * ratio), tolerance=s.tolerance)
                    for n in chooser.GRIDS
                    if n > s.grid
                ]
                assert all(promised[g] <= error * 1.001 for g in grids)


def test_a_survey_ignores_offset_and_turn() -> None:
    gap = _bumps(chooser.LOOK_GRID) + 0.01 * jnp.arange(chooser.LOOK_GRID)[None]
    for other in (gap + 3.0, gap.T, gap[::-1]):
        np.testing.assert_allclose(_survey(other).features, _survey(gap).features, atol=2e-3)


def test_many_surveys_are_those_of_each() -> None:
    gaps = jnp.stack([_ball(chooser.LOOK_GRID), _bumps(chooser.LOOK_GRID)])
    both = jax.vmap(_survey)(gaps)
    for i, gap in enumerate(gaps):
        np.testing.assert_allclose(both.features[i], _survey(gap).features, atol=1e-4)


def test_a_survey_is_finite_where_little_or_all_touches() -> None:
    needle = jnp.full((chooser.LOOK_GRID,) * 2, 5.0, jnp.float32).at[3, 5].set(0)
    for gap in (needle, jnp.zeros_like(needle)):
        for leaf in jax.tree.leaves(_survey(gap, 1e-3)):
            assert np.all(np.isfinite(leaf))


# The choice ----------------------------------------------------------------------------------------------------------


def test_less_error_costs_more() -> None:
    costs = [_cost(_choose(error, _bumps)) for error in (0.3, 0.1, 0.03)]
    assert costs == sorted(costs)
    assert costs[0] < costs[-1]


def test_a_met_promise_is_within_the_slack() -> None:
    choice = _choose(0.1)
    assert choice.met
    assert choice.promised_error <= chooser.SLACK * 0.1
    assert choice.tier == contact.Tier.SPG


def test_what_cannot_be_met_is_said() -> None:
    choice = _choose(1e-4, _bumps)
    assert not choice.met
    assert choice.promised_error > chooser.SLACK * 1e-4
    promised = chooser.promise(_survey(_bumps(chooser.LOOK_GRID)))
    assert choice.promised_error == pytest.approx(float(promised.min()), rel=1e-3)


def test_stiffness_and_force_scale_together() -> None:
    body = dataclasses.replace(BODY, modulus_mpa=0.5)
    double = [dataclasses.replace(b, modulus_mpa=2 * b.modulus_mpa) for b in (GEL, body)]
    one = chooser.choose(0.05, _bumps, 2.0, GEL, body, WINDOW_MM)
    two = chooser.choose(0.05, _bumps, 4.0, *double, WINDOW_MM)
    assert (one.grid, one.padded, one.tolerance) == (two.grid, two.padded, two.tolerance)


def test_an_array_is_averaged_to_the_grid() -> None:
    fine = _bumps(2 * chooser.LOOK_GRID)
    np.testing.assert_allclose(chooser.gap_on(fine, chooser.LOOK_GRID), _bumps(chooser.LOOK_GRID), atol=0.02)
    assert _choose(0.1, fine).promised_error == pytest.approx(_choose(0.1, _bumps).promised_error, rel=0.1)


@pytest.mark.parametrize("gap", [_ball, _bumps])
@pytest.mark.parametrize("force", [0.5, 5.0])
def test_the_promise_is_kept(gap, force) -> None:
    """Against the finest grid at a tight tolerance; the displacement is compared on the chosen grid."""
    choice, found = chooser.solve(0.1, gap, force, GEL, None, WINDOW_MM)
    assert choice.met
    assert found.displacement_mm.shape == (choice.grid, choice.grid)
    finest = dataclasses.replace(chooser.MENU[-1], grid=192, padded=384, tolerance=1e-4)
    soft = jnp.asarray(chooser._compliance(GEL, finest.padded, WINDOW_MM / finest.grid), jnp.float32)
    exact = contact.solve(gap(finest.grid), force, soft, 0 * soft, WINDOW_MM / finest.grid, finest.tolerance)
    true = chooser.gap_on(exact.displacement_mm, choice.grid)
    error = np.linalg.norm(found.displacement_mm - true) / np.linalg.norm(true)
    assert error <= chooser.SLACK * 0.1


# Bad input -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [0.0, -0.1, 1.5, float("nan")])
def test_an_error_out_of_range_is_refused(error) -> None:
    with pytest.raises(ValueError, match=r"error is .*: must lie in \(0, 1\]"):
        _choose(error)


@pytest.mark.parametrize(("field", "force", "window"), [("force_n", 0.0, 20.0), ("window_mm", 1.0, 0.0)])
def test_what_is_not_positive_is_refused(field, force, window) -> None:
    with pytest.raises(ValueError, match=f"{field} is 0.0: must be > 0"):
        chooser.choose(0.1, _ball, force, GEL, None, window)


@pytest.mark.parametrize("shape", [(50, 50), (48, 96), (48,)])
def test_a_gap_that_does_not_fit_is_refused(shape) -> None:
    with pytest.raises(ValueError, match=r"gap is .*multiple of 48"):
        _choose(0.1, jnp.zeros(shape))
