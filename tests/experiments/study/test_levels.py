"""Confusions, reliability and agreement by hand: questions not asked and answers not parsed count where they should."""

import numpy as np
import pytest

from experiments.study.levels import (
    LevelAnswers,
    accuracy_by_agreement,
    agreement_chart,
    confusion_chart,
    confusion_map,
    reliability_table,
)

WORDS = {"hardness": ("soft", "hard")}
ANSWERS = LevelAnswers(
    answer=np.array([[0], [0], [1], [-1], [1], [0]]),
    label=np.array([[0], [1], [1], [1], [-1], [0]]),  # the fifth was not asked
    objects=np.array(["a", "b", "c", "d", "e", "e"]),
    agree=np.array([[4], [1], [4], [0], [2], [1]]),
)


def test_reliability_by_hand():
    table = reliability_table({"sft": ANSWERS}, WORDS)
    rows = {row[0]: row[1:] for row in table.rows}
    answered, right, found = rows["sft: hardness soft"]
    assert answered == pytest.approx(60)  # three of the five asked
    assert str(right).startswith("66.7 [")  # of three "soft" two are soft
    assert str(found).startswith("100.0 [")
    answered, right, found = rows["sft: hardness hard"]
    assert answered == pytest.approx(20)
    assert right is None  # answered about one object: no interval over objects
    assert str(found).startswith("33.3 [")  # of three that are hard one was read as soft, one not at all


def test_confusions_are_shares_of_each_label():
    """Two soft ones read as soft; of three hard ones one was read as soft, one as hard, one not at all."""
    found = confusion_map(ANSWERS.answer[:, 0], ANSWERS.label[:, 0], WORDS["hardness"], "hardness")
    np.testing.assert_allclose(found.values, [[1, 0, 0], [1 / 3, 1 / 3, 1 / 3]])
    assert list(found.columns) == ["soft", "hard", "unread"]


def test_accuracy_by_agreement_by_hand():
    counts, right, weight = accuracy_by_agreement(ANSWERS)
    assert counts == [1, 4]  # two objects each; unread and not asked are left out
    assert [r.mean for r in right] == [50.0, 100.0]
    np.testing.assert_allclose(weight, [0.5, 0.5])
    with pytest.raises(ValueError, match="ask with each sensor alone"):
        accuracy_by_agreement(LevelAnswers(answer=ANSWERS.answer, label=ANSWERS.label, objects=ANSWERS.objects))


def test_charts_name_what_they_show():
    confusions = confusion_chart({"sft": ANSWERS, "blind": ANSWERS}, WORDS)
    assert confusions == confusion_chart({"sft": ANSWERS, "blind": ANSWERS}, WORDS)
    read = LevelAnswers(answer=np.maximum(ANSWERS.answer, 0), label=ANSWERS.label, objects=ANSWERS.objects)
    assert confusions != confusion_chart({"sft": read, "blind": read}, WORDS)
    assert b"<svg" in agreement_chart({"sft": ANSWERS})
