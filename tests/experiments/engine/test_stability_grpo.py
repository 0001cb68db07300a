"""Failures are judged by their own numbers, alarms by those of training, and the experiment runs shrunken."""

import dataclasses

import numpy as np
import pytest

from experiments.engine.answers_without_touch import PRIORS, adversary_requirement, adversary_table
from experiments.engine.failures import SCENARIOS
from experiments.engine.stability_grpo import (
    ScenarioOutcome,
    VariantOutcome,
    alarm_table,
    criterion_table,
    odds_table,
    requirements,
    summary_table,
)
from experiments.engine.world_training import FirstAlarm, VariantRun
from tests.touchr1_jax.rl.test_alarms import HEALTHY
from touchr1_jax.rl.alarms import WINDOW


@pytest.mark.long
def test_the_adversary_finds_answers_under_the_published_rewards_and_none_under_stable():
    table, better = adversary_table(), dict[str, list[int]]()
    for presets, *_, count in table.rows:
        better.setdefault(presets, []).append(count)
    assert better.pop("stable") == [0] * len(PRIORS)
    (published,) = better.values()
    assert min(published) > 0
    assert adversary_requirement().measured == 0


def test_the_odds_of_the_tactile_reward():
    ((margin, false_credit, power),) = odds_table([0.13]).rows
    assert margin == 0.13
    assert false_credit == pytest.approx(0.086, abs=0.002)
    assert power == pytest.approx(0.5115, abs=0.002)


HEALTHY_FIGURES = {
    "accuracy": 0.8, "middle": 0.33, "echo_share": 0.7, "slots_right": 0.75, "grounding": 0.2, "grounding_0": 0.2,
    "grounding_1": 0.2, "entropy": 0.1, "kl": 0.1, "gamed_share": 0.05, "accuracy_swap": 0.4, "shuffled": 1.0,
}  # fmt: skip
HEALTHY_METRICS = {
    "degenerate_share": 0.3, "tactile_credit_share": 0.05, "bonus_cancelled_share": 0.0, "bonus_telling_share": 0.3,
}  # fmt: skip


def evaluation(**figures: float) -> dict[str, np.ndarray]:
    """Figures of two seeds: a healthy one, and one with these."""
    return {name: np.array([value, figures.get(name, value)]) for name, value in HEALTHY_FIGURES.items()}


def variant_run(**figures: float) -> VariantRun:
    """Two seeds: a healthy one, and one whose evaluation after training or whose metrics are these."""
    metrics = {n: np.array([np.full(50, v), np.full(50, figures.get(n, v))]) for n, v in HEALTHY_METRICS.items()}
    before = evaluation()
    before["accuracy"] -= 0.15
    return VariantRun(before=before, after=evaluation(**figures), metrics=metrics)


FAILED = {
    "F1 answers drift to the middle level": {"middle": 0.6},
    "F2 slots copy each other": {"echo_share": 1.0, "slots_right": 0.5},
    "F3 grounding without bound": {"grounding": 2.0, "accuracy": 0.5},
    "F4 noise is detected, touch is not read": {"grounding": 0.5, "accuracy_swap": 0.8},
    "F5 the tactile bonus cancels": {"bonus_cancelled_share": 0.2},
    "F6 tactile credit by chance": {"tactile_credit_share": 0.3},
    "F7 groups of equal rewards": {"degenerate_share": 0.9, "accuracy": 0.55},
    "F8 the KL estimate does not hold": {"kl": 1.5},
    "F9 entropy grows without bound": {"entropy": 0.9, "accuracy": 0.5},
    "F9 large steps collapse to one answer": {"accuracy": 0.5},
    "F10 a stream without influence": {"grounding_1": 0.0},
    "F12 equal time indices": {"shuffled": 0.0},
    "F13 unparsable answers are rewarded": {"gamed_share": 0.9},
}


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: f"{s.code} {s.title}")
def test_each_failure_is_judged_by_its_own_number(scenario):
    assert scenario.failed(variant_run(**FAILED[f"{scenario.code} {scenario.title}"])).tolist() == [False, True]
    assert not any(scenario.failed(variant_run(**figures))[0] for figures in FAILED.values())


def test_a_run_that_the_check_refuses_has_not_failed():
    (scenario,) = (s for s in SCENARIOS if s.code == "F10")
    broken = dataclasses.replace(variant_run(), before=evaluation(grounding_1=0.0), after=evaluation(grounding_1=0.0))
    assert not broken.streams_pass()
    assert variant_run().streams_pass()
    assert scenario.failed(broken).tolist() == [False, True]
    assert not scenario.failed(dataclasses.replace(broken, refused=True)).any()


def variant_outcome(failed: list[int], fired: list[int]) -> VariantOutcome:
    """Ten seeds at each value, of which the first so many failed, and the first so many raised F1 after step 30."""
    f1, f7 = {"F1": FirstAlarm(30, 0.4)}, {"F7": FirstAlarm(20, 0.9)}
    raised = [[f1 if seed < n else f7 for seed in range(10)] for n in fired]
    return VariantOutcome(failed=np.array([np.arange(10) < n for n in failed]), raised=raised)


OUTCOME = ScenarioOutcome(
    scenario=SCENARIOS[0],
    values=(1.0, 2.0, 3.0),
    failing=variant_outcome([0, 1, 6], [1, 0, 6]),
    stable=variant_outcome([0, 0, 1], [0, 0, 0]),
)


@pytest.mark.long
def test_failures_and_alarms_are_counted():
    """Of 8 failed runs 6 raised the alarm, of 52 others 1; `stable` failed once of 20 where the other variant does."""
    assert summary_table([OUTCOME]).rows[0][2:] == (2.0, 3.0, 3.0, 1, 20, 0.75, pytest.approx(1 / 52))
    listed = [cell.replace("\N{NO-BREAK SPACE}", "") for cell in criterion_table([OUTCOME]).rows[0][2:]]
    assert listed == ["1:0 · 2:1 · 3:6", "1:0 · 2:0 · 3:1"]
    assert alarm_table([OUTCOME]).rows[0][1:] == ("F1 > 0.25", 8, 6, 0.4, 30.0, 52, 1)
    assert OUTCOME.stable.breaks_at(OUTCOME.values, 0.5) is None
    harmed, noticed, false, *_ = requirements([OUTCOME])
    assert [(r.measured, r.met) for r in (harmed, noticed)] == [(1, False), (0.75, False)]
    assert (false.measured, false.met) == (pytest.approx(1 / 52), True)


def test_alarms_are_those_of_the_training_log():
    steps = 2 * WINDOW
    calm = {name: np.full((1, steps), value) for name, value in HEALTHY.items()}
    run = VariantRun(before={}, after={}, metrics={**calm, "reward": np.zeros((1, steps))})
    assert run.alarms(0) == {}
    grown = np.where(np.arange(steps) < WINDOW, 0.1, 5.0)[None]
    alarms = dataclasses.replace(run, metrics={**run.metrics, "grounding": grown}).alarms(0)
    assert set(alarms) == {"F3"}
    assert alarms["F3"].value > 1
    assert alarms["F3"].step >= WINDOW
