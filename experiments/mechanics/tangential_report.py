"""Measurements of the friction methods: comparison at equal error, tables and charts."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.look import SHARED
from experiments.core.results import Cell, Picture, Table, named_table
from experiments.mechanics.tangential_checks import PromiseCheck
from sensors_io.scenes import tangential

SOLVER, PLAIN, SUPERPOSED = "SPG to tolerance", "plain SPG", "superposition"
"""Kinds of methods."""

MAIN = f"{SOLVER} {tangential.TOLERANCE:g}"
SEQUENCE = "sequence"
TITLES = {
    "force": "Prescribed force",
    "slide": "Prescribed slide",
    "twist": "Prescribed twist",
    SEQUENCE: "Frames of sequences",
}
"""Heading of every task."""

GOALS = (0.02, 0.01, 0.005, 0.002, 0.001)
"""Errors at which the solvers' times are compared."""

LEAST_ERROR = 1e-5
"""Errors below it are drawn there: float32 carries little more."""

TICKS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)

COMPARED = ("slide", "twist", SEQUENCE)
"""Tasks that the plain solver can do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MethodErrors:
    """Measurements of one method: ms per contact or frame, and the relative error of each [S]."""

    kind: str
    label: str
    ms: float
    errors: np.ndarray

    @property
    def median(self) -> float:
        """Median of the errors."""
        return float(np.median(self.errors))

    @property
    def high(self) -> float:
        """The 95th percentile of the errors."""
        return float(np.quantile(self.errors, 0.95))


Rows = Mapping[str, MethodErrors]
"""Name of the method → its measurements, of one task."""


def time_at(rows: Rows, kind: str, goal: float) -> float | None:
    """Time of a kind of method at a median error, ms: on the log–log line between its settings.

    `None` where its tightest setting errs by more, or its loosest by less.
    """
    ladder = sorted((row.median, row.ms) for row in rows.values() if row.kind == kind)
    error, ms = np.log(np.array(ladder).T)
    if not error[0] <= np.log(goal) <= error[-1]:
        return None
    return float(np.exp(np.interp(np.log(goal), error, ms)))


def at_equal_error(rows: Rows) -> tuple[float, str]:
    """Time of the solver at its default tolerance over the plain one's at the same median error, and a reservation.

    Where the plain solver is never as bad, or never as good, the time of its fewest or of its most iterations counts.
    """
    main = rows[MAIN]
    theirs = time_at(rows, PLAIN, main.median)
    if theirs is not None:
        return main.ms / theirs, ""
    ladder = [row for row in rows.values() if row.kind == PLAIN]
    if min(row.median for row in ladder) > main.median:
        return main.ms / max(row.ms for row in ladder), "at most: the plain solver's most iterations err by more"
    return main.ms / min(row.ms for row in ladder), "at least: the plain solver's fewest iterations err by less"


def task_table(task: str, rows: Rows, grid: int) -> Table:
    """Time and errors of every method of a task."""
    over = "contacts" if task != SEQUENCE else "frames, in units of the root mean square of their sequence"
    cells = [
        {
            "method": name,
            "time": row.ms,
            "median error": 100 * row.median,
            "95th percentile": 100 * row.high,
            "worst": 100 * float(row.errors.max()),
        }
        for name, row in rows.items()
    ]
    errors = ("median error", "95th percentile", "worst")
    return named_table(
        f"{TITLES[task]} at {grid}²",
        cells,
        formats={"time": ".3f", **dict.fromkeys(errors, ".2f")},
        units={"time": "ms", **dict.fromkeys(errors, "%")},
        meanings={"time": "a contact or frame, median over rounds"},
        note=f"Errors of the marker displacement that the traction causes, relative L₂ of {over}.",
    )


def equal_table(tasks: Mapping[str, Rows]) -> Table:
    """Times of both solvers at the same errors."""
    rows: list[dict[str, Cell]] = []
    for task, goal in ((task, goal) for task in COMPARED for goal in GOALS):
        ours, theirs = (time_at(tasks[task], kind, goal) for kind in (SOLVER, PLAIN))
        ratio = None if ours is None or theirs is None else ours / theirs
        rows.append({"task and error": f"{task}, {100 * goal:g} %", SOLVER: ours, PLAIN: theirs, "ratio": ratio})
    return named_table(
        "Times at equal median error",
        rows,
        formats=dict.fromkeys((SOLVER, PLAIN, "ratio"), ".2f"),
        units=dict.fromkeys((SOLVER, PLAIN), "ms"),
        note="Interpolated between two settings on log–log axes; a dash where the settings of a method do not bracket "
        "the error.",
    )


def speed_picture(tasks: Mapping[str, Rows]) -> Picture:
    """Speed against error, a panel per task."""
    panels = []
    for task, rows in tasks.items():
        kinds: dict[str, list[MethodErrors]] = {}
        for row in rows.values():
            kinds.setdefault(row.kind, []).append(row)
        series = [
            Series(
                kind,
                x=[row.ms for row in group],
                y=[max(row.median, LEAST_ERROR) for row in group],
                high=[max(row.high, LEAST_ERROR) for row in group],
                labels=[row.label for row in group],
            )
            for kind, group in kinds.items()
        ]
        panels.append(
            Panel(
                series,
                title=TITLES[task],
                x_label="time a frame, ms",
                y_label="relative error of the marker displacement",
                x_scale="log",
                y_scale="log",
            )
        )
    return Picture(
        name="pareto_tangential",
        title="Speed against error",
        caption="Error of the marker displacement, compared with a float64 solution; bars reach from the median to the "
        "95th percentile. Labels are tolerances of the solver and iterations of the plain one; errors below 0.001 % "
        "are drawn at 0.001 %.",
        content=draw(panels, columns=2, share_y=True, size=(8.6, 0.5 + 3.1 * ((len(panels) + 1) // 2))),
    )


def promise_picture(promises: Sequence[PromiseCheck]) -> Picture:
    """Actual against predicted error of the superposition."""
    every = np.array([(p.promised, p.error) for p in promises])
    ends = (0.7 * every.min(), 1.4 * every.max())
    ticks = {tick: f"{100 * tick:g} %" for tick in TICKS if ends[0] < tick < ends[1]}
    kinds: dict[str, list[PromiseCheck]] = {}
    for p in promises:
        kinds.setdefault(p.kind, []).append(p)
    series = [
        Series(kind, x=[p.promised for p in group], y=[p.error for p in group], line="", alpha=0.75, size=22)
        for kind, group in kinds.items()
    ]
    panel = Panel(
        [*series, Series(x=ends, y=ends, line=":", marker="", colour=SHARED, width=1)],
        x_label="promised error",
        y_label="error of the superposition",
        x_scale="log",
        y_scale="log",
        x_ticks=ticks,
        y_ticks=ticks,
    )
    return Picture(
        name="promise",
        title="What the superposition promises and what it keeps",
        caption="Each dot is a held-out contact under a force of .3 to .9 of the friction limit; below the line the "
        "error is within the promise.",
        content=draw([panel], size=(5.4, 4.0)),
    )
