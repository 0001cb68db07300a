"""The arithmetic of the paper's audit by hand values."""

import numpy as np
import pytest
from scipy import stats

from experiments.bench import paper_arithmetic, paper_checks
from experiments.study import paper_numbers


def test_every_known_inconsistency_shows_and_every_other_statement_holds():
    assert {c.title: c.verdict for c in paper_checks.inconsistencies() if c.verdict == "holds"} == {}
    assert {c.title: c.verdict for c in paper_checks.holding() if c.verdict != "holds"} == {}


def test_rows_have_all_columns():
    assert {len(row) for row, _ in paper_numbers.MAIN.values()} == {len(paper_numbers.COLUMNS)}
    assert {len(row) for row, _ in paper_numbers.VTV.values()} == {len(paper_numbers.VTV_COLUMNS)}


def test_weights_that_exist_are_found(monkeypatch):
    """An Avg that is a weighting of the columns is recognised: with it, nothing is missed."""
    low, high, _ = paper_arithmetic.columns_as_scores()
    weights = np.arange(9) / 36
    made = {
        name: (row, round(float(x), 1))
        for (name, (row, _)), x in zip(paper_numbers.MAIN.items(), (low + high) / 2 @ weights, strict=True)
    }
    monkeypatch.setattr(paper_numbers, "MAIN", made)
    assert paper_arithmetic.best_weighting(sum_to_one=True).miss <= 1e-9
    assert paper_checks.inconsistencies()[0].verdict == "holds"


def test_the_best_weights_keep_their_promise():
    best = paper_arithmetic.best_weighting(sum_to_one=True)
    assert best.weights.min() >= -1e-9
    assert best.weights.sum() == pytest.approx(1)
    low, high, average = paper_arithmetic.columns_as_scores()
    miss = np.maximum(low @ best.weights - average, average - high @ best.weights) - paper_arithmetic.SHARE_ROUNDING
    assert miss.max() == pytest.approx(best.miss, abs=1e-6)


def test_touch_r1s_distance_is_impossible_and_gpt4os_is_not():
    impossible = paper_arithmetic.impossible_distances()
    assert "Touch-R1-7B" in impossible
    assert "GPT-4o" not in impossible
    error, omae = paper_arithmetic.error_and_distance()["Touch-R1-7B"]
    assert error == pytest.approx(1 - (76.8 + 68.4 + 65.1) / 300)
    assert omae == 0.24


def test_gain_interval_by_hand():
    gain, half, p = paper_arithmetic.gain_interval(60.0, 50.0, 100)
    assert gain == pytest.approx(10)
    assert half == pytest.approx(196 * np.sqrt((0.24 + 0.25) / 100))
    assert p == pytest.approx(stats.chi2_contingency([[60, 40], [50, 50]], correction=False).pvalue)


def test_shares_that_counts_give():
    assert paper_arithmetic.attainable(73.9, 138)  # 102 of 138
    assert paper_arithmetic.attainable(34.7, 138)  # 48 of 138 is 34.78, cut off
    assert not paper_arithmetic.attainable(78.6, 138)  # 108 give 78.26, 109 give 78.99
    assert paper_arithmetic.attainable(0.0, 138)
    assert paper_arithmetic.attainable(100.0, 138)
