"""The cases of answers and the bench's items that are shown, by hand."""

import numpy as np

from experiments.paper.qualitative import answer_cases, item_examples
from experiments.paper.touch_gain import TouchQuestions
from touchr1_jax.bench.items import Ask, Touch
from touchr1_jax.training.evaluation import Evaluation

QUESTIONS = TouchQuestions(
    attribute=np.array([0, 0, 1, 3, 3]),
    label=np.array([0, 2, 2, 5, 7]),
    objects=np.array(["a", "b", "b", "c", "d"]),
    looks_like_another=np.array([False, True, True, True, False]),
)
CONCLUDED = {
    "full": np.array([0, 0, 2, 5, -1]),
    "sft": np.array([1, 2, 2, 5, 7]),
    "blind": np.array([0, 0, 1, 4, 4]),
    "swapped": np.array([2, 0, 2, 5, 7]),
    "perceived": np.array([[0, 1], [0, 0], [2, 1], [5, 4], [-1, -1]]),
}


def test_every_answer_is_of_its_cases():
    cases = answer_cases(QUESTIONS, **CONCLUDED)
    assert [np.flatnonzero(c.rows).tolist() for c in cases] == [[0], [3], [2], [1], [0, 2], [], [1], [0], [1, 4], [4]]
    assert [c.share for c in cases[:4]] == [50, 100, 50, 100 / 3]


def test_an_item_is_shown_by_the_answers_that_it_consists_of():
    touches = tuple(Touch(object=name, site=0, motion="press", trial=0) for name in ("a", "b"))
    pair = Ask(
        id="compare-0000", kind="compare", attributes=("hardness",), touches=touches, sensors=("xense",), answer=(1,)
    )
    contact, attribute = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    full = Evaluation(
        contact=contact, attribute=attribute, streams=None, tokens=None, parsed=None, label=None, alone=None
    )
    places = {touches[0]: 0, touches[1]: 1}
    for answer, words in (((0,), "first"), ((-1,), "cannot be read")):
        ((heading, rows),) = item_examples([pair], {"compare-0000": answer}, places, full)
        assert rows == [0, 2]
        assert words in heading
