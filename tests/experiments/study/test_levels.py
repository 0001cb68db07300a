"""Confusions, reliability, agreement and sampled answers by hand; pictures of fields."""

import dataclasses

import numpy as np
import pytest

from experiments.study.examples import SCALE_PX, field_picture
from experiments.study.levels import (
    LevelAnswers,
    accuracy_by_agreement,
    confusion_map,
    reliability_table,
    sampled_table,
)
from tests.experiments.study.test_study import TEST, answers_about

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


def test_an_attribute_that_nobody_labelled_has_no_rows():
    """Before, its share of nothing was NaN, and the run ended when it wrote its results."""
    widened = lambda x, fill: np.concatenate([x, np.full_like(x, fill)], 1)
    both = dataclasses.replace(ANSWERS, answer=widened(ANSWERS.answer, 0), label=widened(ANSWERS.label, -1))
    words = WORDS | {"roughness": ("smooth", "rough")}
    assert reliability_table({"sft": both}, words).rows == reliability_table({"sft": ANSWERS}, WORDS).rows


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


def test_scores_of_sampled_answers():
    """Of the second seed's even votes the first sample, a right one, wins: .5 certain and always right."""
    greedy, wrong = answers_about(TEST), np.array([0, 1, 0, 1])[:, None]
    right = np.repeat(np.where(greedy.label >= 0, greedy.label, 0)[:, None], 4, 1)
    seeds = [dataclasses.replace(greedy, sampled=sampled) for sampled in (right, right + wrong)]
    (row,) = sampled_table({"sft": seeds}, np.arange(len(TEST))).rows
    name, _, once, several, majority, error = row
    assert name == "sft"
    assert [float(cell.split()[0]) for cell in (once, several, majority)] == [75.0, 100.0, 100.0]
    assert error == pytest.approx(25.0)


def test_fields_are_drawn_in_colour_with_arrows(data):
    recorded = data.store.contact(int(data.parts["test"][0]))
    picture = field_picture(recorded["tac3d"])
    assert picture.shape == (192, 192 + SCALE_PX, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    still = dataclasses.replace(recorded["tac3d"], deformation_mm=np.zeros_like(recorded["tac3d"].deformation_mm))
    assert not np.array_equal(field_picture(still), picture)
    bare = dataclasses.replace(
        recorded["tac3d"],
        depth_mm=None,
        deformation_mm=None,
        frames=np.zeros((len(recorded["tac3d"]), 4, 4, 3), np.uint8),
    )
    assert field_picture(bare) is None
