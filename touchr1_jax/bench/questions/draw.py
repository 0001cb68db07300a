"""Draw the questions so that answers are balanced, objects are used equally often and pairs come in both orders."""

import collections
import dataclasses
import functools
import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.items import KINDS, Ask
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.questions.contacts import MeasuredContact
from touchr1_jax.bench.questions.wording import LEVELS, WORDINGS

COMPOSED = (*itertools.combinations(ORDINAL, 2), ORDINAL)
"""The sets of attributes that one question asks for together."""

LEVEL_PAIRS = ((0, 1), (1, 2), (0, 2))
"""Levels of the two objects of a comparison, less and more; equal levels are never compared."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quota:
    """Number of questions of each kind; the default is the full bench of 4,800.

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
        """Number of all questions."""
        return sum(dataclasses.astuple(self))


class QuotaError(ValueError):
    """Contacts that do not suffice for a quota; the message names the quota and the fix."""


def draw(contacts: Sequence[MeasuredContact], sensors: Sequence[str], quota: Quota, seed: int) -> tuple[Ask, ...]:
    """Draw the questions; equal arguments give equal questions.

    For each kind and attribute every level that occurs is the right answer equally often (±1).  Of the contacts that
    could give an answer, the next one shows an object that was used least.  No two questions show the same touches in
    the same words.

    A question shows those of the data set's sensors that measured all of its touches.

    Raises:
      QuotaError: too few contacts for a quota.
    """
    dealer = _Dealer(contacts, np.random.default_rng(seed))
    draw_kind: Mapping[str, Callable[[_Dealer, Sequence[str], int], Iterator[Ask]]] = {
        "identify": functools.partial(_singles, "identify", tuple(LEVELS)),
        "scale": functools.partial(_singles, "scale", ORDINAL),
        "compose": _composed,
        "compare": _pairs,
        "order": _orders,
        "one_sensor": _by_one_sensor,
        "conflict": functools.partial(_singles, "conflict", tuple(LEVELS)),
    }
    return tuple(
        dataclasses.replace(ask, id=f"{kind}-{number:04d}")
        for kind in KINDS
        for number, ask in enumerate(draw_kind[kind](dealer, sensors, getattr(quota, kind)))
    )


class _Dealer:
    """Deals contacts, those of the least used objects first, with a wording that was not used with them before."""

    def __init__(self, contacts: Sequence[MeasuredContact], rng: np.random.Generator) -> None:
        self.contacts = contacts
        self.rng = rng
        self._uses = collections.Counter[str]()
        self._seen: set[Hashable] = set()
        self._wordings = collections.Counter[Hashable]()
        self._orders: dict[tuple[str, ...], list[int]] = {}

    def ranked(self, fits: Callable[[MeasuredContact], bool]) -> list[MeasuredContact]:
        """The contacts that fit, those of the least used objects first, ties in random order."""
        fitting = [contact for contact in self.contacts if fits(contact)]
        ties = self.rng.random(len(fitting))
        order = sorted(range(len(fitting)), key=lambda i: (self._uses[fitting[i].touch.object], ties[i]))
        return [fitting[i] for i in order]

    def with_level(self, kind: str, attribute: str, level: int) -> list[MeasuredContact]:
        """The ranked contacts of a level that questions of this kind may show."""
        return self.ranked(lambda contact: contact.labels.get(attribute) == level and _allowed(kind, contact))

    def take(
        self, topic: tuple[str, ...], answer: Sequence[Hashable], candidates: Iterable[tuple[MeasuredContact, ...]]
    ) -> tuple[list[MeasuredContact], int]:
        """The first candidates that were not used with every wording yet, and their wording.

        The wording is the one used least for this answer, part by part; ties are broken by a random order that is the
        same for all answers, so that the questions by which a quota exceeds a multiple fall to the same wordings.
        """
        order = self._orders.setdefault(topic, self.rng.permutation(WORDINGS).tolist())
        keys = lambda wording: [(topic, part, level, wording) for part, level in enumerate(answer)]
        wordings = sorted(order, key=lambda wording: sum(self._wordings[key] for key in keys(wording)))
        for chosen in candidates:
            shown = tuple(sorted(contact.touch for contact in chosen))
            for wording in wordings:
                if (topic, shown, wording) not in self._seen:
                    self._seen.add((topic, shown, wording))
                    self._wordings.update(keys(wording))
                    self._uses.update(contact.touch.object for contact in chosen)
                    return list(chosen), wording
        raise QuotaError(
            f"quota.{topic[0]} is too large: no contact is left to ask for {', '.join(topic[1:])} with the answer "
            f"{list(answer)}; lower it, or record more contacts"
        )

    def take_differing(
        self, topic: tuple[str, str], levels: Sequence[int], answer: Sequence[Hashable]
    ) -> tuple[list[MeasuredContact], int]:
        """Contacts by one motion whose objects have these levels of the attribute, and their wording."""
        ranked = [self.with_level(*topic, level) for level in levels]

        def candidates() -> Iterator[tuple[MeasuredContact, ...]]:
            for width in range(1, max(map(len, ranked)) + 1):  # the least used objects of every level first
                for chosen in itertools.product(*(contacts[:width] for contacts in ranked)):
                    if len({contact.touch.motion for contact in chosen}) == 1:
                        yield chosen

        return self.take(topic, answer, candidates())

    def shuffled(self, choices: Sequence[int], count: int) -> list[int]:
        """`count` choices, each equally often (±1), in random order."""
        if not count:
            return []
        dealt = list(itertools.islice(itertools.cycle(self.rng.permutation(choices).tolist()), count))
        return self.rng.permutation(dealt).tolist()

    def levels(self, kind: str, attribute: str, count: int) -> list[int]:
        """`count` levels, each that occurs equally often (±1), in random order."""
        known = {c.labels[attribute] for c in self.contacts if attribute in c.labels and _allowed(kind, c)}
        if count and not known:
            raise QuotaError(f"quota.{kind} is too large: no contact has a {attribute} to ask for; set it to 0")
        return self.shuffled(sorted(known), count)


def _singles(
    kind: str, attributes: Sequence[str], dealer: _Dealer, sensors: Sequence[str], quota: int
) -> Iterator[Ask]:
    for attribute, count in zip(attributes, _split(quota, len(attributes)), strict=True):
        for level in dealer.levels(kind, attribute, count):
            ranked = dealer.with_level(kind, attribute, level)
            (contact,), wording = dealer.take((kind, attribute), (level,), zip(ranked))
            yield _ask(kind, (attribute,), [contact], sensors, (level,), wording)


def _composed(dealer: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    for attributes, count in zip(COMPOSED, _split(quota, len(COMPOSED)), strict=True):
        seen: collections.Counter[tuple[str, int]] = collections.Counter()
        for _ in range(count):
            ranked = dealer.ranked(lambda contact: set(attributes) <= set(contact.labels))  # noqa: B023
            ranked.sort(key=lambda contact: sum(seen[a, contact.labels[a]] for a in attributes))  # least asked first
            levels = tuple(ranked[0].labels[a] for a in attributes) if ranked else ()
            (contact,), wording = dealer.take(("compose", *attributes), levels, zip(ranked))
            levels = tuple(contact.labels[a] for a in attributes)
            seen.update(zip(attributes, levels, strict=True))
            yield _ask("compose", attributes, [contact], sensors, levels, wording)


def _pairs(dealer: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    for attribute, count in zip(ORDINAL, _split(quota // 2, len(ORDINAL)), strict=True):
        known = {contact.labels.get(attribute) for contact in dealer.contacts}
        pairs = [pair for pair in LEVEL_PAIRS if set(pair) <= known]
        if count and not pairs:
            raise QuotaError(f"quota.compare is too large: no two objects differ in {attribute}; set it to 0")
        for number in range(count):
            levels = pairs[number % len(pairs)]
            chosen, wording = dealer.take_differing(("compare", attribute), levels, (levels,))
            first = int(dealer.rng.integers(2))
            for position, shown in enumerate((first, 1 - first)):
                touches = [chosen[shown], chosen[1 - shown]]
                ask = _ask("compare", (attribute,), touches, sensors, (int(shown == 0),), wording)
                yield dataclasses.replace(ask, group=f"{attribute}-{number:04d}", position=position)


def _orders(dealer: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    for attribute, count in zip(ORDINAL, _split(quota, len(ORDINAL)), strict=True):
        for answer in dealer.shuffled(range(len(ORDERS)), count):
            rising, wording = dealer.take_differing(("order", attribute), (0, 1, 2), (answer,))
            shown = [rising[ORDERS[answer].index(place)] for place in range(len(rising))]
            yield _ask("order", (attribute,), shown, sensors, (answer,), wording)


def _by_one_sensor(dealer: _Dealer, sensors: Sequence[str], quota: int) -> Iterator[Ask]:
    if quota % len(sensors) or (quota and len(sensors) < 2):
        raise QuotaError(
            f"quota.one_sensor is {quota}: must be a multiple of the {len(sensors)} sensors, of which there must be "
            "two; change it, 0 for none"
        )
    for attribute, count in zip(LEVELS, _split(quota // len(sensors), len(LEVELS)), strict=True):
        for number, level in enumerate(dealer.levels("one_sensor", attribute, count)):
            ranked = dealer.with_level("one_sensor", attribute, level)
            complete = [contact for contact in ranked if set(contact.measured) == set(sensors)]
            (contact,), wording = dealer.take(("one_sensor", attribute), (level,), zip(complete))
            for position, sensor in enumerate(sensors):
                ask = _ask("one_sensor", (attribute,), [contact], [sensor], (level,), wording)
                yield dataclasses.replace(ask, group=f"{attribute}-{number:04d}", position=position)


def _ask(
    kind: str,
    attributes: tuple[str, ...],
    contacts: Sequence[MeasuredContact],
    sensors: Sequence[str],
    answer: tuple[int, ...],
    wording: int,
) -> Ask:
    return Ask(
        id=kind,  # numbered when all are drawn
        kind=kind,
        attributes=attributes,
        touches=tuple(contact.touch for contact in contacts),
        sensors=tuple(s for s in sensors if all(s in contact.measured for contact in contacts)),
        answer=answer,
        phrasing=wording,
        deceptive=contacts[0].deceptive if len(contacts) == 1 else None,
    )


def _allowed(kind: str, contact: MeasuredContact) -> bool:
    return kind != "conflict" or contact.deceptive is True


def _split(total: int, parts: int) -> list[int]:
    """A number in equal parts; the first ones take the remainder."""
    return [total // parts + (i < total % parts) for i in range(parts)]
