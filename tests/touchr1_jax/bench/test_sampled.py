"""Metrics of sampled answers by hand and by enumeration."""

import itertools

import numpy as np
import pytest

from touchr1_jax.bench.sampled import (
    Bin,
    Votes,
    calibration_error,
    decide,
    majority,
    pass_at_k,
    reliability,
    samples_right,
)

LABEL = np.array([[1, -1], [0, -1], [2, 1], [1, -1]])
SAMPLED = np.array(
    [
        [[1, 9], [1, 8], [0, 9], [2, 9]],  # two of four for the right level; what is not asked does not count
        [[2, 0], [2, 0], [0, 0], [2, 0]],  # a wrong majority
        [[2, 0], [2, 1], [2, 1], [-1, 1]],  # both attributes together
        [[-1, 0], [-1, 0], [-1, 0], [-1, 0]],  # nothing could be parsed
    ]
)


def test_a_sample_is_right_in_all_that_is_asked():
    assert samples_right(SAMPLED, LABEL).sum(1).tolist() == [2, 1, 2, 0]
    assert not samples_right(SAMPLED, np.full_like(LABEL, -1)).any()


def test_votes_by_hand():
    votes = majority(SAMPLED, LABEL)
    assert votes.right.tolist() == [True, False, True, False]
    assert votes.confidence.tolist() == [0.5, 0.75, 0.5, 0.0]


def test_the_first_of_equal_answers_wins():
    sampled = np.array([[[2], [1], [1], [2]]])
    assert majority(sampled, np.array([[2]])).right.tolist() == [True]
    assert majority(sampled[:, ::-1][:, 1:], np.array([[1]])).right.tolist() == [True]


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_pass_at_k_is_the_share_of_all_choices_of_k_that_hold_a_right_one(k):
    right = samples_right(SAMPLED, LABEL)
    chosen = [list(c) for c in itertools.combinations(range(4), k)]
    np.testing.assert_allclose(pass_at_k(right, k), np.mean([right[:, c].any(1) for c in chosen], 0), atol=1e-12)


@pytest.mark.parametrize("k", [0, 5])
def test_more_than_there_are_samples_is_refused(k):
    with pytest.raises(ValueError, match=f"k is {k}: must be 1 … 4"):
        pass_at_k(samples_right(SAMPLED, LABEL), k)


SHARES = np.array([[0.4, 0.3, 0.3], [0.5, 0.0, 0.5], [0.1, 0.2, 0.7], [0.45, 0.1, 0.45], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("rule", "level"), [("argmax", [0, 0, 2, 0, -1]), ("median", [1, 0, 2, 1, -1]), ("expected", [1, 1, 2, 1, -1])]
)
def test_a_rule_decides_by_hand_and_whatever_the_scale(rule, level):
    assert decide(SHARES, rule).tolist() == decide(3 * SHARES, rule).tolist() == level


@pytest.mark.parametrize(("rule", "power"), [("median", 1), ("expected", 2)])
def test_a_rule_has_the_least_expected_error(rule, power):
    share = np.random.default_rng(0).dirichlet(np.ones(4), 200)
    error = (np.abs(np.arange(4)[:, None] - np.arange(4)) ** power) @ share.T  # [answer, N]
    chosen = decide(share, rule)
    np.testing.assert_allclose(error[chosen, np.arange(200)], error.min(0), atol=1e-9)


def test_calibration_by_hand():
    """Two certain answers, one of them wrong, and two of even votes, both right."""
    votes = Votes(right=np.array([True, False, True, True]), confidence=np.array([1.0, 1.0, 0.5, 0.5]))
    assert reliability(votes) == (Bin(0.5, 1.0, 2), Bin(1.0, 0.5, 2))
    assert calibration_error(votes) == 0.5
    assert calibration_error(Votes(right=np.array([True, False]), confidence=np.array([0.5, 0.5]))) == 0
    edge = Votes(right=np.array([True, False]), confidence=np.array([29 / 50, 0.585]))  # a bin holds its lower end
    assert [b.number for b in reliability(edge, bins=100)] == [2]
