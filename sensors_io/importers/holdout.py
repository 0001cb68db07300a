"""Deterministic held-out splits by object."""

import collections
import dataclasses
import hashlib
from collections.abc import Iterable
from collections.abc import Sequence as Seq

from sensors_io.schema import ATTRIBUTES, UNKNOWN, ObjectCard

Cell = tuple[str, int]  # an attribute and one of its levels


def hold_out(cards: Seq[ObjectCard], share: float) -> list[ObjectCard]:
    """The same cards, a share of the fully labelled training objects moved to the split "test".

    Objects are moved one by one, each time the one that brings the level counts c of the test split closest to the
    share of the training ones,

        Σ over attributes and levels (c − t)² / t,   t = share · count among the training objects,

    the smaller SHA-256 of the object's id first among equals, so that neither the order of the cards nor a random state
    matters.  An object that alone carries a level of an attribute in the training split stays there; the test split
    may come out smaller for it.

    Args:
      cards: one card per object.
      share: share of the fully labelled training objects, 0 ≤ share < 1.
    """
    train = [card for card in cards if card.split == "train"]
    left = _count(train)
    candidates = sorted((c for c in train if UNKNOWN not in c.label_row()), key=_digest)
    target = {cell: share * n for cell, n in _count(candidates).items()}
    taken: collections.Counter[Cell] = collections.Counter()
    moved: set[str] = set()
    for _ in range(round(share * len(candidates))):
        free = [c for c in candidates if c.object_id not in moved and all(left[cell] > 1 for cell in _cells(c))]
        if not free:
            break
        best = min(free, key=lambda card: _distance(taken + _count([card]), target))
        moved.add(best.object_id)
        taken += _count([best])
        left -= _count([best])
    return [dataclasses.replace(c, split="test") if c.object_id in moved else c for c in cards]


def split_by_name(names: Iterable[str], *, val_share: float, test_share: float) -> dict[str, str]:
    """Split of each name, for sources without labels to balance: in the order of their SHA-256, first test, then val.

    Args:
      names: ids of the objects, or of whatever must not be torn apart, such as a session; repeats count once.
      val_share, test_share: shares of the names, rounded.
    """
    order = sorted(set(names), key=lambda name: hashlib.sha256(name.encode()).hexdigest())
    test, val = round(test_share * len(order)), round(val_share * len(order))
    return {n: "test" if i < test else "val" if i < test + val else "train" for i, n in enumerate(order)}


def _cells(card: ObjectCard) -> list[Cell]:
    return [(a, card.labels[a]) for a in ATTRIBUTES if card.labels.get(a, UNKNOWN) != UNKNOWN]


def _count(cards: Iterable[ObjectCard]) -> collections.Counter[Cell]:
    return collections.Counter(cell for card in cards for cell in _cells(card))


def _distance(counts: collections.Counter[Cell], target: dict[Cell, float]) -> float:
    return sum((counts[cell] - t) ** 2 / t for cell, t in target.items())


def _digest(card: ObjectCard) -> str:
    return hashlib.sha256(card.object_id.encode()).hexdigest()
