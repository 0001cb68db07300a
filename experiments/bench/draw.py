"""Which questions are asked: drawn so that answers balance, objects are used alike and pairs come in both orders."""

import collections
import dataclasses
import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from experiments.bench.contacts import MeasuredContact
from experiments.bench.wording import WORDINGS
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import KINDS, Ask
from touchr1_jax.bench.metrics import ORDINAL

COMPOSED = (*itertools.combinations(ORDINAL, 2), ORDINAL)
"""The sets of attributes that are asked for at once."""

LEVEL_PAIRS = ((0, 1), (1, 2), (0, 2))
"""Less and more, of the two objects of a comparison: never the same level."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quota:
    """How many questions of each kind; those of the full bench are the default, 4,800 in all.

    Args:
      compare: even, since every pair is asked in both orders.
      one_sensor: a multiple of the number of sensors.
    """

    identify: int = 1600
    scale: int = 600
    compose: int = 600
    compare: int = 600
    order: int = 600
    one_sensor: int = 480
    conflict: int = 320

    def __post_init__(self) -> None:
        for kind in KINDS:
            if getattr(self, kind) < 0:
                raise ValueError(f"quota.{kind} is {getattr(self, kind)}: must be ≥ 0; raise it")
        if self.compare % 2:
            raise ValueError(f"quota.compare is {self.compare}: must be even, pairs come in both orders; change it")

    @property
    def total(self) -> int:
        """Questions in all."""
        return sum(dataclasses.astuple(self))


class QuotaError(ValueError):
    """Contacts that do not suffice for a quota; the message names which and the fix."""


def draw(contacts: Sequence[MeasuredContact], sensors: Sequence[str], quota: Quota, seed: int) -> tuple[Ask, ...]:
    """Draw the questions; the same arguments give the same ones.

    Answers of a kind and attribute take each level that occurs equally often (±1); of the contacts that could give an
    answer the next is always one whose object was used least.  No two questions show the same in the same words.

    Args:
      contacts: of the bench's split.
      sensors: of the data set; a question shows those that measured something.
      quota: how many of each kind.
      seed: of what is left open.

    Raises:
      QuotaError: too few contacts for a quota.
    """
    deal = _Dealer(contacts, np.random.default_rng(seed))
    kinds: Mapping[str, Callable[[], Iterator[Ask]]] = {
        "identify": lambda: _singles(deal, sensors, "identify", ATTRIBUTES, quota.identify),
        "scale": lambda: _singles(deal, sensors, "scale", ORDINAL, quota.scale),
        "compose": lambda: _composed(deal, sensors, quota.compose),
        "compare": lambda: _pairs(deal, sensors, quota.compare),
        "order": lambda: _orders(deal, sensors, quota.order),
        "one_sensor": lambda: _alone(deal, sensors, quota.one_sensor),
        "conflict": lambda: _singles(deal, sensors, "conflict", ATTRIBUTES, quota.conflict),
    }
    return tuple(
        dataclasses.replace(ask, id=f"{kind}-{number:04d}")
        for kind in KINDS
        for number, ask in enumerate(kinds[kind]())
    )


class _Dealer:
    """Hands out contacts, those of the least used objects first, and wordings that were not used with them yet."""

    def __init__(self, contacts: Sequence[MeasuredContact], rng: np.random.Generator) -> None:
        self.contacts = contacts
        self.rng = rng
        self._uses = collections.Counter[str]()
        self._seen: set[Hashable] = set()
        self._wordings = collections.Counter[Hashable]()
        self._turns: dict[tuple[str, ...], list[int]] = {}

    def ranked(self, fits: Callable[[MeasuredContact], bool]) -> list[MeasuredContact]:
        """The contacts that fit, least used objects first, ties drawn."""
        fitting = [contact for contact in self.contacts if fits(contact)]
        ties = self.rng.random(len(fitting))
        order = sorted(range(len(fitting)), key=lambda i: (self._uses[fitting[i].touch.object], ties[i]))
        return [fitting[i] for i in order]

    def take(
        self, what: tuple[str, ...], answer: Sequence[Hashable], candidates: Iterable[tuple[MeasuredContact, ...]]
    ) -> tuple[list[MeasuredContact], int]:
        """The first candidates that some wording was not used with yet, and that wording: the one that asked least
        often for this answer, of equal ones the first of a drawn turn.

        The turn is the same for all answers: then those that a quota leaves over fall to the same wordings.

        Args:
          what: kind and attributes.
          answer: the right one, part by part.
          candidates: contacts to show, the best first.

        Raises:
          QuotaError: all of them were.
        """
        turn = self._turns.setdefault(what, self.rng.permutation(WORDINGS).tolist())
        used = lambda wording: [(what, part, level, wording) for part, level in enumerate(answer)]
        wordings = sorted(turn, key=lambda wording: sum(self._wordings[key] for key in used(wording)))
        for chosen in candidates:
            shown = tuple(sorted(contact.touch for contact in chosen))
            for wording in wordings:
                if (what, shown, wording) not in self._seen:
                    self._seen.add((what, shown, wording))
                    self._wordings.update(used(wording))
                    self._uses.update(contact.touch.object for contact in chosen)
                    return list(chosen), wording
        raise QuotaError(
            f"quota.{what[0]} is too large: no contact is left to ask for {', '.join(what[1:])} with the answer "
            f"{list(answer)}; lower it, or record more contacts"
        )


def _singles(deal: _Dealer, sensors: Sequence[str], kind: str, attributes: Sequence[str], quota: int) -> Iterator[Ask]:
    for attribute, count in zip(attributes, _split(quota, len(attributes)), strict=True):
        for level in _levels(deal, kind, attribute, count):
            ranked = deal.ranked(_with(kind, attribute, level))
            (contact,), wording = deal.take((kind, attribute), (level,), zip(ranked))
            yield _ask(kind, (attribute,), [contact], sensors, (level,), wording)


def _composed(deal: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    for attributes, count in zip(COMPOSED, _split(quota, len(COMPOSED)), strict=True):
        seen: collections.Counter[tuple[str, int]] = collections.Counter()
        for _ in range(count):
            ranked = _least_asked(deal, attributes, seen)
            levels = tuple(ranked[0].labels[a] for a in attributes) if ranked else ()
            (contact,), wording = deal.take(("compose", *attributes), levels, zip(ranked))
            levels = tuple(contact.labels[a] for a in attributes)
            seen.update(zip(attributes, levels, strict=True))
            yield _ask("compose", attributes, [contact], sensors, levels, wording)


def _pairs(deal: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    for attribute, count in zip(ORDINAL, _split(quota // 2, len(ORDINAL)), strict=True):
        known = {contact.labels.get(attribute) for contact in deal.contacts}
        pairs = [pair for pair in LEVEL_PAIRS if set(pair) <= known]
        if count and not pairs:
            raise QuotaError(f"quota.compare is too large: no two objects differ in {attribute}; set it to 0")
        for number in range(count):
            less, more = pairs[number % len(pairs)]
            chosen, wording = _differing(deal, ("compare", attribute), (less, more), ((less, more),))
            first = int(deal.rng.integers(2))
            for position, shown in enumerate((first, 1 - first)):
                touches = [chosen[shown], chosen[1 - shown]]
                ask = _ask("compare", (attribute,), touches, sensors, (int(shown == 0),), wording)
                yield dataclasses.replace(ask, group=f"{attribute}-{number:04d}", position=position)


def _orders(deal: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    for attribute, count in zip(ORDINAL, _split(quota, len(ORDINAL)), strict=True):
        for answer in _shuffled(deal, range(len(ORDERS)), count):
            rising, wording = _differing(deal, ("order", attribute), (0, 1, 2), (answer,))
            shown = [rising[ORDERS[answer].index(place)] for place in range(len(rising))]
            yield _ask("order", (attribute,), shown, sensors, (answer,), wording)


def _alone(deal: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    if quota % len(sensors) or (quota and len(sensors) < 2):
        raise QuotaError(
            f"quota.one_sensor is {quota}: must be a multiple of the {len(sensors)} sensors, of which there must be "
            "two; change it, 0 for none"
        )
    whole = set(sensors)
    for attribute, count in zip(ATTRIBUTES, _split(quota // len(sensors), len(ATTRIBUTES)), strict=True):
        for number, level in enumerate(_levels(deal, "one_sensor", attribute, count)):
            ranked = [c for c in deal.ranked(_with("one_sensor", attribute, level)) if set(c.measured) == whole]
            (contact,), wording = deal.take(("one_sensor", attribute), (level,), zip(ranked))
            for position, sensor in enumerate(sensors):
                ask = _ask("one_sensor", (attribute,), [contact], [sensor], (level,), wording)
                yield dataclasses.replace(ask, group=f"{attribute}-{number:04d}", position=position)


def _differing(
    deal: _Dealer, what: tuple[str, str], levels: Sequence[int], answer: Sequence[Hashable]
) -> tuple[list[MeasuredContact], int]:
    """Contacts of as many objects at these levels of the attribute, by the same motion."""
    ranked = [deal.ranked(_with(*what, level)) for level in levels]

    def candidates() -> Iterator[tuple[MeasuredContact, ...]]:
        for width in range(1, max(map(len, ranked)) + 1):  # the least used of every level first
            for chosen in itertools.product(*(contacts[:width] for contacts in ranked)):
                if len({contact.touch.motion for contact in chosen}) == 1:
                    yield chosen

    return deal.take(what, answer, candidates())


def _ask(
    kind: str,
    attributes: tuple[str, ...],
    contacts: Sequence[MeasuredContact],
    sensors: Sequence[str],
    answer: tuple[int, ...],
    wording: int,
) -> Ask:
    shown = tuple(s for s in sensors if all(s in contact.measured for contact in contacts))
    return Ask(
        id=kind,  # numbered when all are drawn
        kind=kind,
        attributes=attributes,
        touches=tuple(contact.touch for contact in contacts),
        sensors=shown,
        answer=answer,
        phrasing=wording,
        deceptive=contacts[0].deceptive if len(contacts) == 1 else None,
    )


def _levels(deal: _Dealer, kind: str, attribute: str, count: int) -> list[int]:
    """As many levels, each that occurs equally often, in a drawn order."""
    known = {c.labels[attribute] for c in deal.contacts if attribute in c.labels and _allowed(kind, c)}
    if count and not known:
        raise QuotaError(f"quota.{kind} is too large: no contact has a {attribute} to ask for; set it to 0")
    return _shuffled(deal, sorted(known), count)


def _shuffled(deal: _Dealer, choices: Sequence[int], count: int) -> list[int]:
    if not count:
        return []
    dealt = list(itertools.islice(itertools.cycle(deal.rng.permutation(choices).tolist()), count))
    return deal.rng.permutation(dealt).tolist()


def _with(kind: str, attribute: str, level: int) -> Callable[[MeasuredContact], bool]:
    """Whether a contact may be asked about and has this level."""
    return lambda contact: contact.labels.get(attribute) == level and _allowed(kind, contact)


def _least_asked(
    deal: _Dealer, attributes: Sequence[str], seen: Mapping[tuple[str, int], int]
) -> list[MeasuredContact]:
    """Contacts whose levels were asked for least; of equal ones, those of the least used objects."""
    ranked = deal.ranked(lambda contact: set(attributes) <= set(contact.labels))
    return sorted(ranked, key=lambda contact: sum(seen[a, contact.labels[a]] for a in attributes))


def _allowed(kind: str, contact: MeasuredContact) -> bool:
    return kind != "conflict" or contact.deceptive is True


def _split(total: int, parts: int) -> list[int]:
    """Equal parts of a number; the first ones have what is left over."""
    return [total // parts + (i < total % parts) for i in range(parts)]
