"""The audit of the paper: its arithmetic by hand values, and the whole report."""

import numpy as np
import pytest
from scipy import stats

from experiments.bench import paper_checks


def test_every_known_inconsistency_shows_and_every_other_statement_holds():
    assert {c.title for c in paper_checks.inconsistencies() if c.verdict == "holds"} == set()
    assert {c.title for c in paper_checks.confirmed() if c.verdict != "holds"} == set()


def test_the_best_weights_keep_their_promise():
    weights, miss = paper_checks.best_weighting()
    assert weights.min() >= -1e-9
    assert weights.sum() == pytest.approx(1)
    low, high, average = paper_checks.columns_as_scores()
    misses = np.maximum(low @ weights - average, average - high @ weights) - paper_checks.SHARE_ROUNDING
    assert misses.max() == pytest.approx(miss, abs=1e-6)


def test_touch_r1s_distance_is_impossible_and_gpt4os_is_not():
    impossible = paper_checks.impossible_distances()
    assert "Touch-R1-7B" in impossible
    assert "GPT-4o" not in impossible
    error, omae = paper_checks.error_and_distance()["Touch-R1-7B"]
    assert error == pytest.approx(1 - (76.8 + 68.4 + 65.1) / 300)
    assert omae == 0.24


def test_gain_interval_by_hand():
    gain, half, p = paper_checks.gain_interval(60.0, 50.0, 100)
    assert gain == pytest.approx(10)
    assert half == pytest.approx(196 * np.sqrt((0.24 + 0.25) / 100))
    assert p == pytest.approx(stats.chi2_contingency([[60, 40], [50, 50]], correction=False).pvalue)


@pytest.mark.parametrize(
    ("share", "possible"),
    [(73.9, True), (34.7, True), (78.6, False), (0.0, True), (100.0, True)],
    ids=["102 of 138", "48 of 138 is 34.78, cut off", "108 give 78.26, 109 give 78.99", "none", "all"],
)
def test_shares_that_counts_give(share, possible):
    assert paper_checks.attainable(share, 138) is possible
