"""Who is dominated: of several things measured on several axes, those that another one beats."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from experiments.core.errors import require

Better = Literal["lower", "higher"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Axis:
    """A column of a table that things are judged by; `column` begins its name."""

    column: str
    better: Better


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One thing and where it lies on each axis, every axis turned so that lower is better."""

    name: str
    at: tuple[float, ...]

    def beats(self, other: "Point") -> bool:
        """Nowhere worse and somewhere better."""
        return all(a <= b for a, b in zip(self.at, other.at, strict=True)) and self.at != other.at


def points_of(table: Mapping[str, Any], axes: Sequence[Axis]) -> tuple[Point, ...]:
    """The rows of a table of `results.json` that have a number on every axis.

    Args:
      table: `columns` and `rows`; the first column names the row.
      axes: what to judge by; the first column whose name begins so is taken.

    Raises:
      ResultsError: an axis that the table has no column for.
    """
    names = [column["name"] for column in table["columns"]]
    places = []
    for axis in axes:
        found = [i for i, name in enumerate(names) if name.startswith(axis.column)]
        require(
            bool(found), f"axis of table {table['title']!r}", axis.column, f"must begin one of {names}", "rename it"
        )
        places.append((found[0], 1.0 if axis.better == "lower" else -1.0))
    rows = [(row[0], [(row[i], sign) for i, sign in places]) for row in table["rows"]]
    return tuple(
        Point(name=str(name), at=tuple(sign * float(value) for value, sign in cells))
        for name, cells in rows
        if all(isinstance(value, int | float) and not isinstance(value, bool) for value, _ in cells)
    )


def front(points: Sequence[Point]) -> tuple[Point, ...]:
    """The points that no other one beats, in their order."""
    return tuple(p for p in points if not any(other.beats(p) for other in points))


def dominators(name: str, points: Sequence[Point]) -> tuple[Point, ...] | None:
    """The points that beat the named one, the nearest front first; `None` where it was not measured."""
    mine = [p for p in points if p.name == name]
    if not mine:
        return None
    best = front(points)
    beating = [p for p in points if p.beats(mine[0])]
    return tuple(sorted(beating, key=lambda p: p not in best))
