"""Folds by object, weights, scores, and limits of the answers, by hand."""

import numpy as np
import pytest

from experiments.recordings.cross_validation import (
    agreement,
    confidence,
    constants,
    deal_folds,
    joint_log_prob,
    logistic,
    marginals,
    people,
    pool,
    scores,
)
from experiments.recordings.descriptions import DescribedVideos
from experiments.recordings.findings import JudgedAnswers, gains
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


def test_pooled_videos_answer_with_the_median_level():
    p = np.full((3, 3, 3), 1 / 3)
    p[0, 0], p[1, 0], p[2, 0] = (0.6, 0.3, 0.1), (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)
    log_prob = joint_log_prob(p, sharpness=1.0)
    np.testing.assert_allclose(marginals(log_prob), p)
    middle = np.array([0.6, 0.1, 0.1])
    pooled = marginals(pool(log_prob, np.array(["a", "a", "a"])))
    np.testing.assert_allclose(pooled[:, 0], np.tile(middle / middle.sum(), (3, 1)))
    np.testing.assert_allclose(marginals(pool(log_prob, np.array(["a", "b", "c"]))), p)


def test_the_surest_answers_are_those_of_the_least_expected_distance():
    """Of the probabilities before they were sharpened: 1 · .01 + 2 · .01 levels from 0, (1 + 0 + 1) / 3 from 1."""
    p = np.full((4, 3, 3), 1 / 3)
    p[1], p[3] = (0.98, 0.01, 0.01), (0.01, 0.01, 0.98)
    log_prob = joint_log_prob(p)
    np.testing.assert_allclose(confidence(choose(log_prob), log_prob), [-2 / 3, -0.03, -2 / 3, -0.03])
    label = np.array([[1, 1, 1], [0, 0, 0], [1, 1, 1], [2, 2, 0]])
    rows = {name: np.stack([log_prob] * 2) for name in ("log_prob", "evidence")}
    answers = JudgedAnswers(**rows, label=label, objects=np.array(["a", "b", "a", "b"]))
    assert answers.surest(0.5).tolist() == [False, True, False, True] * 2
    same = gains(answers, answers)["mean"]
    assert (same.mean, same.low, same.high) == (0, 0, 0)


def test_logistic_regression_and_people_find_what_determines_the_level(monkeypatch):
    monkeypatch.setattr("experiments.recordings.cross_validation.PENALTY", 1.0)
    noise = np.random.default_rng(0).standard_normal((len(LABEL), 3))
    videos = DescribedVideos(
        names=np.arange(len(LABEL)).astype(str),
        objects=OBJECTS,
        label=LABEL,
        x=np.concatenate([LABEL, LABEL], 1) + 0.1 * np.tile(noise, 2),
        rating=np.stack([4.0 * LABEL[:, 0], 4.0 * LABEL[:, 1], np.full(len(LABEL), np.nan)], 1),
    )
    found = logistic(videos, deal_folds(OBJECTS, LABEL, 4, 0))
    assert (choose(found)[:, :2] == LABEL[:, :2]).mean() > 0.7
    said = people(videos)
    assert sorted(said) == [0, 1]
    assert (said[0] == LABEL[:, 0]).mean() > 0.9


@pytest.mark.parametrize(
    ("answer", "alike"), [([0, 0, 1, 2], 100 / 3), ([0, 1, 2, 0], 0)], ids=["one pair of three", "none"]
)
def test_agreement_counts_pairs_of_one_object(answer, alike):
    assert agreement(np.array(answer)[:, None] * [1, 0], np.array(["a", "a", "a", "b"])) == pytest.approx(alike)
