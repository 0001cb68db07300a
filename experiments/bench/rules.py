"""The rules that an item must pass, whoever worded it, and how many each of them removed.

missing answer     no parsable answer to everything that was asked, or not in the three segments
label conflict     the answer differs from what the labels of the records say
outside contact    evidence that no shown sensor of a shown touch measured, or from outside its contact
unmeasured         no evidence at all, or a number that was not measured
contradiction      the rationale concludes something else than the answer
"""

import collections
import dataclasses
from collections.abc import Iterable, Mapping

from experiments.bench.contacts import MeasuredContact
from experiments.bench.wording import understand
from sensors_io.measures import UNITS, Measured
from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import Ask, Citation, Item, Touch

RULES = ("missing answer", "label conflict", "outside contact", "unmeasured", "contradiction")
"""In the order that they are tried in; an item counts under the first that it breaks."""

TOLERANCE = 0.01
"""Relative, between a number and what was measured: three digits are kept."""

MARGIN = 0.02
"""Of the window, by which evidence may lie beside the contact: half a node of a field of 20."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CandidateItem:
    """An item before the rules: `answer` is what its author holds to be right, in the words of its language."""

    ask: Ask
    question: str
    answer: str
    rationale: str
    evidence: tuple[Citation, ...]

    def item(self) -> Item:
        """The item that it becomes."""
        return Item(ask=self.ask, question=self.question, rationale=self.rationale, evidence=self.evidence)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FilteredItems:
    """What passed, and what did not with the rule that it broke."""

    kept: tuple[Item, ...]
    removed: tuple[tuple[CandidateItem, str], ...]

    @property
    def counts(self) -> dict[str, int]:
        """Removed by each rule, those that removed nothing too."""
        counted = collections.Counter(rule for _, rule in self.removed)
        return {rule: counted[rule] for rule in RULES}


def apply_rules(candidates: Iterable[CandidateItem], contacts: Mapping[Touch, MeasuredContact]) -> FilteredItems:
    """Apply the rules.

    Args:
      candidates: whoever worded them.
      contacts: by touch, those that the questions show among them.
    """
    kept, removed = [], []
    for candidate in candidates:
        rule = broken_rule(candidate, contacts)
        if rule is None:
            kept.append(candidate.item())
        else:
            removed.append((candidate, rule))
    return FilteredItems(kept=tuple(kept), removed=tuple(removed))


def broken_rule(candidate: CandidateItem, contacts: Mapping[Touch, MeasuredContact]) -> str | None:
    """The first rule that a candidate breaks; `None` if it passes."""
    ask = candidate.ask
    shown = [contacts.get(touch) for touch in ask.touches]
    answered = _levels(ask, candidate.answer)
    reading, concluded = understand(ask, candidate.rationale)
    if not candidate.question.strip() or not reading.formatted or -1 in answered or -1 in concluded:
        return "missing answer"
    if any(contact is None for contact in shown):
        return "outside contact"
    known = [contact for contact in shown if contact is not None]
    if answered != ask.answer or answered != true_answer(ask, known):
        return "label conflict"
    if any(not _inside(citation, ask, known) for citation in candidate.evidence):
        return "outside contact"
    if not candidate.evidence or any(not _measured(citation, known) for citation in candidate.evidence):
        return "unmeasured"
    return None if concluded == answered else "contradiction"


def true_answer(ask: Ask, shown: list[MeasuredContact]) -> tuple[int, ...] | None:
    """The right answer by the labels of the records; `None` where they allow none, such as a tie."""
    if any(name not in contact.labels for contact in shown for name in ask.attributes):
        return None
    if ask.kind not in ("compare", "order"):
        return tuple(shown[0].labels[name] for name in ask.attributes)
    levels = [contact.labels[ask.attributes[0]] for contact in shown]
    if len(set(levels)) < len(levels):
        return None
    rising = tuple(sorted(range(len(levels)), key=lambda t: levels[t]))
    return (rising[-1],) if ask.kind == "compare" else (ORDERS.index(rising),)


def _levels(ask: Ask, answer: str) -> tuple[int, ...]:
    """An answer in bare words, read as a conclusion."""
    return understand(ask, f"<perceive> . </perceive> <compare> . </compare> <conclude> {answer} </conclude>")[1]


def _of(citation: Citation, shown: list[MeasuredContact]) -> Measured:
    return shown[citation.touch].measured[citation.sensor]


def _inside(citation: Citation, ask: Ask, shown: list[MeasuredContact]) -> bool:
    if not 0 <= citation.touch < len(shown) or citation.sensor not in ask.sensors:
        return False
    if citation.sensor not in shown[citation.touch].measured:
        return False
    left, top, right, bottom = _of(citation, shown).box
    x, y = citation.at
    return left - MARGIN <= x <= right + MARGIN and top - MARGIN <= y <= bottom + MARGIN


def _measured(citation: Citation, shown: list[MeasuredContact]) -> bool:
    quantities = _of(citation, shown).quantities
    if citation.quantity not in quantities or citation.unit != UNITS[citation.quantity]:
        return False
    value = quantities[citation.quantity]
    return abs(citation.value - value) <= TOLERANCE * abs(value)
