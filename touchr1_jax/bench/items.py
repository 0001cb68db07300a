"""The questions of the touch bench, and the JSON Lines that store them.

Four tiers of seven kinds.  A file has one item per line, an object with these fields and no others:

    format      "touchr1-bench/1"
    id          unique in the file
    tier, kind  as in `KINDS`
    attributes  names of what is asked for; one, or several where the kind is "compose"
    touches     the contacts shown, each {"object", "site", "motion", "trial"}: one, two to compare, three to order
    sensors     names of the sensors whose streams are shown of every touch
    view        whether the picture of the object is shown
    phrasing    number of the wording, where several are in use
    group       name shared by items that belong together: the two orders of a pair, the sensors of one touch; or ""
    position    place in the group
    deceptive   true if the object was made to look like another one; null where unknown
    answer      levels of the attributes; for "compare" [0] or [1], the touch that has more; for "order" [k], the
                position in `comparison.ORDERS` of the touches from the least to the most
    question, rationale
    evidence    measurements that the rationale cites, each {"touch", "sensor", "quantity", "value", "unit", "at"};
                `at` is (x, y) as shares of the sensor's window
"""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from typing import Any, Self

from touchr1_jax.bench.comparison import ORDERS
from touchr1_jax.bench.json_lines import read_lines, write_lines

FORMAT = "touchr1-bench/1"


class ItemError(ValueError):
    """An item that breaks the format; the message names where, the field, the value, the constraint and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of question: tier, number of touches shown, `view` if the object's picture is shown, meaning."""

    tier: int
    touches: int
    view: bool
    meaning: str


KINDS: Mapping[str, Kind] = {
    "identify": Kind(tier=1, touches=1, view=True, meaning="one property of a touch"),
    "scale": Kind(tier=2, touches=1, view=True, meaning="one property on its scale, the levels given in order"),
    "compose": Kind(tier=2, touches=1, view=True, meaning="several properties of a touch at once"),
    "compare": Kind(tier=3, touches=2, view=False, meaning="which of two has more of a property (SFD), in both orders"),
    "order": Kind(tier=3, touches=3, view=False, meaning="three from the least to the most of a property (SOI)"),
    "one_sensor": Kind(tier=4, touches=1, view=False, meaning="one property from each sensor alone (CSC)"),
    "conflict": Kind(tier=4, touches=1, view=True, meaning="one property of an object that looks like another"),
}
"""Every kind of question, in the order of the tables."""


@dataclasses.dataclass(frozen=True, kw_only=True, order=True)
class Touch:
    """A contact of an object, named as in its records."""

    object: str
    site: int
    motion: str
    trial: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Citation:
    """A measurement that a rationale cites; `touch` counts from 0, `at` is (x, y) as shares of the window."""

    touch: int
    sensor: str
    quantity: str
    value: float
    unit: str
    at: tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ask:
    """A question and its right answer, not yet in words; fields as in the module."""

    id: str
    kind: str
    attributes: tuple[str, ...]
    touches: tuple[Touch, ...]
    sensors: tuple[str, ...]
    answer: tuple[int, ...]
    phrasing: int = 0
    group: str = ""
    position: int = 0
    deceptive: bool | None = None

    def __post_init__(self) -> None:
        _require(bool(self.id), "id", self.id, "must not be empty", "name the item")
        _require(self.kind in KINDS, f"{self.id}: kind", self.kind, f"must be one of {', '.join(KINDS)}", "rename it")
        touches = KINDS[self.kind].touches
        _require(
            len(self.touches) == touches,
            f"{self.id}: touches",
            len(self.touches),
            f"must be {touches} for {self.kind!r}",
            "show as many",
        )
        _require(bool(self.attributes), f"{self.id}: attributes", [], "must not be empty", "ask for one")
        _require(bool(self.sensors), f"{self.id}: sensors", [], "must not be empty", "show one sensor")
        self._check_answer()

    def _check_answer(self) -> None:
        choices = {"compare": 2, "order": len(ORDERS)}.get(self.kind)
        count = len(self.attributes) if choices is None else 1
        ok = len(self.answer) == count and all(a >= 0 and (choices is None or a < choices) for a in self.answer)
        must = f"must be {count} numbers ≥ 0" + ("" if choices is None else f" below {choices}")
        _require(ok, f"{self.id}: answer", list(self.answer), must, "correct it")

    @property
    def tier(self) -> int:
        """1 to 4."""
        return KINDS[self.kind].tier

    @property
    def cluster(self) -> str:
        """The object that an interval over objects resamples with this item: both orders of a pair have the same."""
        return min(touch.object for touch in self.touches)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Item:
    """A question in words, its answer and the rationale."""

    ask: Ask
    question: str
    rationale: str
    evidence: tuple[Citation, ...] = ()

    def __post_init__(self) -> None:
        for field in ("question", "rationale"):
            text = getattr(self, field)
            _require(bool(text.strip()), f"{self.ask.id}: {field}", text, "must not be empty", "write it")

    def to_json(self) -> dict[str, Any]:
        """The fields of the module, in its order."""
        plain = dataclasses.asdict(self.ask)
        head = ("attributes", "touches", "sensors")
        tail = ("phrasing", "group", "position", "deceptive")
        return {
            "format": FORMAT,
            "id": self.ask.id,
            "tier": self.ask.tier,
            "kind": self.ask.kind,
            **{name: list(plain[name]) for name in head},
            "view": KINDS[self.ask.kind].view,
            **{name: plain[name] for name in tail},
            "answer": list(self.ask.answer),
            "question": self.question,
            "rationale": self.rationale,
            "evidence": [dataclasses.asdict(c) | {"at": list(c.at)} for c in self.evidence],
        }

    @classmethod
    def from_json(cls, tree: Mapping[str, Any]) -> Self:
        """The inverse of `to_json`.

        Raises:
          ItemError: another format, fields that are missing or too many, or a value that breaks the format.
        """
        _require(tree.get("format") == FORMAT, "format", tree.get("format"), f"must be {FORMAT!r}", "convert the file")
        names = [field.name for field in dataclasses.fields(Ask)]
        try:
            plain = {name: tree[name] for name in names} | {"touches": tuple(Touch(**t) for t in tree["touches"])}
            for name in ("attributes", "sensors", "answer"):
                plain[name] = tuple(plain[name])
            evidence = tuple(citation_of(c) for c in tree["evidence"])
            item = cls(ask=Ask(**plain), question=tree["question"], rationale=tree["rationale"], evidence=evidence)
        except (KeyError, TypeError, AttributeError) as error:
            raise ItemError(
                f"item {tree.get('id')!r} has a field missing or of another type: {error}; correct it"
            ) from error
        extra = sorted(set(tree) ^ set(item.to_json()))
        _require(not extra, f"{item.ask.id}: fields", extra, "must be those of the format", "drop or add them")
        for name in ("tier", "view"):
            _require(
                tree[name] == item.to_json()[name], f"{item.ask.id}: {name}", tree[name], "must fit its kind", "fix it"
            )
        return item


def citation_of(tree: Mapping[str, Any]) -> Citation:
    """A citation from its JSON."""
    x, y = tree["at"]
    return Citation(**{**tree, "value": float(tree["value"]), "at": (float(x), float(y))})


def write_items(path: str | os.PathLike[str], items: Iterable[Item]) -> None:
    """Replace a file of items in one step; equal items give equal bytes."""
    write_lines(path, (item.to_json() for item in items))


def read_items(path: str | os.PathLike[str]) -> tuple[Item, ...]:
    """The items of a file.

    Raises:
      ItemError: naming the line; an id that occurs twice; a file without items.
    """
    items = []
    for number, tree in read_lines(path):
        try:
            items.append(Item.from_json(tree))
        except ItemError as error:
            raise ItemError(f"{path}, line {number}: {error}") from error
    _require(bool(items), "number of items", 0, f"must be ≥ 1 in {path}", "write them first")
    seen: set[str] = set()
    for item in items:
        _require(item.ask.id not in seen, f"{path}: id", item.ask.id, "must be unique", "rename one of them")
        seen.add(item.ask.id)
    return tuple(items)


def _require(ok: bool, field: str, value: object, constraint: str, fix: str) -> None:
    if not ok:
        raise ItemError(f"{field} is {value!r}: {constraint}; {fix}")
