"""Folds by object, weights, scores."""

import numpy as np
import pytest

from experiments.recordings.limits import agreement
from experiments.recordings.policy import COMBINATIONS, choose, utility
from experiments.recordings.validation import Row, constants, deal_folds, object_weights, score_table, scores

OBJECTS = np.repeat([f"o{i}" for i in range(12)], 3)
LABEL = np.repeat(np.array([[i % 3, (i // 3) % 3, 1] for i in range(12)]), 3, axis=0)


def test_an_object_is_in_one_fold_whatever_the_order():
    fold = deal_folds(OBJECTS, LABEL, 4, 0)
    assert all(len(set(fold[name == OBJECTS])) == 1 for name in set(OBJECTS))
    assert np.bincount(fold).tolist() == [9, 9, 9, 9]
    order = np.random.default_rng(0).permutation(len(OBJECTS))
    np.testing.assert_array_equal(deal_folds(OBJECTS[order], LABEL[order], 4, 0), fold[order])
    assert (deal_folds(OBJECTS, LABEL, 4, 1) != fold).any()
    with pytest.raises(ValueError, match="folds is 13"):
        deal_folds(OBJECTS, LABEL, 13, 0)


def test_every_object_weighs_the_same():
    objects = np.array(["a", "a", "b", "c"])
    assert object_weights(objects, np.array([True, True, True, False])).tolist() == [0.5, 0.5, 1.0, 0.0]


def test_scores_by_hand():
    label = np.array([[0, 1, 2], [2, 2, 2]])
    answer = np.array([[0, 1, 2], [0, 2, 1]])
    found = {name: score.mean() for name, score in scores(answer, label).items()}
    assert found["all right"] == 50
    assert found["mean"] == pytest.approx(100 * 4 / 6)
    assert found["OMAE"] == pytest.approx(0.5)
    assert (found["hardness"], found["roughness"], found["protrusion"]) == (50, 100, 50)


def test_constants_are_the_training_modes():
    fold = np.where(np.isin(OBJECTS, ["o0", "o3"]), 0, 1)
    answers = constants(LABEL, OBJECTS, fold)
    assert set(map(tuple, answers["constant, each attribute's mode"][fold == 0])) == {(1, 0, 1)}
    assert all((rows[:, 2] == 1).all() for rows in answers.values())


def test_a_table_has_a_line_for_each_method():
    table = score_table("t", [Row(name="right", answer=LABEL)], LABEL, OBJECTS)
    assert table.rows[0][:3] == ("right", 100.0, "100.0–100.0")


def test_agreement_counts_pairs_of_one_object():
    answer = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 2, 2]])
    assert agreement(answer, np.array(["a", "a", "a", "b"])) == pytest.approx(100 / 3)


def test_the_choice_earns_most():
    u = utility()
    np.testing.assert_allclose(np.diag(u), 2.0)
    assert u[0, 26] == pytest.approx(-2.0)
    p = np.full(27, 1e-9)
    p[[0, 26]] = 0.5, 0.5
    chosen = choose(np.log(p)[None] - np.log(p.sum()), u)[0]
    assert COMBINATIONS.tolist().index(chosen.tolist()) in (0, 26)
