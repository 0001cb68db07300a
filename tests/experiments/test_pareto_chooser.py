"""The chooser's experiment, shrunk, and its arithmetic by hand."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments import pareto_chooser
from experiments.chooser import bench as chooser_bench
from experiments.chooser import fit as chooser_fit
from experiments.chooser.bench import FAMILIES, Outcomes
from experiments.running.artifacts import read_json
from experiments.running.runner import main
from sensors_io.scenes import chooser
from sensors_io.scenes.sensors import XENSE

TINY = pareto_chooser.ChooserConfig(batch=5, tested_batches=1, sensors=1, grids=(24,), reference=48, asked=(0.1, 0.2))


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    home = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        small = dataclasses.replace(pareto_chooser.EXPERIMENT, config=TINY)
        patch.setattr(pareto_chooser, "EXPERIMENT", small)
        assert main(["pareto_chooser", "--runs-dir", str(home)]) == 0
    (directory,) = (p for p in (home / "pareto_chooser").iterdir() if not p.is_symlink())
    return directory


def test_results_hold_every_error_asked_for(directory):
    results = read_json(directory / "results.json")
    summary, families, costs, law = (table["rows"] for table in results["tables"])
    assert [row[0] for row in summary] == list(TINY.asked)
    assert [row[0] for row in families] == list(FAMILIES)
    assert sum(row[1] for row in families) == TINY.batch
    assert len(costs) == len(chooser.PADDINGS)
    assert len(law) == 2 * len(dataclasses.fields(chooser.Law))
    assert len(results["requirements"]) == 2 * len(TINY.asked)


def test_the_chart_is_drawn(directory):
    assert b"</svg>" in (directory / "plots" / "chooser.svg").read_bytes()


# By hand -------------------------------------------------------------------------------------------------------------

ERROR = np.array([[0.30, 0.09, 0.02], [0.14, 0.20, 0.01], [0.90, 0.80, 0.70]])
COST = np.array([1.0, 2.0, 4.0])


def test_a_trial_looks_up_what_was_chosen():
    promised = np.array([[0.4, 0.1, 0.05], [0.15, 0.1, 0.05], [0.9, 0.8, 0.7]])
    trial = pareto_chooser.try_out(promised, ERROR, COST, 0.1)
    np.testing.assert_array_equal(trial.index, [1, 0, 2])  # first within 0.15; the least promise where none is
    np.testing.assert_array_equal(trial.met, [True, True, False])
    np.testing.assert_allclose(trial.error, [0.09, 0.14, 0.7])
    np.testing.assert_array_equal(trial.best, [1, 2, -1])


def test_a_summary_counts_shares_and_times():
    promised = np.array([[0.4, 0.1, 0.05], [0.15, 0.1, 0.05], [0.9, 0.8, 0.7]])
    trial = pareto_chooser.try_out(promised, ERROR, COST, 0.1)
    found = pareto_chooser.summary(trial, _outcomes(ERROR), COST, look=0.3)
    assert found["share"] == 1.0
    assert found["share of all"] == pytest.approx(2 / 3)
    assert found["flagged"] == pytest.approx(1 / 3)
    assert found["flagged in vain"] == 0
    assert found["ms"] == pytest.approx(1.5 + 0.3)
    assert found["ratio"] == pytest.approx((1.5 + 0.3) / 3.0)
    assert np.isnan(found["fixed"])  # the third scene is met by none


def test_the_host_picks_as_the_device_does():
    rng = np.random.default_rng(0)
    promised = rng.uniform(0.01, 1, (20, 6)).astype(np.float32)
    index, met = chooser_fit.chosen(promised, 0.1)
    for row, i, m in zip(promised, index, met, strict=True):
        assert chooser.pick(0.1, row) == (i, m)


def test_the_least_margin_keeps_enough():
    error = np.full((100, 1), 0.2)
    predicted = np.full((100, 1), 0.1)
    margin = chooser_fit.least_margin(predicted, error, [0.1])
    assert margin == pytest.approx(1.5, rel=0.03)  # past it nothing is promised any more


def test_an_unfit_law_is_refused():
    with pytest.raises(ValueError, match="the law does not fit"):
        chooser_fit.least_margin(np.full((9, 1), 1e-6), np.ones((9, 1)), [0.1])


def test_the_fit_finds_the_law_that_made_the_errors():
    rng, menu = np.random.default_rng(1), chooser.MENU
    features = np.concatenate([np.ones((60, 1)), rng.normal(0, 0.3, (60, 8))], 1)
    made = dataclasses.replace(_outcomes(np.ones((60, len(menu)))), features=features)
    law = dataclasses.replace(chooser.LAW, margin=np.array(1.0))
    exact = np.exp(np.asarray(jax.vmap(lambda s: chooser.log_error(s, law, menu))(made.survey)))
    made = dataclasses.replace(made, errors=np.stack([exact, 0 * exact], -1))
    start = dataclasses.replace(law, grid=law.grid + 0.2, stop=law.stop - 0.1)
    found = chooser_fit.predict(chooser_fit.fit(made, menu, (0.1,), start), made, menu)
    counts = (exact > chooser_fit.RANGE[0]) & (exact < chooser_fit.RANGE[1])
    assert np.quantile(np.abs(np.log(found / exact))[counts], 0.95) < 0.1


def test_batches_survive_a_round_trip():
    made = _outcomes(ERROR)
    again = chooser_bench.join([made.to_json(), made.to_json()])
    np.testing.assert_array_equal(again.errors, np.concatenate([made.errors, made.errors]))
    assert again.family == (*made.family, *made.family)


def test_every_batch_has_a_seed_of_its_own():
    seeds = {pareto_chooser.hash_seed(0, name, s, i) for name in ("a", "b") for s in range(4) for i in range(3)}
    assert len(seeds) == 24


def test_families_are_what_they_say():
    batch = chooser_bench.draw(XENSE, len(FAMILIES), (24,), 48, tuple(FAMILIES), 0)
    assert batch.family == tuple(FAMILIES)
    assert set(batch.gap_mm) == {24, 48}
    ball = batch.gap_mm[48][1]
    assert ball.min() >= 0
    assert np.diff(ball, 2, axis=0).std() < 0.05 * np.diff(ball, 2, axis=0).mean()  # one curvature everywhere


def _outcomes(error: np.ndarray) -> Outcomes:
    count, settings = error.shape
    return Outcomes(
        features=np.ones((count, 9)),
        radius_mm=np.full(count, 3.0),
        window_mm=np.full(count, 18.0),
        thickness_mm=np.full(count, 4.0),
        errors=np.stack([error, 0 * error], -1),
        ms=np.ones((1, settings)),
        look_ms=np.ones(1),
        family=("balls",) * count,
    )
