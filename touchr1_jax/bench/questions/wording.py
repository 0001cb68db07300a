"""Words of the bench: the wordings of the questions, the answer language of each kind, and the reading of answers.

No wording depends on the answer, and each kind has several, so that none of them is the task.  Questions about a single
touch are answered in the language of the policies; comparisons and orders in the same three segments, with "first" and
"second", or an order such as "second first third", from the least to the most, in place of levels.
"""

from collections.abc import Mapping

from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import Ask
from touchr1_jax.text.language import SENSORS, TOUCH_LANGUAGE, Attribute, Language
from touchr1_jax.text.oracle import Reading, read

PLACES = ("first", "second", "third")
"""Names of the touches of a question, by position."""

COMPARISON_LANGUAGE = Language(
    attributes=(Attribute(name="more", levels=((PLACES[0],), (PLACES[1],)), ordinal=False),), sensors=SENSORS
)
ORDER_LANGUAGE = Language(
    attributes=(
        Attribute(name="order", levels=tuple((" ".join(PLACES[t] for t in order),) for order in ORDERS), ordinal=False),
    ),
    sensors=SENSORS,
)

LEVELS: Mapping[str, int] = {a.name: len(a.levels) for a in TOUCH_LANGUAGE.attributes}
"""Attribute → number of its levels."""

WORDINGS = 4
"""Number of wordings of every kind of question."""

ADJECTIVE: Mapping[str, tuple[str, str]] = {
    "hardness": ("hard", "harder"),
    "roughness": ("rough", "rougher"),
    "protrusion": ("protruding", "more protruding"),
}
"""Adjective of each ordinal attribute, and its comparative."""

SINGLE: Mapping[str, tuple[str, str]] = {
    "hardness": ("How hard is it?", "Judge the hardness of this object by touch."),
    "roughness": ("How rough is it?", "Judge the roughness of its surface by touch."),
    "protrusion": ("How protruding is its relief?", "Judge by touch how far its surface features stand out."),
    "material": ("Which material is it?", "Judge the material of this object by touch."),
}
"""The first two wordings of a question about one property of one touch."""

TEMPLATES: Mapping[str, tuple[str, ...]] = {
    "identify": (
        "{first}",
        "{second}",
        "What does the contact tell about its {attribute}?",
        "Name the {attribute} that the sensors feel.",
    ),
    "scale": (
        "On the scale {scale}, where does its {attribute} lie?",
        "Place its {attribute} on the scale {scale}.",
        "Which step of {scale} fits its {attribute}?",
        "Its {attribute} is one of {scale}, from the least to the most: which?",
    ),
    "compose": (
        "Describe its {attributes}.",
        "Judge by touch its {attributes}.",
        "What are its {attributes}? All of them count.",
        "Name the levels of its {attributes}.",
    ),
    "compare": (
        "Two objects are touched one after the other. Which is {more}, the first or the second?",
        "Which of the two touches feels {more}: first or second?",
        "Decide by touch which object is {more}, the first or the second.",
        "One of two objects is {more}. Is it the first or the second?",
    ),
    "order": (
        "Three objects are touched. Order them from the least {adjective} to the most.",
        "Which order of the three touches goes from the least to the most {adjective}?",
        "Sort first, second and third by how {adjective} they feel, the least at the front.",
        "Rank the three objects by touch, the least {adjective} at the front.",
    ),
    "one_sensor": (
        "Only this sensor touched it. {single}",
        "By this one sensor: {single}",
        "With nothing but this sensor: {single}",
        "This sensor is all there is. {single}",
    ),
    "conflict": (
        "The picture may deceive. {single}",
        "Trust touch where it differs from sight. {single}",
        "Looks aside: {single}",
        "Does touch bear out what it looks like? {single}",
    ),
}
"""Wordings of each kind of question; `single` is that of `identify` of the same number."""


def level_words(attribute: str) -> list[str]:
    """The word for each level of an attribute."""
    return [words[0] for words in TOUCH_LANGUAGE.attributes[TOUCH_LANGUAGE.attribute_index(attribute)].levels]


def question(ask: Ask) -> str:
    """The question in the wording that was drawn for it."""
    wording, name, (*others, last) = ask.phrasing % WORDINGS, ask.attributes[0], ask.attributes
    adjective, more = ADJECTIVE.get(name, ("", ""))
    first, second = SINGLE[name]
    return TEMPLATES[ask.kind][wording].format(
        attribute=name,
        attributes=f"{', '.join(others)} and {last}" if others else last,
        adjective=adjective,
        more=more,
        scale=" – ".join(level_words(name)),
        first=first,
        second=second,
        single=TEMPLATES["identify"][wording].format(first=first, second=second, attribute=name),
    )


def language_of(kind: str) -> Language:
    """The answer language of a kind of question."""
    return {"compare": COMPARISON_LANGUAGE, "order": ORDER_LANGUAGE}.get(kind, TOUCH_LANGUAGE)


def slots_of(ask: Ask) -> list[int]:
    """Positions of the answer's levels on the attribute axis of its language."""
    language = language_of(ask.kind)
    return [language.attribute_index(name) for name in ask.attributes] if language is TOUCH_LANGUAGE else [0]


def read_answer(ask: Ask, text: str) -> tuple[Reading, tuple[int, ...]]:
    """The parsed answer, and the levels that it concludes, −1 where none could be parsed."""
    reading = read(language_of(ask.kind), text)
    return reading, tuple(reading.conclude[slot] for slot in slots_of(ask))


def answer_choices(ask: Ask) -> list[list[str]]:
    """The words among which each part of the answer is chosen."""
    attributes = language_of(ask.kind).attributes
    return [[words[0] for words in attributes[slot].levels] for slot in slots_of(ask)]


def answer_words(ask: Ask) -> str:
    """The right answer in words, such as "soft" or "second first third"."""
    return " ".join(words[level] for words, level in zip(answer_choices(ask), ask.answer, strict=True))
