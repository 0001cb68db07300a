"""Deceptive questions, leads and gains from touch, by hand values."""

import dataclasses

import numpy as np
import pytest

from experiments.paper.conflict_metrics import (
    Asked,
    asked_of,
    contrast,
    deceptive,
    revised,
    spoken,
    suggested,
    touch_use,
)
from sensors_io.schema import ATTRIBUTES
from tests.experiments.study.test_study import TEST, answers_about
from touchr1_jax.bench.grounding import CONTROLS

ASKED = Asked(
    attribute=np.array([0, 0, 0, 0, 1, 1]),
    label=np.array([0, 1, 2, 0, 1, 2]),
    objects=np.array(["a", "b", "c", "d", "a", "b"]),
    lies=np.array([True, True, True, False, True, True]),
    names=ATTRIBUTES,
)
PRIOR = np.array([2, 1, 0, 1, -1, 0])


def test_deceptive_is_what_looks_like_another_and_suggests_another_level():
    assert deceptive(ASKED, PRIOR).tolist() == [True, False, True, False, False, True]


def test_what_pictures_suggest_is_the_vote_of_the_other_seeds():
    blind = [np.array([0, 2, -1]), np.array([1, 2, -1]), np.array([1, 0, -1])]
    assert [s.tolist() for s in suggested(blind)] == [[1, 0, -1], [0, 0, -1], [0, 2, -1]]
    with pytest.raises(ValueError, match="holds 1 seeds"):
        suggested(blind[:1])


def test_a_contrast_counts_each_seeds_own_questions():
    ours, theirs = [ASKED.label, ASKED.label], [PRIOR, PRIOR]
    misled = deceptive(ASKED, PRIOR)
    found = contrast(ASKED, ours, theirs, [misled, misled])
    assert (found.questions, found.ours, found.theirs) == (3, 100, 0)
    assert (found.seeds.mean, found.objects.mean) == (100, 100)
    other = np.array([True, True, False, False, False, False])
    found = contrast(ASKED, ours, theirs, [misled, other])
    assert found.seeds.mean == pytest.approx((100 + 50) / 2)
    with pytest.raises(ValueError, match=r"where\[1\] holds no question"):
        contrast(ASKED, ours, theirs, [misled, misled & False])


def test_who_is_right_revised_and_who_repeats_sight_did_not():
    assert revised(ASKED, [ASKED.label], [PRIOR]) == 100
    assert revised(ASKED, [PRIOR], [PRIOR]) == 0


@pytest.fixture(scope="module")
def said():
    return answers_about(TEST)


def with_levels(said, level):
    conclude = np.full_like(said.parsed.conclude, -1)
    conclude[np.arange(len(level)), said.attribute] = level
    return dataclasses.replace(said, parsed=dataclasses.replace(said.parsed, conclude=conclude))


def test_touch_is_worth_what_its_absence_costs(said):
    ids, lies = np.array(list("vwxyz")), np.array([True, False, True, False, False])
    asked = asked_of(said, ids, lies, ATTRIBUTES)
    right = with_levels(said, asked.label)
    wrong = with_levels(said, (asked.label + 1) % 3)
    assert np.array_equal(spoken(right), asked.label)
    controls = {"drop": [wrong] * 2, "shuffle": [right] * 2, "noise": [wrong, right], "swapped": [wrong] * 2}
    everywhere, unordered = np.ones(len(asked.label), bool), np.zeros(len(asked.label), bool)
    found = touch_use(asked, [right, right], controls, unordered, everywhere)
    assert {name: gain.mean for name, gain in found.gains.items()} == {
        "drop": 100,
        "shuffle": 0,
        "noise": 50,
        "swapped": 100,
    }
    assert (found.least.control, found.least.gain.mean) == ("noise", 50)
    assert (
        touch_use(asked, [right], {c: controls[c][:1] for c in CONTROLS}, ~unordered, everywhere).least.gain.mean == 0
    )
    assert list(asked.ordinal) == [name != "material" for name in np.array(ATTRIBUTES)[asked.attribute]]
