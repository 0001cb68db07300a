"""Confusions, reliability and trust by hand: what is not asked or not read counts where it should."""

import numpy as np
import pytest

from experiments.core.levels import Levels, confusion_chart, reliability_table, trust, trust_chart

WORDS = {"hardness": ("soft", "hard")}
SAID = Levels(
    answer=np.array([[0], [0], [1], [-1], [1], [0]]),
    label=np.array([[0], [1], [1], [1], [-1], [0]]),  # the fifth was not asked
    objects=np.array(["a", "b", "c", "d", "e", "e"]),
    agree=np.array([[4], [1], [4], [0], [2], [1]]),
)


def test_reliability_by_hand():
    table = reliability_table({"sft": SAID}, WORDS)
    rows = {row[0]: row[1:] for row in table.rows}
    answered, right, found = rows["sft: hardness soft"]
    assert answered == pytest.approx(60)  # three of the five asked
    assert str(right).startswith("66.7 [")  # of three "soft" two are soft
    assert str(found).startswith("100.0 [")
    answered, right, found = rows["sft: hardness hard"]
    assert answered == pytest.approx(20)
    assert right is None  # answered about one object: no interval over objects
    assert str(found).startswith("33.3 [")  # of three that are hard one was read as soft, one not at all


def test_trust_by_hand():
    counts, right, weight = trust(SAID)
    assert counts == [1, 4]  # two objects each; unread and not asked are left out
    assert [r.mean for r in right] == [50.0, 100.0]
    np.testing.assert_allclose(weight, [0.5, 0.5])


def test_trust_needs_single_sensors():
    with pytest.raises(ValueError, match="ask each sensor alone"):
        trust(Levels(answer=SAID.answer, label=SAID.label, objects=SAID.objects))


def test_charts_name_what_they_show():
    confusions = confusion_chart({"sft": SAID, "blind": SAID}, WORDS)
    assert confusions == confusion_chart({"sft": SAID, "blind": SAID}, WORDS)
    read = Levels(answer=np.maximum(SAID.answer, 0), label=SAID.label, objects=SAID.objects)
    assert confusions != confusion_chart({"sft": read, "blind": read}, WORDS)
    assert b"<svg" in trust_chart({"sft": SAID})
