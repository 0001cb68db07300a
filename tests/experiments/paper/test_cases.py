"""Which answers are of which case, by hand."""

import numpy as np

from experiments.paper.cases import Said, case_table, cases, first_of, items_shown
from experiments.paper.conflict_metrics import Asked
from experiments.study.answers import Evaluated
from touchr1_jax.bench.items import Ask, Touch

NAMES = ("hardness", "roughness", "protrusion", "material")

ASKED = Asked(
    attribute=np.array([0, 0, 1, 3, 3]),
    label=np.array([0, 2, 2, 5, 7]),
    objects=np.array(["a", "b", "b", "c", "d"]),
    lies=np.array([False, True, True, True, False]),
    names=NAMES,
)
SAID = Said(
    full=np.array([0, 0, 2, 5, -1]),
    sft=np.array([1, 2, 2, 5, 7]),
    blind=np.array([0, 0, 1, 4, 4]),
    strange=np.array([2, 0, 2, 5, 7]),
    perceived=np.array([[0, 1], [0, 0], [2, 1], [5, 4], [-1, -1]]),
)


def test_every_answer_is_of_its_cases():
    found = {case.title: np.flatnonzero(case.rows).tolist() for case in cases(ASKED, SAID)}
    assert list(found.values()) == [[0], [3], [2], [1], [0, 2], [], [1], [0], [1, 4], [4]]


def test_shares_are_of_what_could_have_been():
    hardness, material, level, believed, *_ = cases(ASKED, SAID)
    assert (hardness.share, material.share, level.share) == (50, 100, 50)
    assert believed.share == 100 / 3
    table = case_table(cases(ASKED, SAID))
    assert table.rows[0][1:3] == (1, 2)


def test_nothing_to_be_a_share_of_is_no_share():
    honest = cases(
        Asked(attribute=ASKED.attribute, label=ASKED.label, objects=ASKED.objects, lies=np.zeros(5, bool), names=NAMES),
        SAID,
    )
    assert honest[1].share == 0


def test_one_answer_of_each_object_the_first_in_order():
    rows = np.array([False, True, True, True, True])
    assert first_of(rows, ASKED.objects, 2) == [1, 3]
    assert first_of(np.zeros(5, bool), ASKED.objects, 2) == []


def test_an_item_is_shown_by_the_answers_that_it_is_made_of():
    touches = tuple(Touch(object=name, site=0, motion="press", trial=0) for name in ("a", "b"))
    pair = Ask(
        id="compare-0000", kind="compare", attributes=("hardness",), touches=touches, sensors=("xense",), answer=(1,)
    )
    contact, attribute = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    said = Evaluated(
        contact=contact, attribute=attribute, streams=None, tokens=None, parsed=None, label=None, alone=None
    )
    (shown,) = items_shown([pair], {"compare-0000": (0,)}, {touches[0]: 0, touches[1]: 1}, said)
    assert shown.rows == (0, 2)
    assert shown.heading.endswith("– first (wrong, it is second)")
    (shown,) = items_shown([pair], {"compare-0000": (-1,)}, {touches[0]: 0, touches[1]: 1}, said)
    assert "nothing that can be read" in shown.heading
