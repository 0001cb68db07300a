"""κ and score intervals by hand values."""

import numpy as np
import pytest
from scipy import stats

from touchr1_jax.bench.agreement import cohens_kappa, wilson_interval


def test_kappa_by_hand():
    # 20 yes/yes, 15 no/no, 5 + 10 apart of 50: observed .7, expected .5 (a textbook case)
    a = np.repeat([1, 1, 0, 0], [20, 5, 10, 15])
    b = np.repeat([1, 0, 1, 0], [20, 5, 10, 15])
    assert cohens_kappa(a, b, 2) == pytest.approx(0.4)


def test_kappa_of_equal_independent_and_opposite_raters():
    a = np.array([0, 0, 1, 1, 2, 2])
    assert cohens_kappa(a, a, 3) == 1.0
    assert cohens_kappa(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), 2) == pytest.approx(0)
    assert cohens_kappa(np.array([0, 1]), np.array([1, 0]), 2) == -1.0


def test_quadratic_weights_forgive_the_neighbour():
    a, near, far = np.array([0, 1, 2, 0, 1, 2]), np.array([0, 1, 1, 0, 1, 2]), np.array([0, 1, 0, 0, 1, 2])
    assert cohens_kappa(a, near, 3, weights="quadratic") > cohens_kappa(a, far, 3, weights="quadratic")
    plain = cohens_kappa(a, near, 2 + 1)
    assert cohens_kappa(a, near, 3, weights="quadratic") > plain


@pytest.mark.parametrize(
    ("a", "b", "message"), [([0], [0, 1], "lengths 1 and 2"), ([0, 3], [0, 1], "0 to 3"), ([1, 1], [1, 1], "undefined")]
)
def test_kappa_names_what_is_wrong(a, b, message):
    with pytest.raises(ValueError, match=message):
        cohens_kappa(np.array(a), np.array(b), 3)


def test_wilson_is_scipys():
    for passed, of in ((0, 7), (7, 7), (1832, 2000)):
        ours, known = wilson_interval(passed, of), stats.binomtest(passed, of).proportion_ci(method="wilson")
        assert (ours.low, ours.high) == pytest.approx((known.low, known.high))
    with pytest.raises(ValueError, match="8 of 7"):
        wilson_interval(8, 7)
