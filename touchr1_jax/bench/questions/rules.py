"""The rules that every item must pass, whoever worded it, and planted errors that the rules must find.

missing answer     no parsable answer to everything that was asked, or not in the three segments
label conflict     the answer differs from the labels in the records
outside contact    evidence that no shown sensor of a shown touch measured, or that lies outside its contact
unmeasured         no evidence at all, or a number that was not measured
contradiction      the rationale concludes something other than the answer
"""

import collections
import dataclasses
from collections.abc import Iterable, Mapping

from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import Ask, Citation, Item, Touch
from touchr1_jax.bench.questions.contacts import MeasuredContact
from touchr1_jax.bench.questions.wording import answer_choices, answer_words, language_of, read_answer

RULES = ("missing answer", "label conflict", "outside contact", "unmeasured", "contradiction")
"""In the order in which they are applied; an item counts under the first rule that it breaks."""

TOLERANCE = 0.01
"""Relative tolerance between a cited number and the measurement: three digits are kept."""

MARGIN = 0.02
"""Share of the window by which evidence may lie outside the contact: half a node of a field of 20."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CandidateItem:
    """An item before the rules; `answer` is the right answer according to its author, in bare words."""

    ask: Ask
    question: str
    answer: str
    rationale: str
    evidence: tuple[Citation, ...]

    @classmethod
    def of(cls, item: Item) -> "CandidateItem":
        """The candidate whose answer is the right one."""
        return cls(**vars(item), answer=answer_words(item.ask))

    def item(self) -> Item:
        """The item without the author's answer."""
        return Item(**{name: value for name, value in vars(self).items() if name != "answer"})


@dataclasses.dataclass(frozen=True, kw_only=True)
class FilteredItems:
    """Items that passed, and candidates that did not, each with the rule that it broke."""

    kept: tuple[Item, ...]
    removed: tuple[tuple[CandidateItem, str], ...]

    @property
    def counts(self) -> dict[str, int]:
        """Number of candidates removed by each rule, 0 included."""
        counted = collections.Counter(rule for _, rule in self.removed)
        return {rule: counted[rule] for rule in RULES}


def apply_rules(candidates: Iterable[CandidateItem], contacts: Mapping[Touch, MeasuredContact]) -> FilteredItems:
    """Keep the candidates that break no rule; `contacts` must include all touches that the questions show."""
    judged = [(candidate, broken_rule(candidate, contacts)) for candidate in candidates]
    return FilteredItems(
        kept=tuple(candidate.item() for candidate, rule in judged if rule is None),
        removed=tuple((candidate, rule) for candidate, rule in judged if rule is not None),
    )


def broken_rule(candidate: CandidateItem, contacts: Mapping[Touch, MeasuredContact]) -> str | None:
    """The first rule that a candidate breaks; `None` if it passes."""
    ask = candidate.ask
    alone = f"<perceive> . </perceive> <compare> . </compare> <conclude> {candidate.answer} </conclude>"
    _, answered = read_answer(ask, alone)
    reading, concluded = read_answer(ask, candidate.rationale)
    if not candidate.question.strip() or not reading.formatted or -1 in answered or -1 in concluded:
        return "missing answer"
    if any(touch not in contacts for touch in ask.touches):
        return "outside contact"
    shown = [contacts[touch] for touch in ask.touches]
    if answered != ask.answer or answered != true_answer(ask, shown):
        return "label conflict"
    if any(not _is_inside(citation, ask, shown) for citation in candidate.evidence):
        return "outside contact"
    if not candidate.evidence or any(not _is_measured(citation, shown) for citation in candidate.evidence):
        return "unmeasured"
    return None if concluded == answered else "contradiction"


def true_answer(ask: Ask, shown: list[MeasuredContact]) -> tuple[int, ...] | None:
    """The right answer according to the labels; `None` where they define none, such as for a tie."""
    if any(name not in contact.labels for contact in shown for name in ask.attributes):
        return None
    if ask.kind not in ("compare", "order"):
        return tuple(shown[0].labels[name] for name in ask.attributes)
    levels = [contact.labels[ask.attributes[0]] for contact in shown]
    if len(set(levels)) < len(levels):
        return None
    rising = tuple(sorted(range(len(levels)), key=lambda t: levels[t]))
    return (rising[-1],) if ask.kind == "compare" else (ORDERS.index(rising),)


def _is_inside(citation: Citation, ask: Ask, shown: list[MeasuredContact]) -> bool:
    if not 0 <= citation.touch < len(shown) or citation.sensor not in ask.sensors:
        return False
    measured = shown[citation.touch].measured.get(citation.sensor)
    return measured is not None and _contains(measured.box, citation.at)


def _contains(box: tuple[float, float, float, float], at: tuple[float, float]) -> bool:
    left, top, right, bottom = box
    return left - MARGIN <= at[0] <= right + MARGIN and top - MARGIN <= at[1] <= bottom + MARGIN


def _is_measured(citation: Citation, shown: list[MeasuredContact]) -> bool:
    measured = shown[citation.touch].measured[citation.sensor]
    if citation.quantity not in measured.quantities or citation.unit != measured.units[citation.quantity]:
        return False
    value = measured.quantities[citation.quantity]
    return abs(citation.value - value) <= TOLERANCE * abs(value)


def plant_errors(item: Item, contacts: Mapping[Touch, MeasuredContact]) -> dict[str, CandidateItem]:
    """A sound item with one error planted for each rule: rule → the candidate that it must remove."""
    sound, choices = CandidateItem.of(item), zip(answer_choices(item.ask), item.ask.answer, strict=True)
    wrong = " ".join(words[(level + 1) % len(words)] for words, level in choices)  # the next level of every part
    tag = language_of(item.ask.kind).tags[-1]
    conclude = lambda words: f"{item.rationale[: item.rationale.index(f'<{tag}>')]}<{tag}> {words} </{tag}>"
    altered = tuple(dataclasses.replace(c, value=1.1 * c.value + 0.01) for c in item.evidence)
    return {
        "missing answer": dataclasses.replace(sound, rationale=conclude("")),
        "label conflict": dataclasses.replace(sound, answer=wrong, rationale=conclude(wrong)),
        "outside contact": dataclasses.replace(sound, evidence=(_moved(item, contacts), *item.evidence[1:])),
        "unmeasured": dataclasses.replace(sound, evidence=altered),
        "contradiction": dataclasses.replace(sound, rationale=conclude(wrong)),
    }


def count_found_errors(items: Iterable[Item], contacts: Mapping[Touch, MeasuredContact]) -> dict[str, int]:
    """Number of planted errors that each rule finds; every error found would be the number of items."""
    counts = dict.fromkeys(RULES, 0)
    for item in items:
        for rule, candidate in plant_errors(item, contacts).items():
            counts[rule] += broken_rule(candidate, contacts) == rule
    return counts


def _moved(item: Item, contacts: Mapping[Touch, MeasuredContact]) -> Citation:
    """The first citation, at the corner farthest from the contact, or of no shown touch if that corner is inside."""
    first, ask = item.evidence[0], item.ask
    box = contacts[ask.touches[first.touch]].measured[first.sensor].box
    left, top, right, bottom = box
    corner = (0.0 if left > 1 - right else 1.0, 0.0 if top > 1 - bottom else 1.0)
    if _contains(box, corner):
        return dataclasses.replace(first, touch=len(ask.touches))
    return dataclasses.replace(first, at=corner)
