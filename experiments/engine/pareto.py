"""Is any default dominated by another method, which is better on one axis and worse on none?

    make experiment EXP=pareto [ARGS="--others DIR"]

The experiment reads the newest finished run of every experiment that measures speed and error, compares each default
with the other rows of its table, and shows the charts of these runs and of the experiments that measure the limits of
methods.  If an experiment has not run here beyond `smoke`, its recorded result is used, without charts.  `pareto`
measures nothing itself: run the other experiments first.

Cost: a second.

Expected: no default is dominated, unless another rule chose it, such as the smallest method that is fast enough.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from experiments.core.charts import dominated
from experiments.core.context import Context
from experiments.core.errors import require
from experiments.core.recorded import RECORDED_RUN, recorded_names, recorded_run
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.runs import ROOT, PastRun, read_run, started
from experiments.core.text import SMOKE
from experiments.encoder.variants import STUDIED
from experiments.fields.tracking_accuracy import DENSE_DEFAULT, MARKER_DEFAULT
from experiments.mechanics.tangential_methods import MAIN as FRICTION
from experiments.scenes.storage_codecs import OWN

Axes = Mapping[str, Literal["lower", "higher"]]  # beginning of a column's name → which of its figures are better


class JudgedDefault(NamedTuple):
    """The default of `what` and the tables of an experiment, by the beginning of their titles, that measure it.

    `default` begins its row; `axes` are the figures that are compared.
    """

    what: str
    experiment: str
    table: str
    default: str
    axes: Axes


DEFAULTS = (
    JudgedDefault("contact solver", "pareto_contact", "Tiers at", "nested 1e-3",
                  {"time": "lower", "slope median": "lower"}),
    JudgedDefault("friction", "pareto_tangential", "", FRICTION, {"time": "lower", "median error": "lower"}),
    JudgedDefault("markers", "pareto_fields", "Markers under known motion", MARKER_DEFAULT,
                  {"time": "lower", "95 %": "lower"}),
    JudgedDefault("dense field", "pareto_fields", "Dense displacement", DENSE_DEFAULT,
                  {"time": "lower", "95 %": "lower"}),
    JudgedDefault("storage", "pareto_storage", "Codecs:", OWN, {"of raw": "lower", "read": "higher"}),
    JudgedDefault("encoder", "pareto_encoder", "Variants", STUDIED, {"a prompt": "lower", "mean": "higher"}),
    JudgedDefault("GRPO", "pareto_grpo", "Cost and gain", "paper (default)", {"a step": "lower", "score": "higher"}),
)  # fmt: skip

CHARTS_ONLY = (
    "pareto_chooser", "pareto_sft", "speed_grpo", "scaling", "stability_contact",
    "stability_fields", "stability_encoder", "stability_grpo", "stability_devices",
)  # fmt: skip
"""Experiments whose charts are shown without a default to judge."""

RUN_MEANING = {"run": f"when it began here; '{RECORDED_RUN}' where the repository's recorded result stands for it"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class GatherConfig:
    """Folder of the other experiments' runs; by default the one that holds this run."""

    others: Path | None = None


class ParetoPoint(NamedTuple):
    """A method and its figures on each axis, signed so that lower is better."""

    name: str
    at: tuple[float, ...]


class DefaultJudgement(NamedTuple):
    """A default on one table of a run: all measured points, and those that dominate it (`None`: not measured)."""

    judged: JudgedDefault
    run: str
    title: str
    points: tuple[ParetoPoint, ...]
    dominated_by: tuple[ParetoPoint, ...] | None


def run(config: GatherConfig, context: Context) -> Results:
    """Find the runs, judge the defaults, show the charts."""
    home = context.directory.parent.parent if config.others is None else config.others
    names = dict.fromkeys([*(judged.experiment for judged in DEFAULTS), *CHARTS_ONLY])
    newest = {name: newest_run(home / name) for name in names}
    runs = {name: past for name, past in newest.items() if past is not None}
    missing = [name for name in names if name not in runs]
    recorded = [name for name, past in runs.items() if past.directory.name == RECORDED_RUN]
    judgements = [j for judged in DEFAULTS if judged.experiment in runs for j in judge(judged, runs[judged.experiment])]
    requirement = at_most("defaults that are dominated", sum(bool(j.dominated_by) for j in judgements), 0)
    return Results(
        verdict=verdict(judgements, recorded, missing),
        requirements=(requirement,) if judgements else (),
        tables=(
            default_table(judgements),
            choice_table(judgements),
            named_table(
                "Runs",
                [{"experiment": name, "run": past.summary} for name, past in runs.items()],
                meanings=RUN_MEANING,
            ),
        ),
        pictures=tuple(picture for name, past in runs.items() for picture in charts(name, past)),
        settings={
            "runs": str(home),
            "recorded": ", ".join(recorded) or "none",
            "neither run nor recorded": ", ".join(missing) or "none",
        },
    )


def newest_run(home: Path, root: Path = ROOT) -> PastRun | None:
    """The newest finished run of an experiment, else what a checkout has recorded, else a `smoke` run."""
    found = [past for past in map(read_run, started(home)) if past.results is not None]
    found += [recorded_run(home.name, home.parent, root)] if home.name in recorded_names(root) else []
    return min(found, key=lambda past: past.description["scale"] == SMOKE, default=None)


def judge(judged: JudgedDefault, past: PastRun) -> list[DefaultJudgement]:
    """Compare a default with the other rows on every matching table of a run."""
    judgements = []
    for table in [] if past.results is None else past.results["tables"]:
        default = next((name for name in row_names(table) if name.startswith(judged.default)), None)
        if table["title"].startswith(judged.table) and default is not None:
            points = points_of(table, judged.axes)
            by = dominators(default, points)
            judgements.append(DefaultJudgement(judged, past.directory.name, table["title"], points, by))
    return judgements


def points_of(table: Mapping[str, Any], axes: Axes) -> tuple[ParetoPoint, ...]:
    """The rows of a table of `results.json` that have a number on every axis, the first column that begins as given.

    Raises:
      ResultsError: the table has no column for an axis.
    """
    names = [column["name"] for column in table["columns"]]
    signs: dict[int, float] = {}
    for axis, better in axes.items():
        found = [i for i, name in enumerate(names) if name.startswith(axis)]
        require(bool(found), f"axis of table {table['title']!r}", axis, f"must begin one of {names}", "rename it")
        signs[found[0]] = 1.0 if better == "lower" else -1.0
    return tuple(
        ParetoPoint(name, tuple(sign * float(row[i]) for i, sign in signs.items()))
        for name, row in zip(row_names(table), table["rows"], strict=True)
        if all(isinstance(row[i], int | float) and not isinstance(row[i], bool) for i in signs)
    )


def row_names(table: Mapping[str, Any]) -> list[str]:
    """The name of each row: its first cell, and the second where several rows begin alike."""
    first = [row[0] for row in table["rows"]]
    return [f"{row[0]} {row[1]}" if first.count(row[0]) > 1 else str(row[0]) for row in table["rows"]]


def front(points: Sequence[ParetoPoint]) -> tuple[ParetoPoint, ...]:
    """The points that no other point dominates, in their order."""
    beaten = dominated([p.at for p in points])
    return tuple(p for p, is_beaten in zip(points, beaten, strict=True) if not is_beaten)


def dominators(name: str, points: Sequence[ParetoPoint]) -> tuple[ParetoPoint, ...] | None:
    """The points that dominate the named one, those of the front first; `None` where it was not measured."""
    named = next((p for p in points if p.name == name), None)
    if named is None:
        return None
    best = front(points)
    by = (p for p in points if dominated([named.at, p.at])[0])
    return tuple(sorted(by, key=lambda p: p not in best))


def choice_table(judgements: Sequence[DefaultJudgement]) -> Table:
    """Every measured choice and the defaults, and the first one of the front that dominates it."""
    rows = []
    for j in judgements:
        for point in j.points:
            by = dominators(point.name, j.points) or ()
            found = by[0].name if by else "–"
            rows.append({"choice": point.name, "measured in": j.title, "dominated by": found, "run": j.run})
    meanings = RUN_MEANING | {"dominated by": "no worse on any axis of that table, better on one"}
    return named_table("Choices", rows, meanings=meanings)


def verdict(judgements: Sequence[DefaultJudgement], recorded: Sequence[str], missing: Sequence[str]) -> tuple[str, ...]:
    """Name the dominated defaults, the methods that dominate them, and the experiments that have not run here."""
    beaten = [
        f"The default of {j.judged.what}, {j.judged.default}, is dominated in '{j.title}' by {_names(j.dominated_by)}."
        for j in judgements
        if j.dominated_by
    ]
    none = [f"None of {len(judgements)} judgements finds a default dominated."] if judgements else []
    elsewhere = [f"Not run here, so by the recorded result: {', '.join(recorded)}."] if recorded else []
    unmeasured = [f"Neither run here nor recorded, so left out: {', '.join(missing)}."] if missing else []
    return (*(beaten or none), *elsewhere, *unmeasured)


def _names(points: Sequence[ParetoPoint]) -> str:
    return ", ".join(p.name for p in points)


def default_table(judgements: Sequence[DefaultJudgement]) -> Table:
    """Every default on every table that judges it."""
    return named_table(
        "Defaults",
        [
            {
                "default of": j.judged.what,
                "what is used": j.judged.default,
                "table": j.title,
                "judged by": ", ".join(f"{column} ({better})" for column, better in j.judged.axes.items()),
                "measured": len(j.points),
                "on the front": len(front(j.points)),
                "dominated by": "not measured" if j.dominated_by is None else _names(j.dominated_by) or "nothing",
                "run": j.run,
            }
            for j in judgements
        ],
        meanings=RUN_MEANING | {"measured": "rows that have a number on every axis"},
    )


def charts(name: str, past: PastRun) -> list[Picture]:
    """All charts in a run's folder."""
    kinds: tuple[Literal["svg", "png"], ...] = ("svg", "png")
    files = [(path, kind) for kind in kinds for path in sorted((past.directory / "plots").glob(f"*.{kind}"))]
    return [
        Picture(
            name=f"{name}-{path.stem}",
            title=f"{name}: {path.stem.replace('_', ' ')}",
            caption=f"From {past.directory.name}, {past.description['scale']} scale, code {past.code}.",
            content=path.read_bytes(),
            kind=kind,
        )
        for path, kind in sorted(files)
    ]


EXPERIMENT = Experiment(name="pareto", config=GatherConfig(), scales={"smoke": GatherConfig()}, run=run)
