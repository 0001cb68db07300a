"""Estimates and comparisons of arms agree with hand values."""

import dataclasses
import math

import numpy as np
import pytest

from experiments.core.errors import ResultsError
from experiments.study.estimates import compare_over_objects, compare_over_seeds, compare_rows, estimate, pooled
from touchr1_jax.bench.metrics import accuracy, ordinal_mae

OBJECTS = np.array(["a", "a", "b"])
LABEL = np.array([0, 1, 2])


def test_estimate_averages_seeds_and_resamples_objects():
    seeds = [accuracy(LABEL, LABEL), accuracy(np.array([0, 1, 0]), LABEL)]
    made = estimate(seeds, OBJECTS)
    assert made.per_seed == (100.0, pytest.approx(200 / 3))
    assert made.mean == pytest.approx(250 / 3)
    assert made.ci95 == (50.0, 100.0)  # two objects, so the ends are theirs


def test_pooling_means_over_seeds_question_by_question():
    one = ordinal_mae(np.array([[0], [1], [0]]), LABEL[:, None], np.array([3]))
    two = dataclasses.replace(one, values=one.values + 2.0)
    assert np.array_equal(pooled([one, two]).values, one.values + 1.0)


def test_comparison_over_seeds_by_hand():
    a, b = (1.0, 2.0, 3.0), (0.0, 0.0, 0.0)
    made = compare_over_seeds("omae", "a", "b", a, b)
    half = 4.302653 * 1.0 / math.sqrt(3)
    assert made.difference == 2.0
    assert made.ci95 == pytest.approx((2 - half, 2 + half), rel=1e-6)
    assert (made.p_value, made.improvement, made.n) == (0.25, 0.0, 3)  # a larger OMAE is no improvement
    assert compare_over_seeds("middle_rate", "a", "b", a, b).improvement is None
    with pytest.raises(ResultsError, match="same seeds"):
        compare_over_seeds("acc", "a", "b", a, b[:2])


@pytest.mark.parametrize("counts", [(3, 2), (1, 3), (4, 2), (3, 1), (3, 3)])
def test_rows_are_compared_seed_by_seed_or_with_the_one_of_a_baseline(counts):
    rows = {name: [{"acc": accuracy(LABEL, LABEL)}] * n for name, n in zip("ab", counts, strict=True)}
    if counts[1] in (1, counts[0]):
        assert [c.over for c in compare_rows("a", "b", ("acc",), rows, OBJECTS)] == ["objects", "seeds"]
        return
    with pytest.raises(ResultsError, match=r"a and b is .*: must have the same seeds; run the missing ones"):
        compare_rows("a", "b", ("acc",), rows, OBJECTS)


def test_comparison_over_objects_is_paired():
    a = [ordinal_mae(np.array([[0], [1], [0]]), LABEL[:, None], np.array([3]))]
    b = [ordinal_mae(np.array([[1], [2], [0]]), LABEL[:, None], np.array([3]))]
    made = compare_over_objects("omae", "a", "b", a, b, OBJECTS)
    assert (made.difference, made.ci95, made.n) == (pytest.approx(-2 / 3), (-1.0, 0.0), 2)
    with pytest.raises(ResultsError, match="same answers"):
        compare_over_objects("omae", "a", "b", a, [accuracy(LABEL[:2], LABEL[:2])], OBJECTS)
