"""Every alarm of exploring policies fires on its failure and is silent on a healthy run."""

import pytest

from touchr1_jax.rl.active_alarms import ACTIVE_RULES
from touchr1_jax.rl.alarms import WINDOW, AlarmMonitor

HEALTHY = {
    "accuracy": 0.6,
    "drawn_accuracy": 0.6,
    "grounding": 0.1,
    "unsolved_share": 0.8,
    "idle_share": 0.1,
    "kl_cost_peak": 0.05,
    "entropy": 0.5,
    "perturbed_stream_0": 4.0,
    "grounding_stream_0": 0.1,
    "touch_share": 1.0,
    "nonfinite_share": 0.0,
    "budget": 3.0,
    "kinds": 4.0,
    "questions": 5.0,
    "no_action_share": 0.05,
    "one_action_share": 0.6,
    "all_actions_share": 0.1,
    "silent_share": 0.1,
    "first_kind_peak": 0.6,
    "first_kind_information": 0.5,
    "reward_seconds": -0.1,
}
FAILURES = {
    "A1": ({"no_action_share": 1.0}, 1.0),
    "A2": ({"one_action_share": 1.0}, 1.0),
    "A3": ({"all_actions_share": 1.0}, 1.0),
    "A4": ({"first_kind_information": 0.02, "first_kind_peak": 0.5}, 0.02),
    "A5": ({"silent_share": 0.8}, 0.8),
    "F16": ({"sampler_gap": 0.15}, 0.15),
}


def fired(now: dict, start: dict = HEALTHY) -> dict[str, float]:
    """Code and number of each alarm after a window of `now`."""
    monitor, alarms = AlarmMonitor(ACTIVE_RULES), []
    for metrics in [start] * 5 + [now] * WINDOW:
        alarms = monitor.update(metrics)
    return {alarm.code: alarm.value for alarm in alarms}


@pytest.mark.parametrize("code", FAILURES)
def test_fires_with_its_number(code):
    change, value = FAILURES[code]
    assert fired({**HEALTHY, **change}) == {code: pytest.approx(value)}


NO_FAILURE = {
    "a healthy run": {},
    "one touch, and answers are better": {"one_action_share": 1.0, "drawn_accuracy": 0.7},
    "some trajectories without a touch": {"touch_share": 0.9},
    "one touch of one": {"one_action_share": 1.0, "budget": 1.0},
    "every touch, and time is free": {"all_actions_share": 1.0, "reward_seconds": 0.0},
    "one question": {"first_kind_information": 0.0, "questions": 1.0},
    "one kind of touch": {"first_kind_information": 0.0, "kinds": 1.0},
    "one touch tells of the question": {"first_kind_information": 0.15},
    "half touch nothing": {"first_kind_information": 0.0, "no_action_share": 0.5},
    "touches at random": {"first_kind_information": 0.0, "first_kind_peak": 0.3},
}


@pytest.mark.parametrize("change", NO_FAILURE.values(), ids=NO_FAILURE)
def test_silent_where_it_is_no_failure(change):
    assert fired({**HEALTHY, **change}) == {}


def test_each_rule_says_its_cure():
    active = [rule for rule in ACTIVE_RULES if rule.code.startswith("A")]
    assert {rule.code for rule in active} == {code for code in FAILURES if code.startswith("A")}
    assert all(": " in rule.meaning for rule in active)
