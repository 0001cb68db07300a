"""What was measured of the ways to find friction, compared at equal error, as tables and charts."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Point
from experiments.core.results import Cell, Column, Picture, Table
from experiments.mechanics import tangential_charts
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

COMPARED = ("slide", "twist", SEQUENCE)
"""Tasks that the plain solver can do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MethodErrors:
    """What was measured of one method: ms a contact or frame, and the error of each, relative [S]."""

    kind: str
    label: str
    ms: float
    errors: np.ndarray

    @property
    def median(self) -> float:
        """Of the errors."""
        return float(np.median(self.errors))

    @property
    def high(self) -> float:
        """The 95th percentile of the errors."""
        return float(np.quantile(self.errors, 0.95))


Rows = Mapping[str, MethodErrors]
"""Name of the method → what was measured, of one task."""


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
    """Every method of a task."""
    over = "contacts" if task != SEQUENCE else "frames, in units of the root mean square of their sequence"
    return Table(
        title=f"{TITLES[task]} at {grid}²",
        columns=(
            Column(name="method"),
            Column(name="time", unit="ms", format=".3f", meaning="a contact or frame, median over rounds"),
            *(Column(name=n, unit="%", format=".2f") for n in ("median error", "95th percentile", "worst")),
        ),
        rows=tuple((name, r.ms, 100 * r.median, 100 * r.high, 100 * float(r.errors.max())) for name, r in rows.items()),
        note=f"Errors of the marker displacement by traction, relative L₂ of {over}.",
    )


def equal_table(tasks: Mapping[str, Rows]) -> Table:
    """Both solvers at the same errors."""
    rows: list[tuple[Cell, ...]] = []
    for task in COMPARED:
        for goal in GOALS:
            ours, theirs = (time_at(tasks[task], kind, goal) for kind in (SOLVER, PLAIN))
            ratio = None if ours is None or theirs is None else ours / theirs
            rows.append((f"{task}, {100 * goal:g} %", ours, theirs, ratio))
    return Table(
        title="Times at equal median error",
        columns=(
            Column(name="task and error"),
            Column(name=SOLVER, unit="ms", format=".2f"),
            Column(name=PLAIN, unit="ms", format=".2f"),
            Column(name="ratio", format=".2f"),
        ),
        rows=tuple(rows),
        note="On the log–log line between two settings; a dash where no setting of a method brackets the error.",
    )


def speed_picture(tasks: Mapping[str, Rows]) -> Picture:
    """Speed against error, a panel a task."""
    panels: dict[str, dict[str, list[Point]]] = {}
    for task, rows in tasks.items():
        groups = panels.setdefault(TITLES[task], {})
        for row in rows.values():
            groups.setdefault(row.kind, []).append((row.label, row.ms, row.median, row.high))
    return Picture(
        name="pareto_tangential",
        title="Speed against error",
        caption="Error of the marker displacement by a float64 solution; bars reach from median to 95th percentile. "
        "Marks are tolerances of one solver, iterations of the plain one; errors below 0.001 % are drawn there.",
        content=tangential_charts.speed_panels(panels),
    )


def promise_picture(promises: Sequence[PromiseCheck]) -> Picture:
    """Promises against errors."""
    points: dict[str, list[tuple[float, float]]] = {}
    for p in promises:
        points.setdefault(p.kind, []).append((p.promised, p.error))
    return Picture(
        name="promise",
        title="What the superposition promises and what it keeps",
        caption="Each dot is a held-out contact under a force of .3 to .9 of the friction limit; below the line the "
        "promise is kept.",
        content=tangential_charts.promise_scatter(points),
    )
