"""Questions in plain words."""

import pytest

from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.plain_questions import QuestionError, read_question

ATTRIBUTES = {a.name: [level[0] for level in a.levels] for a in TOUCH_LANGUAGE.attributes}


@pytest.mark.parametrize(
    ("question", "name", "sign", "compares"),
    [
        ("How hard is it?", "hardness", 1, False),
        ("is it SOFT", "hardness", -1, False),
        ("Which is harder?", "hardness", 1, True),
        ("Is it softer than the other?", "hardness", -1, True),
        ("Which one is less rough?", "roughness", -1, True),
        ("which is less smooth", "roughness", 1, True),
        ("Which is more protruding?", "protrusion", 1, True),
        ("does anything protrude", "protrusion", 1, False),
        ("What is it made of?", "material", 1, False),
        ("Is this wood?", "material", 1, False),
    ],
)
def test_the_attribute_is_found(question, name, sign, compares):
    asked = read_question(question, ATTRIBUTES)
    assert (asked.name, asked.sign, asked.compares) == (name, sign, compares)


@pytest.mark.parametrize(
    ("question", "message"),
    [
        ("How heavy is it?", "names no attribute; ask for hardness, rou"),
        ("hard or rough?", "hardness and roughness"),
        ("Which of the soft objects is harder?", "both ends of hardness"),
    ],
)
def test_other_questions_are_answered_by_what_can_be_asked(question, message):
    with pytest.raises(QuestionError, match=message):
        read_question(question, ATTRIBUTES)
