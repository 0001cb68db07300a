"""SFD, swap consistency and SOI-ρ by hand values."""

import itertools

import numpy as np
import pytest
from scipy import stats

from touchr1_jax.bench.comparison import ORDERS, order_correlation, swap_consistency, which_has_more


def test_which_has_more_counts_bottom_as_wrong():
    assert which_has_more(np.array([0, 1, -1, 0]), np.array([0, 1, 0, 1])).mean() == 50.0


def test_whoever_always_says_first_is_right_by_half_and_never_consistent():
    label, pair, swapped = np.array([0, 1, 1, 0]), np.array(["a", "a", "b", "b"]), np.array([False, True, False, True])
    first = np.zeros(4, int)
    assert which_has_more(first, label).mean() == 50.0
    assert swap_consistency(first, pair, swapped).mean() == 0.0
    assert swap_consistency(label, pair, swapped).mean() == 100.0
    assert swap_consistency(1 - label, pair, swapped).mean() == 100.0  # consistently wrong


def test_swap_consistency_finds_the_partners_wherever_they_stand():
    pair, swapped = np.array([7, 3, 3, 7]), np.array([True, False, True, False])
    scores = swap_consistency(np.array([1, 0, 0, 0]), pair, swapped)  # pair 3: "first" twice; pair 7: the same object
    assert dict(zip(pair[scores.items], scores.values, strict=True)) == {3: 0.0, 7: 100.0}
    assert swap_consistency(np.array([1, -1, 1, -1]), pair, swapped).mean() == 0.0


def test_a_pair_asked_in_one_order_is_refused():
    with pytest.raises(ValueError, match="pair 'b'"):
        swap_consistency(np.zeros(3, int), np.array(["a", "a", "b"]), np.array([False, True, True]))
    with pytest.raises(ValueError, match="pair 1"):
        swap_consistency(np.zeros(4, int), np.array([0, 0, 1, 1]), np.array([False, True, False, False]))


def test_order_correlation_is_spearmans_over_all_pairs_of_orders():
    said, true = (np.array(side) for side in zip(*itertools.product(range(6), repeat=2), strict=True))
    scores = order_correlation(said, true)
    ranks = [np.argsort(order) for order in ORDERS]
    expected = [stats.spearmanr(ranks[a], ranks[b]).statistic for a, b in zip(said, true, strict=True)]
    assert scores.values == pytest.approx(expected)
    assert set(np.round(scores.values, 9)) == {1.0, 0.5, -0.5, -1.0}
    assert scores.mean() == pytest.approx(0)  # chance


def test_an_unparsable_order_counts_nothing_and_an_unknown_one_is_refused():
    assert order_correlation(np.array([-1, 0]), np.array([0, 0])).values.tolist() == [0.0, 1.0]
    with pytest.raises(ValueError, match="label holds 6"):
        order_correlation(np.array([0]), np.array([6]))
