"""Scores and times to the target by hand, and the experiment shrunk."""

import numpy as np
import pytest

from experiments.engine.grpo_options import OptionRun, gain, option_table, option_verdict
from experiments.engine.pareto_grpo import LearningCurves, cost_table


def curves(*rewards: list[float], step_s: float = 1.0) -> LearningCurves:
    return LearningCurves(rewards=np.array(rewards), step_s=step_s)


def test_a_seed_reaches_the_target_where_it_first_passes_it():
    three = curves([0.5, 0.9, 0.6], [0.9, 0.1, 0.1], [0, 0, 0], step_s=2.0)
    np.testing.assert_array_equal(three.steps_to(0.9), [2, 1, np.inf])
    assert three.seconds_to(0.9) == 3.0
    assert not three.all_reach(0.9)
    assert np.isnan(three.seconds_to(1.0))


def test_the_score_is_that_of_the_last_tenth_but_of_one_step_at_least():
    assert curves([0.0, 0.5], [0.0, 1.0]).score == 0.75
    assert curves([0.0] * 18 + [1.0, 0.5]).score == 0.75


def test_costs_by_hand():
    found = {
        ("paper", 8): curves([0.5, 0.95], [0.5, 0.95], step_s=2.0),
        ("c", 8): curves([0.5, 0.8], [0.95, 0.95], step_s=0.1),
    }
    rows = {row[0]: row[1:] for row in cost_table(0.9, found).rows}
    assert rows["paper (default)"] == (8, 2000.0, 0.95, 2.0, 4.0, "2 of 2")
    assert rows["c"][3:] == (None, None, "1 of 2")


def run_of(accuracy: list[float], step_s: float) -> OptionRun:
    seeds = np.array(accuracy)
    return OptionRun(accuracy=seeds, entropy=seeds, kl=seeds, right=np.tile(seeds[:, None], (1, 3)), step_s=step_s)


RUNS = {
    "published": run_of([0.5, 0.6, 0.7], 0.010),
    "top-p .9": run_of([0.6, 0.7, 0.8], 0.012),
    "max@2": run_of([0.4, 0.6, 0.9], 0.010),
}


def test_an_option_is_compared_seed_by_seed():
    """Ten points more with every seed are beyond chance, −10, 0 and 20 are not."""
    rows = {row[0]: row[1:] for row in option_table(RUNS).rows}
    assert rows["published"][:4] == (10.0, 1.0, pytest.approx(60.0), None)
    assert rows["top-p .9"][:2] == (12.0, pytest.approx(1.2))
    assert gain(RUNS, "top-p .9").low == pytest.approx(10.0)
    assert gain(RUNS, "max@2").mean == pytest.approx(10 / 3)
    (verdict,) = option_verdict(RUNS)
    assert "top-p .9" in verdict
    assert "max@2" not in verdict
