"""The outcome of an experiment: requirements, tables and pictures; of trained arms also estimates and comparisons."""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from experiments.core.artifacts import jsonable
from experiments.core.errors import require
from touchr1_jax.bench.scoring import REPORTED

SETTINGS = ("preset", "lr_scale")  # settings without which no report can be read

Slot = tuple[int, int, str]  # start, end and segment (`perceive`, `compare` or `conclude`) of a piece of a trace

Cell = str | float | int | bool | None  # what a table holds; `None` where nothing was measured


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """A figure and the bound that it must keep; `better` is the side of the bound on which it must lie."""

    name: str
    measured: float
    bound: float
    better: Literal["lower", "higher"]
    unit: str = ""
    note: str = ""

    @property
    def met(self) -> bool:
        """True if the figure keeps its bound."""
        return self.measured <= self.bound if self.better == "lower" else self.measured >= self.bound


def at_most(name: str, measured: float, bound: float, unit: str = "", note: str = "") -> Requirement:
    """A figure that must not exceed its bound."""
    return Requirement(name=name, measured=float(measured), bound=bound, better="lower", unit=unit, note=note)


def at_least(name: str, measured: float, bound: float, unit: str = "", note: str = "") -> Requirement:
    """A figure that must not fall below its bound."""
    return Requirement(name=name, measured=float(measured), bound=bound, better="higher", unit=unit, note=note)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Column:
    """One column of a table: heading, unit, format of its numbers, what it means.

    With `link`, the name of a page, each cell is a folder and leads to that page in it.
    """

    name: str
    unit: str = ""
    format: str = ".3g"
    meaning: str = ""
    link: str = ""


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


def named_table(
    title: str,
    rows: Sequence[Mapping[str, Any]],
    *,
    formats: Mapping[str, str] = {},
    units: Mapping[str, str] = {},
    meanings: Mapping[str, str] = {},
    note: str = "",
) -> Table:
    """A table from rows that name their cells; the first column names the row.

    Args:
      title, note: heading, and a sentence above the table.
      rows: column → cell; columns are in the order in which rows first name them; a missing cell is `None`.
      formats, units, meanings: column → format of its numbers (".3g" by default), unit, explanation.

    Raises:
      ResultsError: a format, unit or meaning of a column that no row names.
    """
    names = list(dict.fromkeys(name for row in rows for name in row))
    for field, given in (("formats", formats), ("units", units), ("meanings", meanings)):
        unknown = sorted(set(given) - set(names))
        ok = not rows or not unknown
        require(ok, f"table {title!r} {field}", unknown, f"must name columns {names}", "rename or drop them")
    columns = tuple(
        Column(name=n, unit=units.get(n, ""), format=formats.get(n, ".3g"), meaning=meanings.get(n, "")) for n in names
    )
    return Table(title=title, columns=columns, rows=tuple(tuple(row.get(n) for n in names) for row in rows), note=note)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Picture:
    """A chart or an image: `kind` is the format of `content`, `name` the name of its file in `plots/`."""

    name: str
    title: str
    caption: str
    content: bytes
    kind: Literal["svg", "png"] = "svg"


class _Ci95:
    ci95: tuple[float, float]

    @property
    def low(self) -> float:
        return self.ci95[0]

    @property
    def high(self) -> float:
        return self.ci95[1]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate(_Ci95):
    """One metric of one arm: its mean over seeds, a 95 % interval and the value of every seed."""

    mean: float
    ci95: tuple[float, float]
    per_seed: tuple[float, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison(_Ci95):
    """`arm` minus `against` on one metric, paired.

    `over` is what the interval generalises to: other training `seeds` (Student t on paired per-seed differences) or
    other `objects` (clustered bootstrap of paired answers).  `p_value` is that of the sign-flip test over seeds,
    `improvement` the probability of improvement; both `None` where `over` is `objects`.
    """

    metric: str
    arm: str
    against: str
    difference: float
    ci95: tuple[float, float]
    over: Literal["seeds", "objects"]
    n: int
    p_value: float | None = None
    improvement: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trace:
    """A text and its parsed pieces, which must be in order, disjoint and end with the text at the latest."""

    text: str
    slots: tuple[Slot, ...]
    right: bool | None = None  # whether the answer concludes the true level; `None` where that is not known

    def __post_init__(self) -> None:
        end = 0
        for slot in self.slots:
            ok = end <= slot[0] <= slot[1] <= len(self.text)
            require(ok, "slots", slot, f"must follow {end} and end by {len(self.text)}", "sort and separate them")
            end = slot[1]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutExample:
    """One answer of the report, with the touch that it is about."""

    arm: str
    object_id: str
    question: str
    label: str
    trace: str
    slots: tuple[Slot, ...]  # the parsed pieces of the trace, in order and disjoint
    reward: Mapping[str, float]  # the value of each term; `total` their weighted sum
    total: float
    frames: Mapping[str, np.ndarray]  # sensor → uint8 [F, H, W, 3], RGB
    force_n: Mapping[str, np.ndarray]  # sensor → float [F, 3]
    view: np.ndarray | None = None  # uint8 [H, W, 3] RGB picture of the object, or `None`
    fields: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Sensor → uint8 [H, W, 3], its fields at the strongest press, drawn."""
    instead: Mapping[str, Trace] = dataclasses.field(default_factory=dict)
    """Replacement of the touch → the answer to it."""
    others: Mapping[str, Trace] = dataclasses.field(default_factory=dict)  # other arm → its answer to the same question
    right: bool | None = None  # whether the answer concludes the true level; `None` where that is not known
    group: str = ""  # heading that it shares with its neighbours; none by default

    def __post_init__(self) -> None:
        Trace(text=self.trace, slots=self.slots)
        for sensor, frames in self.frames.items():
            ok = frames.dtype == np.uint8 and frames.ndim == 4 and frames.shape[-1] == 3
            got = f"{frames.dtype}{list(frames.shape)}"
            require(ok, f"frames[{sensor}]", got, "must be uint8 [F, H, W, 3]", "convert them to RGB")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Results:
    """The outcome of an experiment, checked when it is made.

    Args:
      verdict: sentences that answer the experiment's question from the figures.
      requirements: figures with bounds.
      tables, pictures: in the order of the report.
      settings: what a reader must know first, such as machine and sizes; with arms `preset` and `lr_scale` at least.
      arms, baselines: name → metric → estimate; all arms have the same seeds, baselines may differ.  A measuring
        experiment has none.
      comparisons: paired differences between arms.
      data, timing: sizes of the data, seconds; anything that JSON can hold.
      curves: phase → names of the logged scalars to draw, over those of the experiment.
      examples: a few rollouts; they go into the report, not into `results.json`.

    Raises:
      ResultsError: neither arms nor a verdict, an unknown metric, a number that is not finite, an interval out of
        order, unequal numbers of seeds, two pictures of one name.
    """

    verdict: tuple[str, ...] = ()
    requirements: tuple[Requirement, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    arms: Mapping[str, Mapping[str, Estimate]] = dataclasses.field(default_factory=dict)
    baselines: Mapping[str, Mapping[str, Estimate]] = dataclasses.field(default_factory=dict)
    comparisons: tuple[Comparison, ...] = ()
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    timing: Mapping[str, float] = dataclasses.field(default_factory=dict)
    curves: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    examples: tuple[RolloutExample, ...] = ()

    def __post_init__(self) -> None:
        for r in self.requirements:
            ok = math.isfinite(r.measured) and math.isfinite(r.bound)
            require(ok, f"requirement {r.name!r}", (r.measured, r.bound), "must be finite", "leave it out")
        names = [p.name for p in self.pictures]
        require(len(set(names)) == len(names), "pictures", names, "must have names of their own", "rename one")
        if self.arms or self.baselines or self.comparisons:
            self._check_arms()
        else:
            require(bool(self.verdict), "verdict", self.verdict, "must hold a sentence", "answer the question")

    def _check_arms(self) -> None:
        require(bool(self.arms), "arms", dict(self.arms), "must hold one arm at least", "add the arms")
        missing = [name for name in SETTINGS if name not in self.settings]
        require(not missing, "settings", dict(self.settings), f"must hold {', '.join(missing)}", "add them")
        both = sorted(set(self.arms) & set(self.baselines))
        require(not both, "baselines", both, "must not take the names of arms", "rename them")
        known = {**self.arms, **self.baselines}
        for name, row in known.items():
            _check_row(name, row)
        seeds = {arm: len(next(iter(row.values())).per_seed) for arm, row in self.arms.items()}
        require(len(set(seeds.values())) == 1, "arms", seeds, "must all have the same seeds", "run the missing ones")
        for i, c in enumerate(self.comparisons):
            field = f"comparisons[{i}]"
            _check_estimate(field, c.metric, c.difference, c.ci95)
            for side in (c.arm, c.against):
                require(side in known, field, side, f"must be one of {', '.join(known)}", "name an arm or baseline")
            for name, share in (("p_value", c.p_value), ("improvement", c.improvement)):
                ok = share is None or 0 <= share <= 1
                require(ok, f"{field}.{name}", share, "must lie in [0, 1]", "correct it")

    def to_json(self, description: Mapping[str, Any]) -> dict[str, Any]:
        """The content of `results.json`; `description` is that of the run's `config.json`."""
        arms = ("arms", "baselines", "comparisons") if self.arms else ()
        names = (*arms, "verdict", "tables", "settings", "timing", "data")
        git = description["git"]
        return {
            "experiment": description["experiment"],
            "scale": description["scale"],
            "git": git["commit"] + ("-dirty" if git["dirty"] else ""),
            "requirements": jsonable(
                [dataclasses.asdict(r) | {"met": r.met} for r in self.requirements], where="requirements"
            ),
            **{name: jsonable(getattr(self, name), where=name) for name in names},
            "config": description["config"],
        }


ReportPart = str | Requirement | Table | Picture  # a sentence of the verdict, or something to show


def assemble(parts: Iterable[ReportPart], settings: Mapping[str, Any], data: Mapping[str, Any] = {}) -> Results:
    """Results of parts; those of one kind keep their order."""
    every = tuple(parts)
    return Results(
        verdict=tuple(part for part in every if isinstance(part, str)),
        requirements=tuple(part for part in every if isinstance(part, Requirement)),
        tables=tuple(part for part in every if isinstance(part, Table)),
        pictures=tuple(part for part in every if isinstance(part, Picture)),
        settings=settings,
        data=data,
    )


def from_json(found: Mapping[str, Any]) -> Results:
    """The results in a `results.json`, without what it does not hold: pictures, curves, examples and former metrics."""
    table = lambda t: Table(
        title=t["title"],
        columns=tuple(Column(**column) for column in t["columns"]),
        rows=tuple(map(tuple, t["rows"])),
        note=t["note"],
    )
    interval = lambda one: {**one, "ci95": tuple(one["ci95"])}
    estimate = lambda one: Estimate(**interval(one) | {"per_seed": tuple(one["per_seed"])})
    rows = lambda part: {
        name: {metric: estimate(one) for metric, one in row.items() if metric in REPORTED}
        for name, row in found.get(part, {}).items()
    }
    return Results(
        verdict=tuple(found["verdict"]),
        requirements=tuple(
            Requirement(**{k: v for k, v in r.items() if k != "met"}) for r in found.get("requirements", ())
        ),
        tables=tuple(map(table, found["tables"])),
        settings=found["settings"],
        data=found["data"],
        timing=found["timing"],
        comparisons=tuple(Comparison(**interval(c)) for c in found.get("comparisons", ()) if c["metric"] in REPORTED),
        arms=rows("arms"),
        baselines=rows("baselines"),
    )


def _check_row(name: str, row: Mapping[str, Estimate]) -> None:
    require(bool(row), name, dict(row), "must hold one metric at least", "add the metrics")
    for metric, value in row.items():
        _check_estimate(f"{name}.{metric}", metric, value.mean, value.ci95)
        finite = all(math.isfinite(x) for x in value.per_seed)
        require(finite, f"{name}.{metric}.per_seed", value.per_seed, "must be finite", "leave the metric out")
    counts = {metric: len(value.per_seed) for metric, value in row.items()}
    ok = len(set(counts.values())) == 1 and min(counts.values()) > 0
    require(ok, f"{name}.per_seed", counts, "must have the same length, ≥ 1, for every metric", "add the missing seeds")


def _check_estimate(field: str, metric: str, mean: float, ci95: tuple[float, float]) -> None:
    known = ", ".join(REPORTED)
    require(metric in REPORTED, field, metric, f"must be one of {known}", "rename it or add it to METRICS")
    finite = all(math.isfinite(x) for x in (mean, *ci95))
    require(finite, field, (mean, ci95), "must be finite", "leave an undefined metric out")
    require(ci95[0] <= ci95[1], f"{field}.ci95", ci95, "must be (low, high)", "swap its ends")
