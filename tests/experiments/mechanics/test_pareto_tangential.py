"""The friction experiment, shrunk; the methods that it compares; the loops of real presses that it reads."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.errors import ResultsError
from experiments.mechanics import tangential_checks, tangential_scenes
from experiments.mechanics import tangential_methods as methods
from experiments.mechanics.pareto_tangential import MethodErrors, at_equal_error, time_at
from experiments.mechanics.tangential_checks import PromiseCheck
from experiments.mechanics.tangential_methods import MAIN, PLAIN, SOLVER
from sensors_io.scenes.sensors import XENSE


@pytest.fixture(scope="module")
def contacts():
    kernels = tangential_scenes.friction_kernels(XENSE, 24)
    return kernels, *tangential_scenes.sample(kernels, 1, 0, 0)


@pytest.mark.slow
def test_closed_forms_are_kept(context):
    off = tangential_checks.closed_forms(48, context)
    assert off["Lubkin: torque"] < 0.02
    assert off["Cattaneo–Mindlin: slide"] < 0.01
    assert off["Cattaneo–Mindlin: force"] < 0.01
    assert off["Cattaneo–Mindlin: traction"] < 0.08


@pytest.mark.long
@pytest.mark.parametrize("task", ["slide", "twist"])
def test_two_solvers_meet_at_the_exact_traction(contacts, task):
    kernels, cases, _ = contacts
    true = methods.exact(task, cases, kernels)
    assert true.dtype == np.complex128
    for solve, setting in ((methods.spg(task), 1e-5), (methods.plain(task), 300)):
        found = methods.every(solve, cases, kernels, jnp.asarray(setting))
        off = np.linalg.norm(found - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
        assert off.max() < 0.02


@pytest.mark.long
def test_a_force_is_carried_by_every_method(contacts):
    kernels, cases, _ = contacts
    most = np.asarray(cases.friction * cases.ramp_mpa[:, -1].sum((1, 2))) * float(kernels.spacing_mm) ** 2
    pull = most * np.asarray(cases.pull_share * cases.direction)
    for solve in (methods.scaled_pull, methods.ramp_pull, methods.superposed_pull, methods.spg("force")):
        found = np.asarray(methods.every(solve, cases, kernels, jnp.asarray(1e-3)))
        np.testing.assert_allclose(found.sum((1, 2)) * float(kernels.spacing_mm) ** 2, pull, rtol=0.03)
        assert np.all(np.abs(found) <= np.asarray(cases.limit_mpa) * (1 + 1e-4) + 1e-9)


def test_kinds_are_what_they_are_called():
    rng = np.random.default_rng(0)
    sphere, rough, patterned = (tangential_scenes.draw(rng, kind).skin for kind in tangential_scenes.KINDS)
    assert sphere.curvature_per_mm[0] == sphere.curvature_per_mm[1]
    assert not np.any(sphere.wave_amplitudes_mm)
    assert sphere.feature_height_mm == rough.feature_height_mm == 0
    rms = float(np.sqrt(np.sum(np.square(rough.wave_amplitudes_mm)) / 2))
    assert 0.01 <= rms <= 0.06
    assert not np.any(patterned.wave_amplitudes_mm)
    assert patterned.feature_height_mm >= 0.05


def _rows(**ladders):
    return {
        name if kind == SOLVER else f"{kind} {i}": MethodErrors(kind=kind, label="", ms=ms, errors=np.full(3, error))
        for kind, ladder in ladders.items()
        for i, (name, ms, error) in enumerate(ladder)
    }


def test_times_at_equal_error_by_hand():
    ours = [(MAIN, 2.0, 0.01), ("tight", 4.0, 0.001)]
    rows = _rows(**{SOLVER: ours, PLAIN: [("", 4.0, 0.1), ("", 16.0, 0.001)]})
    assert time_at(rows, PLAIN, 0.01) == pytest.approx(8.0)
    assert time_at(rows, PLAIN, 0.2) is None
    assert time_at(rows, SOLVER, 0.0001) is None
    assert at_equal_error(rows) == (pytest.approx(0.25), "")
    worse = _rows(**{SOLVER: ours, PLAIN: [("", 4.0, 0.1), ("", 16.0, 0.02)]})
    assert at_equal_error(worse)[0] == pytest.approx(2 / 16)
    better = _rows(**{SOLVER: ours, PLAIN: [("", 4.0, 0.005), ("", 16.0, 0.001)]})
    assert at_equal_error(better)[0] == pytest.approx(2 / 4)


def test_promises_are_counted():
    found = [
        PromiseCheck(kind="sphere", sensor="xense", error=e, promised=p)
        for e, p in ((0.01, 0.02), (0.03, 0.02), (0.04, 0.09), (0.12, 0.09))
    ]
    (*_, everything) = tangential_checks.promise_table(found).rows
    assert everything[:2] == ("all", 4)
    assert everything[-1] == 50
    by_tolerance = {row[0]: row[1:] for row in tangential_checks.decision_table(found).rows}
    assert by_tolerance["2 %"] == (50, 50, 25)
    assert by_tolerance["10 %"] == (100, 75, 75)


def test_a_lag_of_the_force_makes_a_negative_loop_and_a_loss_a_positive_one(tmp_path):
    t = np.arange(0, 6, 0.0327)
    press = lambda at: np.maximum(np.sin(np.pi * at / 3), 0) ** 1.5  # one press of 3 s, then another after a rest
    depth, late = press(t), press(t - 0.06)
    np.savez(
        tmp_path / tangential_checks.RECORDING,
        **{
            "3D_ResultantForce": np.stack([0 * t, 0 * t, -5 * late], -1)[:, None],
            "3D_Displacements": np.repeat(np.stack([0 * t, 0 * t, -depth], -1)[:, None], 4, 1),
            "sendTimestamp": t[:, None] + 100,
        },
    )
    (row,) = tangential_checks.loop_table(tmp_path).rows[:1]
    by_lag = dict(zip(tangential_checks.LAGS_S, row[2:], strict=True))
    assert row[1] == pytest.approx(5, rel=0.01)
    assert by_lag[0.0] < by_lag[0.03] < -0.5
    assert by_lag[0.06] == pytest.approx(0, abs=0.5)
    with pytest.raises(ResultsError, match="must hold example_1"):
        tangential_checks.loop_table(tmp_path / "nowhere")
