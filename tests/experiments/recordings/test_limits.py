"""What limits the answers, by hand."""

import math

import numpy as np
import pytest

from experiments.recordings.limits import agreement, objects_for, vote


def test_the_power_law_is_continued():
    errors = {n: 80 * n**-0.5 for n in (4, 16, 64)}
    assert objects_for(errors, 5.0) == pytest.approx(256)


def test_what_was_measured_is_not_extrapolated():
    assert objects_for({4: 30.0, 8: 0.0, 16: 0.0}, 25.0) == 8


def test_an_error_that_does_not_fall_needs_infinitely_many():
    assert objects_for({10: 30.0, 20: 31.0}, 25.0) == math.inf


def test_an_object_says_what_most_of_its_videos_say():
    answer = np.array([[0, 2], [1, 2], [1, 0], [2, 1], [0, 1]])
    objects = np.array(["a", "a", "a", "b", "b"])
    np.testing.assert_array_equal(vote(answer, objects), [[1, 2], [1, 2], [1, 2], [0, 1], [0, 1]])
    assert agreement(answer, objects) == 0
    assert agreement(vote(answer, objects), objects) == 100
