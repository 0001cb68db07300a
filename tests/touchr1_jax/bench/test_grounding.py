"""TUG and its minimum, conflict accuracy and revision rate by hand values and identities."""

import numpy as np
import pytest

from touchr1_jax.bench import grounding
from touchr1_jax.bench.metrics import accuracy
from touchr1_jax.bench.statistics import clustered_bootstrap

LABEL = np.array([0, 1, 2, 1])
OBJECTS = np.array(["a", "a", "b", "c"])


def scores(*answers):
    return accuracy(np.array(answers), LABEL)


def controls(**given):
    return {name: given.get(name, scores(-1, -1, -1, -1)) for name in grounding.CONTROLS}


def test_gain_by_hand():
    gain = grounding.tactile_use_gain(scores(0, 1, 2, 1), scores(0, 0, 0, 0))
    assert gain.mean() == 75.0
    assert gain.values.tolist() == [0.0, 100.0, 100.0, 100.0]


def test_gain_needs_the_same_questions():
    with pytest.raises(ValueError, match="same answers"):
        grounding.tactile_use_gain(scores(0, 1, 2, 1), accuracy(np.zeros(3, int), np.zeros(3, int)))


def test_the_least_gain_is_over_the_control_that_does_best():
    real = scores(0, 1, 2, 0)  # 75 %
    found = grounding.least_tactile_use(
        real, controls(noise=scores(0, 1, 0, 0)), np.zeros(4, bool), OBJECTS, resamples=200
    )
    assert found.control == "noise"
    assert found.gain.mean == 25.0
    assert found.gain.low <= 25.0 <= found.gain.high


def test_shuffled_frames_count_only_where_order_matters():
    real = scores(0, 1, 2, 1)
    still = controls(shuffle=scores(0, 1, 2, 1))  # a shuffled press tells as much
    nothing = grounding.least_tactile_use(real, still, np.zeros(4, bool), OBJECTS, resamples=50)
    assert nothing.control != "shuffle"
    assert nothing.gain.mean == 100.0
    one = grounding.least_tactile_use(real, still, np.array([False, False, True, False]), OBJECTS, resamples=50)
    assert (one.control, one.gain.mean) == ("shuffle", 0.0)


def test_the_interval_of_equal_controls_is_that_of_one():
    real, control = scores(0, 1, 2, 1), scores(0, 0, 2, 0)
    found = grounding.least_tactile_use(
        real, dict.fromkeys(grounding.CONTROLS, control), np.ones(4, bool), OBJECTS, resamples=500
    )
    alone = clustered_bootstrap(real.values - control.values, OBJECTS, resamples=500)
    assert (found.gain.mean, found.gain.low, found.gain.high) == pytest.approx((alone.mean, alone.low, alone.high))


def test_every_control_is_asked_for():
    with pytest.raises(ValueError, match="must be drop, shuffle, noise, swapped"):
        grounding.least_tactile_use(scores(0, 1, 2, 1), {"drop": scores(0, 0, 0, 0)}, np.ones(4, bool), OBJECTS)
    with pytest.raises(ValueError, match="objects holds 1"):
        grounding.least_tactile_use(scores(0, 1, 2, 1), controls(), np.ones(4, bool), np.zeros(4))


def test_conflict_and_revision_by_hand():
    label = np.array([0, 1, 2, 2, 1, 0])
    prior = np.array([1, 1, 0, 0, -1, 2])  # conflicts are questions 0, 2, 3 and 5
    answer = np.array([0, 1, 1, 0, 1, -1])
    assert grounding.conflict_accuracy(answer, label, prior).mean() == pytest.approx(25)
    assert grounding.revision_rate(answer, label, prior).mean() == pytest.approx(50)
    assert grounding.conflict_accuracy(answer, label, prior).items.tolist() == [0, 2, 3, 5]
