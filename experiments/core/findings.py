"""What a measuring experiment hands back: requirements held against measured figures, tables, pictures."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from experiments.core.artifacts import jsonable
from experiments.core.checks import require

Cell = str | float | int | bool | None
"""What a table holds; `None` where nothing was measured."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """A figure and the bound that it must keep; `better` says on which side of the bound it must lie."""

    name: str
    measured: float
    bound: float
    better: Literal["lower", "higher"]
    unit: str = ""
    note: str = ""

    @property
    def met(self) -> bool:
        """Whether the figure keeps its bound."""
        return self.measured <= self.bound if self.better == "lower" else self.measured >= self.bound

    def to_json(self) -> dict[str, Any]:
        """Its fields, and whether it is met."""
        return dataclasses.asdict(self) | {"met": self.met}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Column:
    """One column of a table: heading, unit, format of its numbers, what it means."""

    name: str
    unit: str = ""
    format: str = ".3g"
    meaning: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """Measured figures under named columns; the first column names the row."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    def __post_init__(self) -> None:
        width = len(self.columns)
        for i, row in enumerate(self.rows):
            ok = len(row) == width
            require(ok, f"table {self.title!r} row {i}", row, f"must have {width} cells", "give every column a cell")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Picture:
    """A chart or an image: `kind` says what `content` is; `name` is its file's in `plots/`, without the ending."""

    name: str
    title: str
    caption: str
    content: bytes
    kind: Literal["svg", "png"] = "svg"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Findings:
    """The outcome of a measuring experiment, checked when it is made.

    Args:
      verdict: sentences that answer the experiment's question from the figures.
      requirements: figures with bounds.
      tables, pictures: in the order of the report.
      settings: what a reader must know first, such as machine and sizes.
      data, timing: sizes of the data, seconds; anything that JSON can hold.

    Raises:
      ResultsError: no verdict, a requirement that is not finite, two pictures of one name.
    """

    verdict: tuple[str, ...]
    requirements: tuple[Requirement, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    timing: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        require(bool(self.verdict), "verdict", self.verdict, "must hold a sentence", "answer the question")
        for r in self.requirements:
            ok = math.isfinite(r.measured) and math.isfinite(r.bound)
            require(ok, f"requirement {r.name!r}", (r.measured, r.bound), "must be finite", "leave it out")
        names = [p.name for p in self.pictures]
        require(len(set(names)) == len(names), "pictures", names, "must have names of their own", "rename one")

    def to_json(self, description: Mapping[str, Any]) -> dict[str, Any]:
        """The content of `results.json`; pictures lie in `plots/`.

        Args:
          description: that of the run's `config.json`: `experiment`, `scale`, `config` and `git`.
        """
        shown = {name: getattr(self, name) for name in ("verdict", "tables", "settings", "timing", "data")}
        return outcome_json(description, self.requirements, shown)


def outcome_json(
    description: Mapping[str, Any], requirements: Sequence[Requirement], shown: Mapping[str, Any]
) -> dict[str, Any]:
    """What `results.json` holds of any experiment: which run it was, its requirements, what it shows, its config.

    Args:
      description: that of the run's `config.json`: `experiment`, `scale`, `config` and `git`.
      requirements: figures with bounds.
      shown: name → anything that JSON can hold.
    """
    git = description["git"]
    return {
        "experiment": description["experiment"],
        "scale": description["scale"],
        "git": git["commit"] + ("-dirty" if git["dirty"] else ""),
        "requirements": jsonable([r.to_json() for r in requirements], where="requirements"),
        **{name: jsonable(value, where=name) for name, value in shown.items()},
        "config": description["config"],
    }
