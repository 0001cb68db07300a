"""How fast and how accurate is each friction method?

    python -m experiments pareto_tangential [--scale smoke] [--data-dir DIR]

Spheres, rough and patterned bodies on gels to which nothing was fitted are pulled, slid, twisted, and dragged over
sequences of 90 frames.  Measures time per frame and error of the marker displacement against a float64 solution that
its duality gap proves, for the superposition of Ciavarella and Jäger, the package's solver, and a plain one: the same
projected gradients with a cold start and a fixed number of iterations.  Also measures the superposition's promised
error, closed forms, and effect and cost of coupling friction to the sideways motion of the gel under pressure.  With
DIR, a folder of the vendor's Tac3D recordings, shows whether loops of real presses are a loss of the gel.

Cost: under six minutes on two cores (`smoke` under one).

Expected: at equal error the solver takes less time than the plain one, in sequences a fraction of it; the superposition
errs by a few per cent, as it promises, but handles neither twist nor reversal.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.look import SHARED
from experiments.core.results import Cell, Picture, Requirement, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.timing import interleaved
from experiments.mechanics import tangential_checks as checks
from experiments.mechanics import tangential_methods as methods
from experiments.mechanics import tangential_scenes as scenes
from experiments.mechanics.tangential_checks import PromiseCheck
from experiments.mechanics.tangential_methods import FROM_PRESS, MAIN, METHODS, PLAIN, SEQUENCE, SOLVER, SUPERPOSED
from experiments.mechanics.tangential_scenes import FrictionContact, FrictionKernels, FrictionSequence
from sensors_io.scenes import partial_slip
from sensors_io.scenes.sensors import BODY, SensorModel
from sensors_io.schema import EXPLORATORY, SENSORS
from touchr1_jax.validation import some_of

TITLES = {
    "force": "Prescribed force",
    "slide": "Prescribed slide",
    "twist": "Prescribed twist",
    SEQUENCE: "Frames of sequences",
}
"""Heading of every task."""

COMPARED = ("slide", "twist", SEQUENCE)
"""Tasks that the plain solver can do."""

GOALS = (0.02, 0.01, 0.005, 0.002, 0.001)
"""Errors at which the solvers' times are compared."""

LEAST_ERROR = 1e-5
"""Errors below it are drawn there: float32 carries little more."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TangentialConfig:
    """Contacts, methods' settings and grids of the study.

    Args:
      contacts: number per kind of body on every gel.
      sensors: names of those whose gels are used.
      grid: side of the contact grid.
      frames: number per sequence.
      motions: of the protocol, one sequence of each on every gel.
      rounds: of timing.
      coupled_bodies: objects over which coupling is measured, on every gel with markers.
      closed_grid: side of the grid that is compared with closed forms.
      data_dir: Tac3D recordings; `None` leaves the loops of real presses out.
      seed: of the contacts.
    """

    contacts: int = 6
    sensors: tuple[str, ...] = SENSORS
    grid: int = 64
    frames: int = 90
    motions: tuple[str, ...] = ("slide_x", "twist")
    rounds: int = 5
    coupled_bodies: int = 3
    closed_grid: int = 64
    data_dir: Path | None = None
    seed: int = 11

    def __post_init__(self) -> None:
        some_of(self, "sensors", SENSORS)
        some_of(self, "motions", ("press", *EXPLORATORY))


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelContacts:
    """One sensor's gel, the contacts on it with their kinds, its sequences."""

    sensor: SensorModel
    kernels: FrictionKernels
    cases: FrictionContact
    kinds: tuple[str, ...]
    sequences: tuple[FrictionSequence, ...]


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


def run(config: TangentialConfig, context: Context) -> Results:
    """Draw, solve exactly, measure, compare, chart."""
    loops = () if config.data_dir is None else (checks.loop_table(config.data_dir),)
    models = scenes.sensors(config.sensors)
    with context.timed("contacts"):
        gels = make_gels(config, context)
    with context.timed("methods"):
        tasks = {
            task: measure(task, gels, config.rounds, context) for task in context.each("solving", METHODS, still=True)
        }
    with context.timed("closed-forms"):
        closed = checks.closed_forms(config.closed_grid, context)
    with context.timed("coupling"):
        marked = [s for s in models if s.marker_depth_mm is not None]
        measured = [
            checks.coupling_rows(sensor, config.grid, config.frames, config.coupled_bodies, config.seed)
            for sensor in context.each("coupling", marked, still=True)
        ]
        coupled = [row for rows in measured for row in rows]
    promises, read = check_promises(gels, tasks["force"][SUPERPOSED]), tasks["force"][FROM_PRESS]
    ratios = [f"{at_equal_error(tasks[t])[0]:.2f} of the plain one's time in a {t}" for t in COMPARED]
    return Results(
        verdict=(
            f"At equal error the solver takes {', '.join(ratios)}.",
            f"After a press the superposition takes {read.ms:.3f} ms and errs by {read.median:.1%}; its error is "
            f"within its promise on {np.mean([p.kept for p in promises]):.0%} of {len(promises)} held-out contacts.",
        ),
        requirements=_requirements(tasks, promises, closed),
        tables=(
            *(_task_table(task, rows, config.grid) for task, rows in tasks.items()),
            _equal_table(tasks),
            checks.promise_table(promises),
            checks.decision_table(promises),
            checks.coupling_table(coupled),
            checks.closed_form_table(closed, config.closed_grid),
            *loops,
        ),
        pictures=(_speed_picture(tasks), _promise_picture(promises)),
        settings={
            "grid": f"{config.grid}², padded to {gels[0].kernels.normal_gel.shape[0]}²",
            "contacts": sum(len(gel.kinds) for gel in gels),
            "sequences": f"{sum(len(gel.sequences) for gel in gels)} of {config.frames} frames",
            "rounds": config.rounds,
        },
    )


def make_gels(config: TangentialConfig, context: Context) -> tuple[GelContacts, ...]:
    """Every gel with its contacts and sequences; the objects of the sequences go through the kinds of bodies."""
    gels = []
    for order, sensor in enumerate(context.each("pressing", scenes.sensors(config.sensors))):
        kernels = scenes.friction_kernels(sensor, config.grid)
        cases, kinds = scenes.sample(kernels, config.contacts, config.seed, order)
        rng = np.random.default_rng([config.seed, order, 1])
        bodies = [scenes.draw(rng, scenes.KINDS[(order + i) % len(scenes.KINDS)]) for i in range(len(config.motions))]
        sequences = tuple(
            scenes.make_motion(kernels, body, name, config.frames)
            for body, name in zip(bodies, config.motions, strict=True)
        )
        gels.append(GelContacts(sensor=sensor, kernels=kernels, cases=cases, kinds=kinds, sequences=sequences))
    return tuple(gels)


def measure(task: str, gels: Sequence[GelContacts], rounds: int, context: Context) -> dict[str, MethodErrors]:
    """Time and errors of every method of a task, by name.

    The error is the relative L₂ error of the marker displacement of every contact, or of every frame of a sequence, in
    units of the sequence's root mean square.
    """
    work = [(given, gel.kernels) for gel in gels for given in (gel.sequences if task == SEQUENCE else (gel.cases,))]
    true = [methods.exact(task, *each) for each in work]
    solve = lambda method: [methods.tractions(method, *each) for each in work]
    calls = {name: functools.partial(solve, method) for name, method in METHODS[task].items()}
    shown = context.each(f"{task}: methods", calls.items())
    moved = lambda t, kernels: np.asarray(methods.marker_motion(jnp.asarray(t, jnp.complex64), kernels))
    exact = [moved(t, kernels) for t, (_, kernels) in zip(true, work, strict=True)]
    errors = {}
    for name, call in shown:
        found = [moved(t, kernels) for t, (_, kernels) in zip(call(), work, strict=True)]
        pairs = zip(found, exact, strict=True)
        errors[name] = np.concatenate([_errors(ours, seen, task == SEQUENCE) for ours, seen in pairs])
    seconds = interleaved(calls, context.rounds(f"{task}: timing", rounds))
    ms = {name: 1e3 * float(np.median(s)) / sum(map(len, true)) for name, s in seconds.items()}
    return {
        name: MethodErrors(kind=method.kind, label=method.label, ms=ms[name], errors=errors[name])
        for name, method in METHODS[task].items()
    }


def _errors(found: np.ndarray, true: np.ndarray, of_sequence: bool) -> np.ndarray:
    size = np.linalg.norm(true, axis=(1, 2))
    moved = size > 0
    scale = np.sqrt(np.mean(size[moved] ** 2)) if of_sequence else size[moved]
    return np.asarray(np.linalg.norm(found - true, axis=(1, 2))[moved] / scale)


def check_promises(gels: Sequence[GelContacts], superposed: MethodErrors) -> list[PromiseCheck]:
    """The superposition's error and promise on every contact."""
    errors = iter(superposed.errors.tolist())
    found = []
    for gel in gels:
        pressures, moduli = np.asarray(gel.cases.ramp_mpa[:, -1]), np.asarray(gel.cases.modulus_mpa)
        for kind, pressure, modulus in zip(gel.kinds, pressures, moduli, strict=True):
            radius = scenes.contact_radius_mm(pressure, float(gel.kernels.spacing_mm))
            body = dataclasses.replace(BODY, modulus_mpa=float(modulus))
            promised = partial_slip.promised_error(gel.sensor.gel, body, radius)
            found.append(PromiseCheck(kind=kind, sensor=gel.sensor.name, error=next(errors), promised=promised))
    return found


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


# Report --------------------------------------------------------------------------------------------------------------


def _requirements(
    tasks: Mapping[str, Rows], promises: Sequence[PromiseCheck], closed: Mapping[str, float]
) -> tuple[Requirement, ...]:
    kept, count = float(np.mean([p.kept for p in promises])), len(promises)
    least = 0.95 - 2 * float(np.sqrt(0.95 * 0.05 / count))
    note = f"it promises 95 %; two standard errors of {count} contacts are granted"
    equal = {task: at_equal_error(tasks[task]) for task in COMPARED}
    return (
        *(
            at_most(f"{t}: time against {PLAIN} at equal error", r, 1, note=reserved)
            for t, (r, reserved) in equal.items()
        ),
        at_most(f"{MAIN}: error, 95th percentile of any task", max(rows[MAIN].high for rows in tasks.values()), 0.02),
        at_least("contacts within the promise of the superposition", kept, least, note=note),
        at_most("Cattaneo–Mindlin, slide off by", closed["Cattaneo–Mindlin: slide"], 0.01),
        at_most("Cattaneo–Mindlin, force off by", closed["Cattaneo–Mindlin: force"], 0.01),
        at_most("Lubkin, torque off by", closed["Lubkin: torque"], 0.02),
    )


def _task_table(task: str, rows: Rows, grid: int) -> Table:
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


def _equal_table(tasks: Mapping[str, Rows]) -> Table:
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


def _speed_picture(tasks: Mapping[str, Rows]) -> Picture:
    panels, x_label, y_label = [], "time a frame, ms", "error of the marker displacement"
    for task, rows in tasks.items():
        series = []
        for kind in dict.fromkeys(row.kind for row in rows.values()):
            group = [row for row in rows.values() if row.kind == kind]
            y, high = ([max(r.median, LEAST_ERROR) for r in group], [max(r.high, LEAST_ERROR) for r in group])
            series.append(Series(kind, x=[r.ms for r in group], y=y, high=high, labels=[r.label for r in group]))
        axes: dict[str, Any] = {"x_label": x_label, "y_label": y_label, "x_scale": "log", "y_scale": "log"}
        panels.append(Panel(series, title=TITLES[task], **axes, better=("lower", "lower")))
    return Picture(
        name="pareto_tangential",
        title="Speed against error",
        caption="Error of the marker displacement, compared with a float64 solution; bars reach from the median to the "
        "95th percentile. Labels are tolerances of the solver and iterations of the plain one; errors below 0.001 % "
        "are drawn at 0.001 %.",
        content=draw(panels, columns=2, share_y=True, size=(8.6, 0.5 + 3.1 * ((len(panels) + 1) // 2))),
    )


def _promise_picture(promises: Sequence[PromiseCheck]) -> Picture:
    every = np.array([(p.promised, p.error) for p in promises])
    ends = (0.7 * every.min(), 1.4 * every.max())
    ticks = {t: f"{100 * t:g} %" for t in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5) if ends[0] < t < ends[1]}
    kind = np.array([p.kind for p in promises])
    dots = [
        Series(name, x=every[kind == name, 0], y=every[kind == name, 1], line="", alpha=0.75, size=22)
        for name in dict.fromkeys(kind.tolist())
    ]
    panel = Panel(
        [*dots, Series(x=ends, y=ends, line=":", marker="", colour=SHARED, width=1)],
        x_label="promised error",
        y_label="error of the superposition",
        x_scale="log",
        y_scale="log",
        x_ticks=ticks,
        y_ticks=ticks,
    )
    return Picture(
        name="promise",
        title="Promised and actual error of the superposition",
        caption="Each dot is a held-out contact under a force of .3 to .9 of the friction limit; below the line the "
        "error is within the promise.",
        content=draw([panel], size=(5.4, 4.0)),
    )


SMOKE = TangentialConfig(
    contacts=2,
    sensors=("xense", "dmtac_x"),
    grid=32,
    frames=32,
    motions=("slide_x",),
    rounds=3,
    closed_grid=48,
    coupled_bodies=1,
)

EXPERIMENT = Experiment(name="pareto_tangential", config=TangentialConfig(), scales={"smoke": SMOKE}, run=run)
