"""Deceptive questions, contrasts of accuracy and gains from touch, by hand values."""

import dataclasses

import numpy as np
import pytest

from experiments.core.errors import ConfigurationError
from experiments.paper.conflict import EXPERIMENT, contrast, deceptive, picture_prior, revision_share, run
from experiments.paper.touch_gain import TouchQuestions, concluded, swap_objects, touch_gain
from sensors_io.schema import ATTRIBUTES
from tests.experiments import tiny
from tests.experiments.study.test_study import TEST, answers_about
from touchr1_jax.bench.grounding import CONTROLS

QUESTIONS = TouchQuestions(
    attribute=np.array([0, 0, 0, 0, 1, 1]),
    label=np.array([0, 1, 2, 0, 1, 2]),
    objects=np.array(["a", "b", "c", "d", "a", "b"]),
    looks_like_another=np.array([True, True, True, False, True, True]),
)
PRIOR = np.array([2, 1, 0, 1, -1, 0])


def test_deceptive_objects_look_like_others_and_suggest_another_level():
    assert deceptive(QUESTIONS, PRIOR).tolist() == [True, False, True, False, False, True]


def test_the_prior_from_pictures_is_the_vote_of_the_other_seeds():
    blind = [np.array([0, 2, -1]), np.array([1, 2, -1]), np.array([1, 0, -1])]
    assert [s.tolist() for s in picture_prior(blind)] == [[1, 0, -1], [0, 0, -1], [0, 2, -1]]
    with pytest.raises(ValueError, match="holds 1 seeds"):
        picture_prior(blind[:1])
    with pytest.raises(ConfigurationError, match="seeds is 1: must be at least 2"):  # before anything is trained
        run(dataclasses.replace(EXPERIMENT.config, seeds=1), None)


def test_a_contrast_counts_each_seeds_own_questions():
    ours, theirs = [QUESTIONS.label, QUESTIONS.label], [PRIOR, PRIOR]
    misled = deceptive(QUESTIONS, PRIOR)
    found = contrast(QUESTIONS, ours, theirs, [misled, misled])
    assert (found.questions, found.ours, found.theirs) == (3, 100, 0)
    assert (found.seeds.mean, found.objects.mean) == (100, 100)
    other = np.array([True, True, False, False, False, False])
    found = contrast(QUESTIONS, ours, theirs, [misled, other])
    assert found.seeds.mean == pytest.approx((100 + 50) / 2)
    with pytest.raises(ValueError, match=r"masks\[1\] holds no question"):
        contrast(QUESTIONS, ours, theirs, [misled, misled & False])


def test_right_answers_revise_the_prior_and_its_copies_do_not():
    assert revision_share(QUESTIONS, [QUESTIONS.label], [PRIOR]) == 100
    assert revision_share(QUESTIONS, [PRIOR], [PRIOR]) == 0


def with_levels(answers, level):
    conclude = np.full_like(answers.parsed.conclude, -1)
    conclude[np.arange(len(level)), answers.attribute] = level
    return dataclasses.replace(answers, parsed=dataclasses.replace(answers.parsed, conclude=conclude))


def test_swapped_touch_is_whole_and_of_another_object():
    encoded = tiny.features(4)
    objects = np.array(["a", "a", "b", "c"])
    swapped = swap_objects(encoded, objects, 0)
    for i in range(4):
        (source,) = (j for j in range(4) if np.array_equal(swapped.touch[i], encoded.touch[j]))
        assert objects[source] != objects[i]
    assert np.array_equal(swapped.view, encoded.view)


def test_the_gain_from_touch_is_what_its_absence_costs():
    answers = answers_about(TEST)
    n = np.arange(len(answers.contact))
    questions = TouchQuestions(
        attribute=answers.attribute,
        label=answers.label[n, answers.attribute],
        objects=np.array(list("vwxyz"))[answers.contact],
        looks_like_another=np.zeros(len(n), bool),
    )
    right = with_levels(answers, questions.label)
    wrong = with_levels(answers, (questions.label + 1) % 3)
    assert np.array_equal(concluded(right), questions.label)
    controls = {"drop": [wrong] * 2, "shuffle": [right] * 2, "noise": [wrong, right], "swapped": [wrong] * 2}
    every, unordered = np.ones(len(n), bool), np.zeros(len(n), bool)
    found = touch_gain(questions, [right, right], controls, unordered, every)
    assert [found.over[name].mean for name in ("drop", "shuffle", "noise", "swapped")] == [100, 0, 50, 100]
    assert (found.least.control, found.least.gain.mean) == ("noise", 50)
    single = {c: controls[c][:1] for c in CONTROLS}
    assert touch_gain(questions, [right], single, ~unordered, every).least.gain.mean == 0
    assert touch_gain(questions, [right], single, unordered, questions.objects == "v") is None
    assert questions.ordinal.tolist() == [ATTRIBUTES[a] != "material" for a in questions.attribute]
