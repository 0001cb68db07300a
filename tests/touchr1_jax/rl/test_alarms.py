"""Every alarm fires on its failure, with the number that fired, and is silent on a healthy run."""

import numpy as np
import pytest

from touchr1_jax.rl.alarms import RULES, WINDOW, AlarmMonitor, echo_excess

HEALTHY = {
    "middle_labels": 1 / 3,
    "middle_rate": 0.4,
    "echo_share": 0.7,
    "echo_right": 0.7,
    "accuracy": 0.7,
    "grounding": 0.1,
    "lead_drop": 0.35,
    "lead_noise": 0.35,
    "lead_order": 0.3,
    "control_drop_share": 1.0,
    "control_noise_share": 1.0,
    "control_order_share": 1.0,
    "bonus_telling_share": 0.4,
    "tactile_credit_share": 0.6,
    "credit_unearned_share": 0.0,
    "bonus_cancelled_share": 0.0,
    "unsolved_share": 0.5,
    "idle_share": 0.1,
    "kl_cost_peak": 0.05,
    "entropy": 0.5,
    "perturbed_stream_0": 4.0,
    "perturbed_stream_1": 4.0,
    "grounding_stream_0": 0.2,
    "grounding_stream_1": 0.05,
    "static_time_share": 0.0,
    "gamed_share": 0.05,
    "touch_share": 1.0,
    "nonfinite_share": 0.0,
    "learned_share": 1.0,
    "sampler_gap": 0.007,
    "drawn_unsolved_share": 0.5,
    "drawn_idle_share": 0.1,
    "drawn_accuracy": 0.7,
    "drawn_middle_labels": 1 / 3,
    "drawn_middle_rate": 0.4,
    "drawn_echo_share": 0.7,
    "drawn_echo_right": 0.7,
    "drawn_gamed_share": 0.05,
}
FAILURES = [  # each by less than its bound beyond it
    ("F1", {"drawn_middle_rate": 0.7}, 0.7 - 1 / 3),
    ("F2", {"drawn_echo_share": 0.85, "drawn_echo_right": 0.7}, 0.15),
    ("F3", {"grounding": 1.5}, 1.5),
    ("F4", {"lead_noise": 0.65, "lead_order": 0.25}, 0.4),
    ("F5", {"bonus_cancelled_share": 0.3}, 0.75),
    ("F6", {"lead_drop": -0.05, "tactile_credit_share": 0.3}, 0.3),
    ("F6", {"credit_unearned_share": 0.2}, 0.2),
    ("F8", {"kl_cost_peak": 1.5, "drawn_accuracy": 0.5}, 1.5),
    ("F9", {"entropy": 0.01}, 0.02),
    ("F9", {"entropy": 0.8}, 0.3),
    ("F10", {"grounding_stream_1": 0.0}, 0.0),
    ("F12", {"static_time_share": 0.015}, 0.015),
    ("F7", {"drawn_idle_share": 0.4, "drawn_accuracy": 0.65}, 0.8),
    ("F10", {"touch_share": 0.0}, 0.0),
    ("F10", {"touch_share": 0.875}, 0.125),
    ("F13", {"drawn_gamed_share": 0.3}, 0.3),
    ("F15", {"nonfinite_share": 0.03}, 0.03),
    ("F15", {"nonfinite_share": 0.03, "drawn_nonfinite_share": 0.0}, 0.03),  # KL in the reward, of the selected alone
    ("F15", {"learned_share": 0.0, "entropy": 0.0}, 0.0),
    ("F15", {"learned_share": 0.4}, 0.4),  # the others are cut off, or too far from the sampler
    ("F16", {"sampler_gap": 0.15}, 0.15),
]


def fired(change: dict[str, float]) -> dict[str, float]:
    """Alarms of a run that was healthy for one window and then failed for one."""
    monitor = AlarmMonitor()
    for _ in range(WINDOW):
        assert monitor.update(HEALTHY) == []
    for _ in range(WINDOW):
        alarms = monitor.update(HEALTHY | change)
    return {a.code: a.value for a in alarms}


@pytest.mark.parametrize(("code", "change", "value"), FAILURES)
def test_each_failure_fires_its_alarm_alone(code, change, value):
    assert fired(change) == {code: pytest.approx(value)}


def test_all_codes_are_covered():
    codes = {f"F{k}" for k in (*range(1, 11), 12, 13, 15, 16)}
    assert {rule.code for rule in RULES} == codes == {code for code, _, _ in FAILURES}


NO_FAILURE = {
    "all right in most groups": {"drawn_unsolved_share": 0.05, "drawn_idle_share": 0.0},
    "all right in all groups": {"drawn_unsolved_share": 0.0, "drawn_idle_share": 0.0},
    "constant groups, and answers get better": {"drawn_idle_share": 0.4, "drawn_accuracy": 0.75},
    "a lower entropy": {"entropy": 0.035},
    "41 prompts with touch, whose mean is rounded": {"touch_share": 0.99999994},
    "a stream that counts little": {"grounding_stream_1": 1.5e-7},
    "low entropy of right answers": {"entropy": 0.01, "drawn_accuracy": 0.99},
    "low entropy of better answers": {"entropy": 0.01, "drawn_accuracy": 0.85},
    "a costly token, and answers hold": {"kl_cost_peak": 3.0},
    "honest slots of half of the answers, the others have no format": {"accuracy": 0.35},
    "a bonus that hardly any group earns": {"bonus_telling_share": 0.01, "bonus_cancelled_share": 0.01},
}


@pytest.mark.parametrize("change", NO_FAILURE.values(), ids=NO_FAILURE)
def test_silent_where_it_is_no_failure(change):
    assert fired(change) == {}


def test_without_dynamic_sampling_the_groups_are_those_that_are_learned_from():
    monitor = AlarmMonitor()
    plain = {name: value for name, value in HEALTHY.items() if not name.startswith("drawn")}
    for _ in range(WINDOW):
        assert monitor.update(plain) == []
    for _ in range(WINDOW):
        alarms = monitor.update(plain | {"idle_share": 0.4, "accuracy": 0.65})
    assert [(a.code, round(a.value, 6)) for a in alarms] == [("F7", 0.8)]


def test_a_single_batch_without_touch_is_reported_at_once():
    monitor = AlarmMonitor()
    assert monitor.update(HEALTHY) == []
    assert [a.code for a in monitor.update(HEALTHY | {"touch_share": 0.0})] == ["F10"]
    assert monitor.update(HEALTHY) == []


@pytest.mark.parametrize("share", [0.0, 0.75])
def test_candidates_without_touch_are_reported_though_others_are_selected(share):
    assert [a.code for a in AlarmMonitor().update(HEALTHY | {"drawn_touch_share": share})] == ["F10"]


def test_a_score_that_stands_on_some_lines_stops_no_check():
    """As on the steps with a checkpoint: the line that has it may be the first of a window or not."""
    monitor = AlarmMonitor()
    broken = HEALTHY | {"entropy": 0.0, "drawn_accuracy": 0.2}
    for t in range(2 * WINDOW):
        scored = {"held_out": 0.5} if t % 5 == 4 else {}
        alarms = monitor.update((HEALTHY if t < WINDOW else broken) | scored)
    assert {a.code for a in alarms} == set(fired(broken))
    assert alarms


def test_updates_that_are_left_out_are_counted_over_a_window():
    """Their metrics are not judged, and one in twenty is no alarm."""
    monitor = AlarmMonitor()
    assert monitor.update({}, left_out=True) == monitor.update({"lost_updates": 1.0}) == []
    (alarm,) = monitor.update({}, left_out=True)
    assert (alarm.code, alarm.value) == ("F15", 3 / WINDOW)
    assert [a.code for _ in range(WINDOW) for a in monitor.update(HEALTHY)] == ["F15"] * (WINDOW - 3)


def test_honest_slots_never_agree_oftener_than_they_are_right():
    """Two that are right with probability a each for itself, and else err either way; at ⅓ and at 1 just as often."""
    a = np.linspace(1 / 3, 1, 50)
    agree = a**2 + (1 - a) ** 2 / 2
    assert (agree <= a + 1e-12).all()
    excess = [echo_excess({"echo_share": e, "echo_right": x}, {}) for e, x in zip(agree, a, strict=True)]
    np.testing.assert_allclose([excess[0], excess[-1]], 0, atol=1e-12)


def test_a_lucky_first_step_is_not_the_beginning():
    """One step of 8 prompts is right by chance in .95 where the policy is in .7."""
    monitor = AlarmMonitor()
    lucky = HEALTHY | {"drawn_accuracy": 0.95}
    costly = HEALTHY | {"kl_cost_peak": 3.0}
    assert all(monitor.update(m) == [] for m in [lucky, *[costly] * (2 * WINDOW)])


def test_credit_for_a_lead_that_is_chance_is_unearned():
    assert set(fired({"lead_drop": 0.03})) == {"F6"}
    assert fired({"lead_drop": 0.05}) == {}


def test_a_run_without_controls_has_no_alarm_of_them():
    monitor = AlarmMonitor()
    plain = {
        name: value for name, value in HEALTHY.items() if not name.startswith(("control", "lead", "tactile", "touch"))
    }
    assert all(monitor.update(plain) == [] for _ in range(2 * WINDOW))


def test_a_control_that_does_not_apply_says_nothing():
    """A shuffle of what has no order leaves touch as it was."""
    assert fired({"lead_order": 0.0, "control_order_share": 0.0}) == {}
    assert set(fired({"lead_order": 0.0})) == {"F4", "F6"}


def test_an_alarm_says_what_fired():
    failing = HEALTHY | {"drawn_idle_share": 0.4, "drawn_accuracy": 0.65}
    (alarm,) = (a for a in [RULES[6].alarm(failing, HEALTHY)] if a)
    assert str(alarm) == f"alarm F7: {alarm.meaning} (0.8, bound 0.5)"
