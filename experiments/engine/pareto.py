"""Which of the defaults is dominated: is anything measured here both faster and more exact than what is used?

    make experiment EXP=pareto [ARGS="--others DIR"]

Gathers the charts of the newest finished run of every experiment that measures speed against error, and of those that
show where methods break, and holds each default against all that was measured beside it.  One that another method beats
on some axis and on none falls behind is dominated.  It measures nothing itself: run those experiments first.

Cost: a second.

Expected: no default is dominated but where another rule chose it, such as the smallest of what is fast enough.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.core.context import Context
from experiments.core.history import PastRun, runs_of, summary
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.encoder.variants import STUDIED
from experiments.engine.fronts import Axis, Point, dominators, front, points_of
from experiments.fields import dense_accuracy, marker_accuracy
from experiments.mechanics.tangential_tables import MAIN as FRICTION
from experiments.scenes.storage_codecs import OWN

GRPO_DEFAULT = "paper (default)"
"""How `pareto_grpo` marks the preset and group size that the studies use; the mark stands on one row."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class JudgedDefault:
    """A default, and where it was measured.

    Attributes:
      what: what it is the default of.
      experiment: whose runs hold the table.
      table: what the titles of the tables begin with; each of them judges.
      default: row of the default.
      axes: what it is judged by.
    """

    what: str
    experiment: str
    table: str
    default: str
    axes: tuple[Axis, ...]


TIME = Axis(column="time", better="lower")

DEFAULTS: tuple[JudgedDefault, ...] = (
    JudgedDefault(
        what="contact solver",
        experiment="pareto_contact",
        table="Tiers at",
        default="nested 1e-3",
        axes=(TIME, Axis(column="slope median", better="lower")),
    ),
    JudgedDefault(
        what="friction",
        experiment="pareto_tangential",
        table="",
        default=FRICTION,
        axes=(TIME, Axis(column="median error", better="lower")),
    ),
    JudgedDefault(
        what="markers",
        experiment="pareto_fields",
        table="Markers under known motion",
        default=marker_accuracy.MAIN,
        axes=(Axis(column="time", better="lower"), Axis(column="95 %", better="lower")),
    ),
    JudgedDefault(
        what="dense field",
        experiment="pareto_fields",
        table="Dense displacement",
        default=dense_accuracy.MAIN,
        axes=(TIME, Axis(column="95 %", better="lower")),
    ),
    JudgedDefault(
        what="storage",
        experiment="pareto_storage",
        table="Codecs:",
        default=OWN,
        axes=(Axis(column="of raw", better="lower"), Axis(column="read", better="higher")),
    ),
    JudgedDefault(
        what="encoder",
        experiment="pareto_encoder",
        table="Variants",
        default=STUDIED,
        axes=(Axis(column="a prompt", better="lower"), Axis(column="mean", better="higher")),
    ),
    JudgedDefault(
        what="GRPO",
        experiment="pareto_grpo",
        table="Cost and gain",
        default=GRPO_DEFAULT,
        axes=(Axis(column="a step", better="lower"), Axis(column="score", better="higher")),
    ),
)
"""Every default that a table of speed and error was measured for."""

ALSO = (
    "pareto_chooser",
    "speed_grpo",
    "scaling",
    "throughput_scenes",
    "stability_contact",
    "stability_fields",
    "stability_encoder",
    "stability_grpo",
    "stability_devices",
)
"""Experiments whose charts stand on the page without a default to judge."""

MEDIA = ("svg", "png")


@dataclasses.dataclass(frozen=True, kw_only=True)
class GatherConfig:
    """Where the other experiments' runs are."""

    others: Path | None = None
    """Folder of the runs; by default the one that this run lies in."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DefaultJudgement:
    """A default on one table: the points that were measured and those that beat it, `None` where it is not there."""

    judged: JudgedDefault
    title: str
    run: PastRun
    points: tuple[Point, ...]
    beaten_by: tuple[Point, ...] | None


def run(config: GatherConfig, context: Context) -> Results:
    """Find the runs, judge the defaults, show the charts."""
    home = context.directory.parent.parent if config.others is None else config.others
    names = dict.fromkeys([*(judged.experiment for judged in DEFAULTS), *ALSO])
    found = {name: newest(home / name) for name in names}
    ran = {name: past for name, past in found.items() if past is not None}
    judgements = [j for judged in DEFAULTS if judged.experiment in ran for j in judge(judged, ran[judged.experiment])]
    missing = [name for name in names if name not in ran]
    beaten = [j for j in judgements if j.beaten_by]
    return Results(
        verdict=verdict(judgements, missing),
        requirements=(Requirement(name="defaults that are dominated", measured=len(beaten), bound=0, better="lower"),)
        if judgements
        else (),
        tables=(default_table(judgements), run_table(ran)),
        pictures=tuple(p for name, past in ran.items() for p in charts(name, past)),
        settings={"runs": str(home), "not run yet": ", ".join(missing) or "none"},
    )


def newest(home: Path) -> PastRun | None:
    """The newest finished run of an experiment; one at another scale than `smoke` goes before all that are."""
    finished = [past for past in runs_of(home) if past.results is not None]
    return min(finished, key=lambda past: past.description["scale"] == "smoke", default=None)


def judge(judged: JudgedDefault, past: PastRun) -> list[DefaultJudgement]:
    """A default on every table of a run that begins as it says and has its row."""
    tables = [] if past.results is None else past.results["tables"]
    judgements = []
    for table in tables:
        rows = {str(row[0]) for row in table["rows"]}
        default = next((row for row in rows if row.startswith(judged.default)), None)
        if table["title"].startswith(judged.table) and default is not None:
            points = points_of(table, judged.axes)
            beaten_by = dominators(default, points)
            judgements.append(
                DefaultJudgement(judged=judged, title=table["title"], run=past, points=points, beaten_by=beaten_by)
            )
    return judgements


def verdict(judgements: Sequence[DefaultJudgement], missing: Sequence[str]) -> tuple[str, ...]:
    """Which defaults are dominated, by what, and what has not run."""
    said = []
    for j in judgements:
        if j.beaten_by:
            names = ", ".join(p.name for p in j.beaten_by)
            said.append(f"The default of {j.judged.what}, {j.judged.default}, is dominated in '{j.title}' by {names}.")
    if judgements and not said:
        said.append(f"None of {len(judgements)} judgements finds a default dominated.")
    if missing:
        said.append(f"Not run yet, so not judged: {', '.join(missing)}.")
    return tuple(said)


def default_table(judgements: Sequence[DefaultJudgement]) -> Table:
    """Every default on every table that judges it."""
    rows: list[tuple[Cell, ...]] = [
        (
            j.judged.what,
            j.judged.default,
            j.title,
            ", ".join(f"{axis.column} ({axis.better})" for axis in j.judged.axes),
            len(j.points),
            len(front(j.points)),
            "not measured" if j.beaten_by is None else ", ".join(p.name for p in j.beaten_by) or "nothing",
        )
        for j in judgements
    ]
    return Table(
        title="Defaults",
        columns=(
            Column(name="default of"),
            Column(name="what is used"),
            Column(name="table"),
            Column(name="judged by"),
            Column(name="measured", format="d", meaning="rows that have a number on every axis"),
            Column(name="on the front", format="d", meaning="rows that no other one beats"),
            Column(name="dominated by"),
        ),
        rows=tuple(rows),
    )


def run_table(ran: Mapping[str, PastRun]) -> Table:
    """Which runs the page is made of."""
    return Table(
        title="Runs",
        columns=(Column(name="experiment"), Column(name="run")),
        rows=tuple((name, summary(past)) for name, past in ran.items()),
    )


def charts(name: str, past: PastRun) -> list[Picture]:
    """All pictures of a run, as they lie in its folder."""
    files = sorted(path for kind in MEDIA for path in (past.directory / "plots").glob(f"*.{kind}"))
    return [
        Picture(
            name=f"{name}-{path.stem}",
            title=f"{name}: {path.stem.replace('_', ' ')}",
            caption=f"From {past.directory.name}, {past.description['scale']} scale, code {past.code}.",
            content=path.read_bytes(),
            kind="svg" if path.suffix == ".svg" else "png",
        )
        for path in files
    ]


EXPERIMENT = Experiment(name="pareto", config=GatherConfig(), scales={"smoke": GatherConfig()}, run=run)
