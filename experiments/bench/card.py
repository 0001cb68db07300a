"""The data card: what a bench must be before anybody is scored on it, each a check that fails the build.

A shortcut that needs no touch shows as a constant or a look-up that beats chance, so the card scores them.
"""

import collections
import dataclasses
import itertools
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence

from experiments.bench.contacts import MeasuredContact, SplitContacts
from experiments.bench.wording import choices, understand
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.items import Ask, Item

BALANCE, CONSTANT, WORDING = 3.0, 3.0, 6.0
"""Points over equal shares that the commonest answer, the training mode and the best answer to each wording may have.

With nine materials and twenty questions to a wording, three of one material instead of two are five points."""

FEWEST = 30
"""Questions of a kind and attribute from which on shares are judged: with fewer one question is three points."""

LEAST_OBJECTS = 0.95
"""Of the objects of the split, those that some question must show."""


class CardError(ValueError):
    """Items that break the card; the message names every check that failed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CardCheck:
    """A number that must not exceed a bound, and what it means."""

    name: str
    measured: float
    bound: float
    unit: str
    meaning: str

    @property
    def passed(self) -> bool:
        """Whether the bound is kept."""
        return self.measured <= self.bound


def checks(items: Sequence[Item], bench: SplitContacts, train: SplitContacts) -> tuple[CardCheck, ...]:
    """Every check of the card.

    Args:
      items: the bench.
      bench, train: contacts of its split and of the training split.
    """
    shown = {touch.object for item in items for touch in item.ask.touches}
    cells = _cells(items)
    return (
        _zero("training objects in the bench", len(shown & train.objects()), "by name"),
        _zero(
            "objects that no label of the split knows",
            len(shown - bench.objects()),
            "shown, but not in the bench's split",
        ),
        _zero("contacts that equal a training contact", _copies(items, bench, train), "by all that was recorded"),
        _zero(
            "questions asked twice", len(items) - len({_content(item) for item in items}), "same touches, same words"
        ),
        _zero("pairs not in both orders", _lone_pairs(items), "each once, with opposite answers"),
        _zero("rationales against the answer", _against(items), "or not in the three segments"),
        CardCheck(
            name="objects never shown",
            measured=100.0 * len(bench.objects() - shown) / len(bench.objects()),
            bound=100.0 * (1 - LEAST_OBJECTS),
            unit="%",
            meaning="of the split",
        ),
        _most("commonest answer over equal shares", cells, _commonest, BALANCE),
        _most("training mode over chance", cells, lambda c, s: _mode(c, s, train.contacts), CONSTANT),
        _most("best answer to each wording over chance", cells, _by_wording, WORDING),
    )


def require(results: Sequence[CardCheck]) -> None:
    """Fail the build.

    Raises:
      CardError: naming every check that did not pass.
    """
    failed = [c for c in results if not c.passed]
    if failed:
        told = "; ".join(f"{c.name} is {c.measured:.4g} {c.unit}, must be ≤ {c.bound:g} ({c.meaning})" for c in failed)
        raise CardError(f"{told}; nothing is written until the records or the quota are corrected")


Cell = tuple[str, str]
"""Kind and attribute; each part of a composed answer is a cell of its own."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnswerShare:
    """How often each level is the answer of a cell."""

    kind: str
    attribute: str
    questions: int
    counts: tuple[int, ...]


def shares(items: Sequence[Item]) -> list[AnswerShare]:
    """The answers of every cell."""
    return [
        AnswerShare(
            kind=kind,
            attribute=attribute,
            questions=len(rows),
            counts=tuple(sum(level == k for _, level in rows) for k in range(_count(rows, attribute))),
        )
        for (kind, attribute), rows in _cells(items).items()
    ]


_Rows = list[tuple[Ask, int]]


def _cells(items: Sequence[Item]) -> dict[Cell, _Rows]:
    """Questions and answers by cell."""
    cells: dict[Cell, _Rows] = {}
    for ask in (item.ask for item in items):
        names = ask.attributes if len(ask.answer) == len(ask.attributes) else ask.attributes[:1]
        for name, level in zip(names, ask.answer, strict=True):
            cells.setdefault((ask.kind, name), []).append((ask, level))
    return cells


def _count(rows: _Rows, attribute: str) -> int:
    """Levels that an answer of the cell may have."""
    ask = rows[0][0]
    return len(choices(ask)[ask.attributes.index(attribute)])


def _occurring(rows: _Rows) -> int:
    return len({level for _, level in rows})


def _most(name: str, cells: Mapping[Cell, _Rows], excess: Callable[[Cell, _Rows], float], bound: float) -> CardCheck:
    """The worst cell."""
    judged = {cell: excess(cell, rows) for cell, rows in cells.items() if len(rows) >= FEWEST}
    worst = max(judged, key=lambda cell: judged[cell], default=None)
    return CardCheck(
        name=name,
        measured=0.0 if worst is None else judged[worst],
        bound=bound,
        unit="points",
        meaning="nothing to judge" if worst is None else f"the worst is {worst[0]} {worst[1]}",
    )


def _commonest(cell: Cell, rows: _Rows) -> float:
    counts = collections.Counter(level for _, level in rows)
    return 100.0 * (max(counts.values()) / len(rows) - 1 / _occurring(rows))


def _mode(cell: Cell, rows: _Rows, train: Sequence[MeasuredContact]) -> float:
    """What the commonest level of the training contacts would score; comparisons have no such level."""
    kind, attribute = cell
    counts = collections.Counter(c.labels[attribute] for c in train if attribute in c.labels)
    if kind in ("compare", "order") or not counts:
        return 0.0
    mode = min(counts, key=lambda level: (-counts[level], level))
    return 100.0 * (sum(level == mode for _, level in rows) / len(rows) - 1 / _occurring(rows))


def _by_wording(cell: Cell, rows: _Rows) -> float:
    """What the commonest answer to each wording would score on the very same questions."""
    by_wording: dict[int, collections.Counter[int]] = {}
    for ask, level in rows:
        by_wording.setdefault(ask.phrasing, collections.Counter())[level] += 1
    right = sum(max(counts.values()) for counts in by_wording.values())
    return 100.0 * (right / len(rows) - 1 / _occurring(rows))


def _zero(name: str, count: int, meaning: str) -> CardCheck:
    return CardCheck(name=name, measured=float(count), bound=0.0, unit="", meaning=meaning)


def _copies(items: Sequence[Item], bench: SplitContacts, train: SplitContacts) -> int:
    shown = {touch for item in items for touch in item.ask.touches}
    known = {contact.fingerprint for contact in train.contacts}
    return sum(contact.touch in shown and contact.fingerprint in known for contact in bench.contacts)


def _content(item: Item) -> Hashable:
    return item.ask.touches, item.ask.sensors, item.question


def _lone_pairs(items: Sequence[Item]) -> int:
    """Pairs of which one order is missing, shows something else or has the same answer."""
    pairs = [item.ask for item in items if item.ask.kind == "compare"]
    groups = itertools.groupby(sorted(pairs, key=lambda ask: (ask.group, ask.position)), key=lambda ask: ask.group)
    return sum(not _is_pair(list(members)) for _, members in groups)


def _is_pair(asks: list[Ask]) -> bool:
    if [ask.position for ask in asks] != [0, 1]:
        return False
    one, other = asks
    return one.touches == other.touches[::-1] and one.answer[0] == 1 - other.answer[0]


def _against(items: Sequence[Item]) -> int:
    def stands(item: Item) -> bool:
        reading, concluded = understand(item.ask, item.rationale)
        return reading.formatted and concluded == item.ask.answer

    return sum(not stands(item) for item in items)


def coverage(bench: SplitContacts) -> Iterator[tuple[str, dict[int, int]]]:
    """How many objects of the split have each level, by attribute."""
    labels = {contact.touch.object: contact.labels for contact in bench.contacts}
    for name in ATTRIBUTES:
        yield name, dict(sorted(collections.Counter(of[name] for of in labels.values() if name in of).items()))
