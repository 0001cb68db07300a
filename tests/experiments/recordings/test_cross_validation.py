"""Folds by object, weights, scores, and limits of the answers, by hand."""

import math

import numpy as np
import pytest

from experiments.recordings.cross_validation import agreement, constants, deal_folds, objects_for, scores, vote
from touchr1_jax.models.description_policy import COMBINATIONS, choose, utility

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


def test_scores_by_hand():
    label, answer = np.array([[0, 1, 2], [2, 2, 2]]), np.array([[0, 1, 2], [0, 2, 1]])
    found = {name: score.mean() for name, score in scores(answer, label).items()}
    assert found == pytest.approx(
        {"all right": 50, "mean": 100 * 4 / 6, "OMAE": 0.5, "hardness": 50, "roughness": 100, "protrusion": 50}
    )


def test_constants_are_the_training_modes():
    fold = np.where(np.isin(OBJECTS, ["o0", "o3"]), 0, 1)
    answers = constants(LABEL, OBJECTS, fold)
    assert set(map(tuple, answers["constant, each attribute's mode"][fold == 0])) == {(1, 0, 1)}
    assert all((rows[:, 2] == 1).all() for rows in answers.values())


def test_the_choice_has_the_highest_expected_utility():
    np.testing.assert_allclose(np.diag(utility()), 2.0)
    assert utility()[0, 26] == pytest.approx(-2.0)
    p = np.full(27, 1e-9)
    p[[0, 26]] = 0.5, 0.5
    assert COMBINATIONS.tolist().index(choose(np.log(p)[None])[0].tolist()) in (0, 26)


@pytest.mark.parametrize(
    ("errors", "bound", "objects"),
    [
        pytest.param({n: 80 * n**-0.5 for n in (4, 16, 64)}, 5.0, 256, id="the power law is continued"),
        pytest.param({4: 30.0, 8: 0.0, 16: 0.0}, 25.0, 8, id="a measured point is not extrapolated"),
        pytest.param({10: 30.0, 20: 31.0}, 25.0, math.inf, id="an error that does not fall"),
    ],
)
def test_objects_that_a_bound_needs(errors, bound, objects):
    assert objects_for(errors, bound) == pytest.approx(objects)


def test_the_vote_of_an_object_is_the_most_frequent_answer():
    answer = np.array([[0, 2], [1, 2], [1, 0], [2, 1], [0, 1]])
    objects = np.array(["a", "a", "a", "b", "b"])
    np.testing.assert_array_equal(vote(answer, objects), [[1, 2], [1, 2], [1, 2], [0, 1], [0, 1]])
    assert agreement(vote(answer, objects), objects) == 100


@pytest.mark.parametrize(
    ("answer", "alike"), [([0, 0, 1, 2], 100 / 3), ([0, 1, 2, 0], 0)], ids=["one pair of three", "none"]
)
def test_agreement_counts_pairs_of_one_object(answer, alike):
    assert agreement(np.array(answer)[:, None] * [1, 0], np.array(["a", "a", "a", "b"])) == pytest.approx(alike)
