"""The data card: checks that a bench must pass before anybody is scored on it; a check that fails stops the build.

A shortcut that needs no touch would let a constant or a look-up table beat chance, so the card scores these.
"""

import collections
import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence

from touchr1_jax.bench.items import Ask, Item
from touchr1_jax.bench.questions.contacts import MeasuredContact, SplitContacts
from touchr1_jax.bench.questions.wording import answer_choices, read_answer

BALANCE, CONSTANT, WORDING = 3.0, 3.0, 6.0
"""Points above equal shares allowed to the commonest answer, the training mode and the best answer to each wording.

With nine materials and twenty questions to a wording, three of one material in place of two are five points."""

FEWEST = 30
"""Fewest questions of a kind and attribute whose shares are judged: with fewer, one question is three points."""

LEAST_OBJECTS = 0.95
"""Share of the split's objects that some question must show."""

AnswerCell = tuple[str, str]
"""Kind and attribute; each part of a composed answer is a cell of its own."""

Asked = Sequence[tuple[Ask, int]]
"""Questions of a cell and their answers."""


@dataclasses.dataclass(frozen=True)
class CardCheck:
    """A figure that must not exceed its bound."""

    name: str
    measured: float
    bound: float
    unit: str = ""
    note: str = ""

    @property
    def met(self) -> bool:
        """True if it does not."""
        return self.measured <= self.bound


class CardError(ValueError):
    """Items that do not pass the card; the message names every check that failed."""


def checks(items: Sequence[Item], bench: SplitContacts, train: SplitContacts) -> tuple[CardCheck, ...]:
    """Every check of the card: figures that must not exceed their bounds."""
    shown = {touch for item in items for touch in item.ask.touches}
    objects, known = {touch.object for touch in shown}, {contact.fingerprint for contact in train.contacts}
    copies = sum(contact.touch in shown and contact.fingerprint in known for contact in bench.contacts)
    contents = {(item.ask.touches, item.ask.sensors, item.question) for item in items}
    wrong = sum(not _supports_answer(item) for item in items)
    counts = (
        ("training objects in the bench", len(objects & train.objects()), "by name"),
        ("objects that no label of the split knows", len(objects - bench.objects()), "shown, but not in its split"),
        ("contacts that equal a training contact", copies, "in all recorded arrays"),
        ("questions asked twice", len(items) - len(contents), "same touches, same words"),
        ("pairs not in both orders", _lone_pairs(items), "each once, with opposite answers"),
        ("rationales against the answer", wrong, "or not in the three segments"),
    )
    unseen, cells = len(bench.objects() - objects) / len(bench.objects()), answer_cells(items)
    return (
        *(CardCheck(name, count, 0.0, note=meaning) for name, count, meaning in counts),
        CardCheck("objects never shown", 100.0 * unseen, 100.0 * (1 - LEAST_OBJECTS), "%", "of the split"),
        _worst("commonest answer over equal shares", cells, _commonest, BALANCE),
        _worst("training mode over chance", cells, lambda c, s: _mode(c, s, train.contacts), CONSTANT),
        _worst("best answer to each wording over chance", cells, _by_wording, WORDING),
    )


def require(results: Sequence[CardCheck]) -> None:
    """Raise unless all checks passed.

    Raises:
      CardError: naming every check that did not pass.
    """
    failed = [c for c in results if not c.met]
    if failed:
        each = (f"{c.name} is {c.measured:.4g} {c.unit}, must be ≤ {c.bound:g} ({c.note})" for c in failed)
        raise CardError(f"{'; '.join(each)}; nothing is written until the records or the quota are corrected")


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnswerShare:
    """The number of times that each level is the answer to questions of a kind and attribute."""

    kind: str
    attribute: str
    counts: tuple[int, ...]


def shares(items: Sequence[Item]) -> list[AnswerShare]:
    """The answers to the questions of every kind and attribute."""
    found = []
    for (kind, attribute), rows in answer_cells(items).items():
        ask = rows[0][0]
        levels = range(len(answer_choices(ask)[ask.attributes.index(attribute)]))
        counts = tuple(sum(level == k for _, level in rows) for k in levels)
        found.append(AnswerShare(kind=kind, attribute=attribute, counts=counts))
    return found


def answer_cells(items: Sequence[Item]) -> Mapping[AnswerCell, Asked]:
    """Questions and their answers by kind and attribute."""
    cells: dict[AnswerCell, list[tuple[Ask, int]]] = {}
    for ask in (item.ask for item in items):
        names = ask.attributes if len(ask.answer) == len(ask.attributes) else ask.attributes[:1]
        for name, level in zip(names, ask.answer, strict=True):
            cells.setdefault((ask.kind, name), []).append((ask, level))
    return cells


def _worst(
    name: str, cells: Mapping[AnswerCell, Asked], right: Callable[[AnswerCell, Asked], int | None], bound: float
) -> CardCheck:
    """The cell whose shortcut is furthest above equal shares of the levels that occur, in points."""
    judged = {}
    for cell, rows in cells.items():
        if len(rows) >= FEWEST:
            count, occurring = right(cell, rows), len({level for _, level in rows})
            judged[cell] = 0.0 if count is None else 100.0 * (count / len(rows) - 1 / occurring)
    if not judged:
        return CardCheck(name, 0.0, bound, "points", "nothing to judge")
    worst = max(judged, key=lambda cell: judged[cell])
    return CardCheck(name, judged[worst], bound, "points", f"the worst is {' '.join(worst)}")


def _commonest(cell: AnswerCell, rows: Asked) -> int:
    """Right answers of the commonest level of the cell."""
    del cell
    return max(collections.Counter(level for _, level in rows).values())


def _mode(cell: AnswerCell, rows: Asked, train: Sequence[MeasuredContact]) -> int | None:
    """Right answers of the commonest level of the training contacts; comparisons have no such level."""
    kind, attribute = cell
    counts = collections.Counter(c.labels[attribute] for c in train if attribute in c.labels)
    if kind in ("compare", "order") or not counts:
        return None
    mode = min(counts, key=lambda level: (-counts[level], level))
    return sum(level == mode for _, level in rows)


def _by_wording(cell: AnswerCell, rows: Asked) -> int:
    """Right answers of the commonest level of each wording, on the very same questions."""
    wordings = {ask.phrasing for ask, _ in rows}
    return sum(_commonest(cell, [row for row in rows if row[0].phrasing == wording]) for wording in wordings)


def _lone_pairs(items: Sequence[Item]) -> int:
    """Number of pairs of which one order is missing, shows other touches or has the same answer."""
    pairs = [item.ask for item in items if item.ask.kind == "compare"]
    groups = itertools.groupby(sorted(pairs, key=lambda ask: (ask.group, ask.position)), key=lambda ask: ask.group)

    def complete(asks: list[Ask]) -> bool:
        if [ask.position for ask in asks] != [0, 1]:
            return False
        one, other = asks
        return one.touches == other.touches[::-1] and one.answer[0] == 1 - other.answer[0]

    return sum(not complete(list(members)) for _, members in groups)


def _supports_answer(item: Item) -> bool:
    reading, concluded = read_answer(item.ask, item.rationale)
    return reading.formatted and concluded == item.ask.answer
