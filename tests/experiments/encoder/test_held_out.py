"""Skill and points with intervals over objects."""

import numpy as np
import pytest

from experiments.encoder.held_out import points, skill


def test_skill_is_a_ratio_of_sums():
    error, reference = np.array([1.0, 3.0, 2.0, 2.0]), np.array([2.0, 4.0, 6.0, 4.0])
    found = skill(error, reference, np.array(["a", "a", "b", "c"]))
    np.testing.assert_allclose(found.mean, 1 - 8 / 16)
    assert 1 - 4 / 6 - 1e-9 <= found.low <= found.mean <= found.high <= 1 - 2 / 6 + 1e-9  # objects alone: 1/3, 2/3, 1/2


def test_contacts_of_one_object_are_resampled_together():
    """Two objects of opposite skill: many contacts of each make the interval no narrower."""
    found = skill(np.repeat([0.0, 2.0], 500), np.ones(1000), np.repeat([0, 1], 500))
    assert (found.low, found.high) == (-1.0, 1.0)


def test_a_reference_without_error_is_refused():
    with pytest.raises(ValueError, match=r"reference sums to 0\.0: must be > 0"):
        skill(np.ones(2), np.zeros(2), np.arange(2))


def test_points_pool_attributes_by_object():
    found = points(np.array([[True, False], [True, True], [False, False]]), np.array([0, 0, 1]))
    assert (found.mean, found.low, found.high) == (50, 0, 75)
