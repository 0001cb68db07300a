"""Faults of each kind, planted in sound items to judge the rules by: each must be caught under its own name."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

from experiments.bench.contacts import MeasuredContact
from experiments.bench.rules import MARGIN, RULES, CandidateItem, broken_rule
from experiments.bench.wording import answer_words, choices, language_of
from sensors_io.measures import Box
from touchr1_jax.bench.items import Ask, Citation, Item, Touch


def planted(item: Item, contacts: Mapping[Touch, MeasuredContact]) -> dict[str, CandidateItem]:
    """The item with one fault of each kind: rule → what must be caught by it."""
    sound = CandidateItem(
        ask=item.ask,
        question=item.question,
        answer=answer_words(item.ask),
        rationale=item.rationale,
        evidence=item.evidence,
    )
    wrong = other_words(item.ask)
    faults: Mapping[str, Callable[[], CandidateItem]] = {
        "missing answer": lambda: dataclasses.replace(sound, rationale=_conclude(item, "")),
        "label conflict": lambda: dataclasses.replace(sound, answer=wrong, rationale=_conclude(item, wrong)),
        "outside contact": lambda: dataclasses.replace(sound, evidence=_moved(item.evidence, contacts, item.ask)),
        "unmeasured": lambda: dataclasses.replace(
            sound, evidence=tuple(dataclasses.replace(c, value=1.1 * c.value + 0.01) for c in item.evidence)
        ),
        "contradiction": lambda: dataclasses.replace(sound, rationale=_conclude(item, wrong)),
    }
    return {rule: faults[rule]() for rule in RULES}


def caught(items: Iterable[Item], contacts: Mapping[Touch, MeasuredContact]) -> dict[str, int]:
    """How many of the planted faults each rule catches; all would be the number of items."""
    counts = dict.fromkeys(RULES, 0)
    for item in items:
        for rule, candidate in planted(item, contacts).items():
            counts[rule] += broken_rule(candidate, contacts) == rule
    return counts


def other_words(ask: Ask) -> str:
    """A wrong answer: the next level of every part."""
    parts = zip(choices(ask), ask.answer, strict=True)
    return " ".join(words[(level + 1) % len(words)] for words, level in parts)


def _conclude(item: Item, words: str) -> str:
    """The rationale with another conclusion."""
    tag = language_of(item.ask.kind).tags[-1]
    head = item.rationale[: item.rationale.index(f"<{tag}>")]
    return f"{head}<{tag}> {words} </{tag}>"


def _moved(evidence: Sequence[Citation], contacts: Mapping[Touch, MeasuredContact], ask: Ask) -> tuple[Citation, ...]:
    """The first citation from the corner farthest from the contact; from no touch where that fills the window."""
    first = evidence[0]
    left, top, right, bottom = contacts[ask.touches[first.touch]].measured[first.sensor].box
    corner = (0.0 if left > 1 - right else 1.0, 0.0 if top > 1 - bottom else 1.0)
    if _holds((left, top, right, bottom), corner):
        return (dataclasses.replace(first, touch=len(ask.touches)), *evidence[1:])
    return (dataclasses.replace(first, at=corner), *evidence[1:])


def _holds(box: Box, at: tuple[float, float]) -> bool:
    left, top, right, bottom = box
    return left - MARGIN <= at[0] <= right + MARGIN and top - MARGIN <= at[1] <= bottom + MARGIN
