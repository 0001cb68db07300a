"""The words of the bench: the answer language of each kind of question, and what a text answers.

Single touches are answered in the language of the policies; comparisons and orders in the same three segments, with
"first" and "second", or an order such as "second first third", from the least to the most, as the levels.
"""

from collections.abc import Mapping

from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import Ask
from touchr1_jax.text.language import SENSORS, TOUCH_LANGUAGE, Attribute, Language
from touchr1_jax.text.oracle import Reading, read

PLACES = ("first", "second", "third")
"""How the touches of a question are called."""

COMPARISON = Language(
    attributes=(Attribute(name="more", levels=((PLACES[0],), (PLACES[1],)), ordinal=False),), sensors=SENSORS
)
ORDER = Language(
    attributes=(
        Attribute(name="order", levels=tuple((" ".join(PLACES[t] for t in order),) for order in ORDERS), ordinal=False),
    ),
    sensors=SENSORS,
)


def language_of(kind: str) -> Language:
    """The language that a kind of question is answered in."""
    return {"compare": COMPARISON, "order": ORDER}.get(kind, TOUCH_LANGUAGE)


def slots_of(ask: Ask) -> list[int]:
    """Where the levels of an answer stand on the A axis of its language."""
    language = language_of(ask.kind)
    if language is not TOUCH_LANGUAGE:
        return [0]
    return [language.attribute_index(name) for name in ask.attributes]


def understand(ask: Ask, text: str) -> tuple[Reading, tuple[int, ...]]:
    """What an answer in three segments says: everything, and the levels that it concludes, −1 for ⊥."""
    reading = read(language_of(ask.kind), text)
    return reading, tuple(reading.conclude[slot] for slot in slots_of(ask))


def answer_words(ask: Ask) -> str:
    """The right answer in words, such as "soft" or "second first third"."""
    attributes = language_of(ask.kind).attributes
    levels = zip(slots_of(ask), ask.answer, strict=True)
    return " ".join(attributes[slot].levels[level][0] for slot, level in levels)


def choices(ask: Ask) -> list[list[str]]:
    """The words among which each part of the answer is chosen."""
    attributes = language_of(ask.kind).attributes
    return [[words[0] for words in attributes[slot].levels] for slot in slots_of(ask)]


ADJECTIVE: Mapping[str, tuple[str, str]] = {
    "hardness": ("hard", "harder"),
    "roughness": ("rough", "rougher"),
    "protrusion": ("protruding", "more protruding"),
}
"""An ordinal attribute as an adjective, and compared."""

SINGLE: Mapping[str, tuple[str, ...]] = {
    "hardness": (
        "How hard is it?",
        "Judge the hardness of this object by touch.",
        "What does the contact tell about its hardness?",
        "Name the hardness that the sensors feel.",
    ),
    "roughness": (
        "How rough is it?",
        "Judge the roughness of its surface by touch.",
        "What does the contact tell about its roughness?",
        "Name the roughness that the sensors feel.",
    ),
    "protrusion": (
        "How protruding is its relief?",
        "Judge by touch how far its surface features stand out.",
        "What does the contact tell about its protrusion?",
        "Name the protrusion that the sensors feel.",
    ),
    "material": (
        "Which material is it?",
        "Judge the material of this object by touch.",
        "What does the contact tell about its material?",
        "Name the material that the sensors feel.",
    ),
}
"""For one property of one touch."""

SCALE = (
    "On the scale {scale}, where does its {attribute} lie?",
    "Place its {attribute} on the scale {scale}.",
    "Which step of {scale} fits its {attribute}?",
    "Its {attribute} is one of {scale}, from the least to the most: which?",
)

COMPOSE = (
    "Describe its {attributes}.",
    "Judge by touch its {attributes}.",
    "What are its {attributes}? All of them count.",
    "Name the levels of its {attributes}.",
)

COMPARE = (
    "Two objects are touched one after the other. Which is {more}, the first or the second?",
    "Which of the two touches feels {more}: first or second?",
    "Decide by touch which object is {more}, the first or the second.",
    "One of two objects is {more}. Is it the first or the second?",
)

ORDERING = (
    "Three objects are touched. Order them from the least {adjective} to the most.",
    "Which order of the three touches goes from the least to the most {adjective}?",
    "Sort first, second and third by how {adjective} they feel, the least at the front.",
    "Rank the three objects by touch, the least {adjective} at the front.",
)

ALONE = (
    "Only this sensor touched it. {question}",
    "By this one sensor: {question}",
    "With nothing but this sensor: {question}",
    "This sensor is all there is. {question}",
)

CONFLICT = (
    "The picture may deceive. {question}",
    "Trust touch where it differs from sight. {question}",
    "Looks aside: {question}",
    "Does touch bear out what it looks like? {question}",
)

WORDINGS = 4
"""Of every kind."""


def question(ask: Ask) -> str:
    """The question in the wording that it was drawn with."""
    wording, name = ask.phrasing % WORDINGS, ask.attributes[0]
    if ask.kind == "identify":
        return SINGLE[name][wording]
    if ask.kind == "scale":
        levels = TOUCH_LANGUAGE.attributes[TOUCH_LANGUAGE.attribute_index(name)].levels
        return SCALE[wording].format(scale=" – ".join(words[0] for words in levels), attribute=name)
    if ask.kind == "compose":
        return COMPOSE[wording].format(attributes=_listed(ask.attributes))
    if ask.kind == "compare":
        return COMPARE[wording].format(more=ADJECTIVE[name][1])
    if ask.kind == "order":
        return ORDERING[wording].format(adjective=ADJECTIVE[name][0])
    templates = {"one_sensor": ALONE, "conflict": CONFLICT}[ask.kind]
    return templates[wording].format(question=SINGLE[name][wording])


def _listed(names: tuple[str, ...]) -> str:
    """ "a and b", "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
