"""The friction experiment, shrunk; the methods that it compares; the loops of real presses that it reads."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.errors import ResultsError
from experiments.mechanics import pareto_tangential, tangential_checks, tangential_report, tangential_scenes
from experiments.mechanics import tangential_methods as methods
from experiments.mechanics.tangential_checks import PromiseCheck
from experiments.mechanics.tangential_report import MAIN, PLAIN, SOLVER, MethodErrors
from sensors_io.scenes.sensors import XENSE
from tests.experiments.shrunk import run_shrunk

TINY = dataclasses.replace(
    pareto_tangential.SMOKE, contacts=1, sensors=("xense",), grid=24, frames=20, rounds=1, closed_grid=32
)


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    home = tmp_path_factory.mktemp("runs")
    return run_shrunk(pareto_tangential, TINY, home)


@pytest.fixture(scope="module")
def contacts():
    kernels = tangential_scenes.friction_kernels(XENSE, 24)
    return kernels, *tangential_scenes.sample(kernels, 1, 0, 0)


@pytest.mark.slow
def test_every_method_has_a_row(directory):
    tables = read_json(directory / "results.json")["tables"]
    for table, compared in zip(tables, pareto_tangential.methods().values(), strict=False):
        assert [row[0] for row in table["rows"]] == [m.name for m in compared]
        assert np.all(np.isfinite([row[1:] for row in table["rows"]]))
    assert {p.name for p in (directory / "plots").iterdir()} == {"pareto_tangential.svg", "promise.svg"}


@pytest.mark.slow
def test_a_tighter_setting_errs_less(directory):
    tables = read_json(directory / "results.json")["tables"]
    for table in tables[:4]:
        worst = {row[0]: row[4] for row in table["rows"]}
        assert worst[f"{SOLVER} 0.0003"] < worst[f"{SOLVER} 0.02"]
        assert worst[MAIN] < 15  # per cent, on 24²
    for table in tables[1:4]:
        median = {row[0]: row[2] for row in table["rows"]}
        assert median[f"{PLAIN} 80"] < median[f"{PLAIN} 5"] < median["full slip"]


@pytest.mark.slow
def test_closed_forms_are_kept(directory, context):
    names = {r["name"] for r in read_json(directory / "results.json")["requirements"]}
    assert {"Cattaneo–Mindlin, slide off by", "Lubkin, torque off by"} <= names
    assert tangential_checks.lubkin(48, context) < 0.02
    off = tangential_checks.cattaneo_mindlin(48, context)
    assert off["slide"] < 0.01
    assert off["force"] < 0.01
    assert off["traction"] < 0.08


@pytest.mark.parametrize("task", ["slide", "twist"])
def test_two_solvers_meet_at_the_exact_traction(contacts, task):
    kernels, cases, _ = contacts
    true = methods.exact(task, cases, kernels)
    assert true.dtype == np.complex128
    tight, plain = {
        "slide": (methods.spg_slide, methods.plain_slide),
        "twist": (methods.spg_twist, methods.plain_twist),
    }[task]
    for solve, setting in ((tight, 1e-5), (plain, 300)):
        found = methods.every(solve, cases, kernels, jnp.asarray(setting))
        off = np.linalg.norm(found - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
        assert off.max() < 0.02


def test_a_force_is_carried_by_every_method(contacts):
    kernels, cases, _ = contacts
    most = np.asarray(cases.friction * cases.ramp_mpa[:, -1].sum((1, 2))) * float(kernels.spacing_mm) ** 2
    pull = most * np.asarray(cases.pull_share * cases.direction)
    for solve in (methods.scaled_pull, methods.ramp_pull, methods.superposed_pull, methods.spg_pull):
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


def test_unknown_sensors_are_refused():
    with pytest.raises(ValueError, match="must be some of gelsight_mini"):
        tangential_scenes.sensors(("xense", "finger"))


def _rows(**ladders):
    return {
        name if kind == SOLVER else f"{kind} {i}": MethodErrors(kind=kind, label="", ms=ms, errors=np.full(3, error))
        for kind, ladder in ladders.items()
        for i, (name, ms, error) in enumerate(ladder)
    }


def test_times_at_equal_error_by_hand():
    ours = [(MAIN, 2.0, 0.01), ("tight", 4.0, 0.001)]
    rows = _rows(**{SOLVER: ours, PLAIN: [("", 4.0, 0.1), ("", 16.0, 0.001)]})
    assert tangential_report.time_at(rows, PLAIN, 0.01) == pytest.approx(8.0)
    assert tangential_report.time_at(rows, PLAIN, 0.2) is None
    assert tangential_report.time_at(rows, SOLVER, 0.0001) is None
    assert tangential_report.at_equal_error(rows) == (pytest.approx(0.25), "")
    worse = _rows(**{SOLVER: ours, PLAIN: [("", 4.0, 0.1), ("", 16.0, 0.02)]})
    ratio, reservation = tangential_report.at_equal_error(worse)
    assert (ratio, reservation[:7]) == (pytest.approx(2 / 16), "at most")
    better = _rows(**{SOLVER: ours, PLAIN: [("", 4.0, 0.005), ("", 16.0, 0.001)]})
    ratio, reservation = tangential_report.at_equal_error(better)
    assert (ratio, reservation[:8]) == (pytest.approx(2 / 4), "at least")


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


@pytest.mark.slow
def test_coupling_is_measured_on_gels_with_markers(directory):
    results = read_json(directory / "results.json")
    (table,) = (t for t in results["tables"] if t["title"].startswith("What coupling changes"))
    assert [row[0] for row in table["rows"]] == [f"{m}, xense" for m in ("hold", "slide_x", "twist")]
    hold, slide, _ = table["rows"]
    assert hold[5] is None
    assert slide[5] > 0
    assert 0 < hold[1] < 100
    assert hold[4] < slide[4] + 20
    assert "Coupling changes" in results["verdict"][-1]
