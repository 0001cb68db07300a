"""The words of the bench: the answer language of each kind of question, and what a text answers.

Single touches are answered in the language of the policies; comparisons and orders in the same three segments, with
"first" and "second", or an order such as "second first third", from the least to the most, as the levels.
"""

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
