"""Decision rules by hand: they decide from the distribution over levels, greedy decoding from the trace."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.core.results import Comparison
from experiments.study.controls import RULES, control_sentences, decision_table
from experiments.study.study import CONTINUED
from tests.experiments.study.test_study import TEST, answers_about


def test_a_certain_distribution_is_right_by_every_rule_and_a_silent_trace_two_levels_off():
    said = answers_about(TEST)
    truth = said.label[np.arange(len(said.label)), said.attribute]
    silent = dataclasses.replace(said.parsed, conclude=np.full_like(said.parsed.conclude, -1))
    said = dataclasses.replace(said, parsed=silent, marginal=np.eye(9)[truth])
    data = SimpleNamespace(object_ids=np.arange(5), parts={"test": np.arange(5)})
    (table,) = decision_table(SimpleNamespace(data=data, policies=["sft"], answers={"sft": [said]}))
    rows = {row[0]: row[1:] for row in table.rows}
    assert len(rows) == len(RULES)
    for name, (accuracy, distance, material, middle, expected) in rows.items():
        right = name != "sft, greedy"
        figures = [float(cell.split()[0]) for cell in (accuracy, distance, material)]
        assert figures == ([100, 0, 100] if right else [0, 2, 0])
        assert middle == pytest.approx(100 * 6 / 14 if right else 0)  # of 14 ordinal labels six are the middle one
        assert expected == pytest.approx(100 * 6 / 14)


def test_arms_without_a_difference_from_continued_sft_share_a_sentence():
    def compared(arm, metric, low, high):
        pair = {"metric": metric, "arm": arm, "against": CONTINUED}
        return Comparison(**pair, difference=(low + high) / 2, ci95=(low, high), over="seeds", n=5)

    rows = [compared("a", "acc", 0.1, 0.3), compared("a", "omae", 0.1, 0.3)]  # better in accuracy, worse in OMAE
    rows += [compared(arm, "acc", -0.1, 0.3) for arm in ("b", "c")]
    differs, equal = control_sentences(rows, ["b", "a", "c", "absent"])
    assert differs.index("better in Acc") < differs.index("worse in OMAE")
    assert "no metric of b, c differs" in equal
