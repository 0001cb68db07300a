"""What the coach answers to given forces, step by step."""

import numpy as np
import pytest

from sensors_io.recording.coach import Coach, CoachConfig, ContactStage, protocol
from sensors_io.schema import Phase
from tests.sensors_io.checks import refused

CONFIG = CoachConfig(clear_s=0.1, settle_s=0.1, hold_s=0.2, move_s=0.2)


def led(stage, normals, config=CONFIG):
    """Advice to normal forces 50 ms apart."""
    coach = Coach(stage, config)
    return [coach.step(k * 50_000_000, np.array([0, 0, -n])) for k, n in enumerate(normals)]


def test_a_press_begins_at_first_touch_and_ends_at_its_force():
    advice = led(ContactStage(motion="press", force_n=20), [0, 0, 0, 0.05, 0.2, 10, 18.9, 19.0, 19.5])
    assert [a.phase for a in advice] == [Phase.APPROACH] * 4 + [Phase.LOAD] * 5
    assert [a.recording for a in advice] == [False, False] + [True] * 5 + [False, False]
    assert [a.done for a in advice] == [False] * 7 + [True, True]
    assert advice[-1].complete


def test_a_slide_goes_through_all_phases():
    normals = [0, 0, 0, 1, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1, 0.0]
    phases = [a.phase for a in led(ContactStage(motion="slide_x", force_n=2), normals)]
    assert phases == [0, 0, 0, 1, 2, 2, 4, 4, 4, 4, 3, 3, 3, 3, 3]


def test_a_tap_takes_three():
    normals = [0, 0, 0] + [1, 2, 1, 0] * 3
    advice = led(ContactStage(motion="tap", force_n=2), normals)
    assert [a.done for a in advice].index(True) == len(normals) - 1


@pytest.mark.parametrize("at", [1, 3, 6, 8])
def test_a_force_that_is_not_finite_changes_nothing(at):
    """Before the contact is armed, before the first touch, at the force and while the hand lets go."""
    normals = [0, 0, 0, 0, 1, 2, 2, 2, 2, 2, 1, 0]
    advice = led(ContactStage(motion="tap", force_n=2), [*normals[:at], np.nan, *normals[at:]])
    assert [a.phase for a in advice[:at] + advice[at + 1 :]] == [
        a.phase for a in led(ContactStage(motion="tap", force_n=2), normals)
    ]
    assert advice[at].normal_n == advice[at - 1].normal_n
    assert not any(a.done for a in advice)


def test_a_force_from_before_the_touch_that_comes_late_is_no_letting_go():
    coach = Coach(ContactStage(motion="press", force_n=20), CONFIG)
    forces = [(0, 0), (50, 0), (100, 0), (150, 0), (200, 5), (180, 0), (250, 10), (300, 20)]
    advice = [coach.step(ms * 1_000_000, np.array([0, 0, -n])) for ms, n in forces]
    assert [a.done for a in advice] == [False] * 7 + [True]
    assert advice[5].normal_n == 5  # what is shown does not go back either
    assert advice[-1].complete


@pytest.mark.parametrize(("motion", "at"), [("press", 400), ("hold", 700), ("hold", 1600), ("tap", 300)])
@pytest.mark.parametrize("wrong_n", [100.0, -100.0])
def test_one_wrong_reading_is_neither_a_press_nor_a_release(motion, at, wrong_n):
    """One of 500 a second, while the hand presses, holds, and lets go; what is right comes 4 ms later."""
    up, down = np.linspace(0, 20, 700), np.linspace(20, 0, 700)
    normals = np.concatenate([np.zeros(200), up, np.full(300, 20.0), down, np.zeros(20)])
    ends = []
    for wrong in (None, at):
        given = normals.copy()
        given[[] if wrong is None else wrong] = wrong_n
        coach = Coach(ContactStage(motion=motion, force_n=20), CONFIG)
        advice = [coach.step(2_000_000 * k, np.array([0, 0, -n])) for k, n in enumerate(given)]
        ends.append([(a.phase, a.done) for a in advice])
        assert not any(a.prompt.startswith("STOP") for a in advice)
    differing = [k for k, (right, disturbed) in enumerate(zip(*ends, strict=True)) if right != disturbed]
    assert len(differing) <= 2


def test_nothing_begins_while_something_touches():
    assert not any(a.recording for a in led(ContactStage(motion="press", force_n=20), [5] * 20))


def test_letting_go_early_ends_the_contact_incomplete():
    last = led(ContactStage(motion="hold", force_n=2), [0, 0, 0, 1, 2, 2, 0])[-1]
    assert (last.done, last.complete) == (True, False)


@pytest.mark.parametrize(("normal", "word"), [(23.0, "STOP"), (7.0, "less")])
def test_too_much_force_is_told(normal, word):
    assert led(ContactStage(motion="hold", force_n=5), [0, 0, 0, 1, 5, normal])[-1].prompt.startswith(word)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"reached_share": 1.5}, "reached_share is 1.5: must be ≤ 1"),
        ({"touch_n": 1.9}, "touch_n is 1.9: must lie between 0 and 1.9 N"),
        ({"overload_n": 19.0}, "overload_n is 19.0: must lie between 19 and inf N"),
    ],
)
def test_thresholds_by_which_no_contact_ends_are_refused(given, said):
    refused(ValueError, said, CoachConfig, **given)


def test_the_protocol_is_a_press_and_six_motions_at_three_forces():
    stages = protocol()
    assert stages[0] == ContactStage(motion="press", force_n=20.0)
    assert len(set(stages)) == 19
    assert {s.force_n for s in stages[1:]} == {2.0, 5.0, 10.0}


def test_thresholds_are_checked():
    refused(ValueError, "touch_n is 0: must be > 0", CoachConfig, touch_n=0)
