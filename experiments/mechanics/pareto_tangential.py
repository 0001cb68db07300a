"""What does friction cost, and how wrong is it?

    python -m experiments pareto_tangential [--scale smoke] [--data-dir DIR]

Held-out contacts of spheres, rough and patterned bodies on the gels of the four sensors: pulled by a force below the
friction limit, slid and twisted from rest, and dragged over sequences of 90 frames.  Time per frame against the error
of the marker displacement, compared with a float64 solution on the same grid whose duality gap proves it: the
superposition of Ciavarella and Jäger, the package's solver at several tolerances, and a plain solver, the same
projected gradients with a cold start and a fixed number of iterations.  Compares the two solvers at equal error, the
superposition's promised error with its error on contacts that it was not fitted to, and the solver with closed forms.
Measures the effect and the cost of coupling friction to the sideways motion of the gel under pressure.  With DIR, a
folder of the vendor's Tac3D recordings, also shows whether the loops of real presses are a loss of the gel or a lag of
the force.

Cost: under six minutes on two cores (`smoke` under one).

Expected: at equal error the solver takes less time than the plain one, in sequences a fraction of it, since it begins
where the frame before ended and stops when it is done; the superposition costs next to nothing after a press and errs
by a few per cent, as it promises, but handles neither twist nor reversal.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Requirement, Results
from experiments.core.runner import Experiment
from experiments.core.timing import interleaved
from experiments.mechanics import (
    tangential_checks,
    tangential_coupling,
    tangential_methods,
    tangential_report,
    tangential_scenes,
)
from experiments.mechanics.tangential_checks import PromiseCheck
from experiments.mechanics.tangential_methods import FrictionMethod
from experiments.mechanics.tangential_report import (
    COMPARED,
    MAIN,
    PLAIN,
    SEQUENCE,
    SOLVER,
    SUPERPOSED,
    MethodErrors,
    Rows,
)
from experiments.mechanics.tangential_scenes import FrictionContact, FrictionKernels, FrictionSequence
from sensors_io.scenes import tangential
from sensors_io.schema import SENSORS

FROM_PRESS = f"{SUPERPOSED} from the press"

_TOLERANCES = (2e-2, 5e-3, tangential.TOLERANCE, 1e-3, 3e-4)
_ITERATIONS = (5, 10, 20, 40, 80)
_PRESSURE_TOLERANCE = 1e-3  # of the superposition's second contact, the generator's

_Solve = Callable[[Any, FrictionKernels, jax.Array], Any]


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelContacts:
    """One sensor's gel, the contacts on it with their kinds, its sequences."""

    name: str
    kernels: FrictionKernels
    cases: FrictionContact
    kinds: tuple[str, ...]
    sequences: tuple[FrictionSequence, ...]


def methods() -> dict[str, tuple[FrictionMethod, ...]]:
    """Methods by task, cheapest first within each kind."""
    return {
        "force": (
            FrictionMethod(kind="scaled pressure", solve=tangential_methods.scaled_pull),
            FrictionMethod(kind=FROM_PRESS, solve=tangential_methods.ramp_pull),
            FrictionMethod(kind=SUPERPOSED, solve=tangential_methods.superposed_pull, setting=_PRESSURE_TOLERANCE),
            *_to_tolerance(tangential_methods.spg_pull),
        ),
        "slide": (
            FrictionMethod(kind="full slip", solve=tangential_methods.full_slip),
            FrictionMethod(kind=FROM_PRESS, solve=tangential_methods.ramp_slide),
            *_to_tolerance(tangential_methods.spg_slide),
            *_plain(tangential_methods.plain_slide),
        ),
        "twist": (
            FrictionMethod(kind="full slip", solve=tangential_methods.full_twist),
            *_to_tolerance(tangential_methods.spg_twist),
            *_plain(tangential_methods.plain_twist),
        ),
        SEQUENCE: (
            FrictionMethod(kind="full slip", solve=tangential_methods.full_slip_frames),
            *_to_tolerance(tangential_methods.spg_frames),
            *_plain(tangential_methods.plain_frames),
        ),
    }


def run(config: TangentialConfig, context: Context) -> Results:
    """Draw, solve exactly, measure, compare, chart."""
    loops = () if config.data_dir is None else (tangential_checks.loop_table(config.data_dir),)
    with context.timed("contacts"):
        gels = make_gels(config, context)
    with context.timed("methods"):
        tasks = measure(gels, config, context)
    with context.timed("closed-forms"):
        mindlin = tangential_checks.cattaneo_mindlin(config.closed_grid, context)
        torque = tangential_checks.lubkin(config.closed_grid, context)
    with context.timed("coupling"):
        coupled = couple(config, context)
    promises = check_promises(gels, tasks["force"][SUPERPOSED])
    return Results(
        verdict=(*verdict(tasks, promises), tangential_coupling.verdict(coupled)),
        requirements=requirements(tasks, promises, mindlin, torque),
        tables=(
            *(tangential_report.task_table(task, rows, config.grid) for task, rows in tasks.items()),
            tangential_report.equal_table(tasks),
            tangential_checks.promise_table(promises),
            tangential_checks.decision_table(promises),
            tangential_coupling.effect_table(coupled),
            tangential_checks.closed_form_table(mindlin, torque, config.closed_grid),
            *loops,
        ),
        pictures=(tangential_report.speed_picture(tasks), tangential_report.promise_picture(promises)),
        settings={
            "grid": f"{config.grid}², padded to {gels[0].kernels.normal_gel.shape[0]}²",
            "contacts": sum(len(gel.kinds) for gel in gels),
            "sequences": f"{sum(len(gel.sequences) for gel in gels)} of {config.frames} frames",
            "rounds": config.rounds,
        },
    )


def make_gels(config: TangentialConfig, context: Context) -> tuple[GelContacts, ...]:
    """Every gel with its contacts and sequences; the objects of the sequences go through the kinds of bodies."""
    models = tangential_scenes.sensors(config.sensors)
    bodies = tangential_scenes.KINDS
    gels = []
    with context.progress("pressing", len(models)) as advance:
        for order, sensor in enumerate(models):
            kernels = tangential_scenes.friction_kernels(sensor, config.grid)
            cases, kinds = tangential_scenes.sample(kernels, config.contacts, config.seed, order)
            rng = np.random.default_rng([config.seed, order, 1])
            drawn = [tangential_scenes.draw(rng, bodies[(order + i) % len(bodies)]) for i in range(len(config.motions))]
            sequences = tuple(
                tangential_scenes.make_motion(kernels, body, name, config.frames)
                for body, name in zip(drawn, config.motions, strict=True)
            )
            gels.append(GelContacts(name=sensor.name, kernels=kernels, cases=cases, kinds=kinds, sequences=sequences))
            advance(1)
    return tuple(gels)


def measure(
    gels: Sequence[GelContacts], config: TangentialConfig, context: Context
) -> dict[str, dict[str, MethodErrors]]:
    """Time and errors of every method of every task: task → name → row."""
    every, tasks = methods(), {}
    with context.progress("solving", len(every), still=True) as advance:
        for task, tiers in every.items():
            true = _exact(task, gels)
            calls = {m.name: _call(task, m, gels) for m in tiers}
            shown = context.each(f"{task}: methods", calls.items())
            errors = {name: _errors(task, call(), true, gels) for name, call in shown}
            seconds = interleaved(calls, context.rounds(f"{task}: timing", config.rounds))
            units = sum(len(gel.kinds) if task != SEQUENCE else len(gel.sequences) * config.frames for gel in gels)
            ms = {name: 1e3 * float(np.median(s)) / units for name, s in seconds.items()}
            tasks[task] = {
                m.name: MethodErrors(kind=m.kind, label=m.label, ms=ms[m.name], errors=errors[m.name]) for m in tiers
            }
            advance(1)
    return tasks


def couple(config: TangentialConfig, context: Context) -> list[dict[str, Any]]:
    """Effect of coupling on every gel with markers."""
    marked = [s for s in tangential_scenes.sensors(config.sensors) if s.marker_depth_mm is not None]
    found: list[dict[str, Any]] = []
    with context.progress("coupling", len(marked), still=True) as advance:
        for sensor in marked:
            found += tangential_coupling.measure(sensor, config.grid, config.frames, config.coupled_bodies, config.seed)
            advance(1)
    return found


def check_promises(gels: Sequence[GelContacts], superposed: MethodErrors) -> list[PromiseCheck]:
    """The superposition's error and promise on every contact."""
    errors = iter(superposed.errors.tolist())
    found = []
    for gel, sensor in zip(gels, tangential_scenes.sensors(tuple(gel.name for gel in gels)), strict=True):
        pressures, moduli = np.asarray(gel.cases.ramp_mpa[:, -1]), np.asarray(gel.cases.modulus_mpa)
        for kind, pressure, modulus in zip(gel.kinds, pressures, moduli, strict=True):
            radius = tangential_scenes.contact_radius_mm(pressure, float(gel.kernels.spacing_mm))
            found.append(tangential_checks.promise(sensor, kind, next(errors), float(modulus), radius))
    return found


def requirements(
    tasks: Mapping[str, Rows], promises: Sequence[PromiseCheck], mindlin: Mapping[str, float], torque: float
) -> tuple[Requirement, ...]:
    """The figures that must be kept."""
    kept, count = float(np.mean([p.kept for p in promises])), len(promises)
    equal = []
    for task in COMPARED:
        ratio, reservation = tangential_report.at_equal_error(tasks[task])
        name = f"{task}: time against {PLAIN} at equal error"
        equal.append(Requirement(name=name, measured=ratio, bound=1, better="lower", note=reservation))
    worst = max(rows[MAIN].high for rows in tasks.values())
    return (
        *equal,
        Requirement(name=f"{MAIN}: error, 95th percentile of any task", measured=worst, bound=0.02, better="lower"),
        Requirement(
            name="contacts within the promise of the superposition",
            measured=kept,
            bound=0.95 - 2 * float(np.sqrt(0.95 * 0.05 / count)),
            better="higher",
            note=f"it says 95 %; two standard errors of {count} contacts are granted",
        ),
        Requirement(name="Cattaneo–Mindlin, slide off by", measured=mindlin["slide"], bound=0.01, better="lower"),
        Requirement(name="Cattaneo–Mindlin, force off by", measured=mindlin["force"], bound=0.01, better="lower"),
        Requirement(name="Lubkin, torque off by", measured=torque, bound=0.02, better="lower"),
    )


def verdict(tasks: Mapping[str, Rows], promises: Sequence[PromiseCheck]) -> tuple[str, ...]:
    """The answer in sentences."""
    frame, solved, read = tasks[SEQUENCE][MAIN], tasks["force"][SUPERPOSED], tasks["force"][FROM_PRESS]
    ratios = {task: tangential_report.at_equal_error(tasks[task])[0] for task in COMPARED}
    kept = float(np.mean([p.kept for p in promises]))
    return (
        f"Friction takes {frame.ms:.2f} ms per frame of a sequence at the default tolerance; its error is "
        f"{frame.median:.1%} (median; 95th percentile {frame.high:.1%}).",
        "At equal error the solver takes "
        + ", ".join(f"{ratio:.2f} of the plain one's time in a {task}" for task, ratio in ratios.items())
        + ".",
        f"After a press the superposition takes {read.ms:.3f} ms and errs by {read.median:.1%} ({solved.median:.1%} "
        f"with a contact solved for it, {solved.ms:.2f} ms); its error is within its promise on {kept:.0%} of "
        f"{len(promises)} held-out contacts.",
    )


def _to_tolerance(solve: _Solve) -> list[FrictionMethod]:
    return [FrictionMethod(kind=SOLVER, label=f"{t:g}", solve=solve, setting=t) for t in _TOLERANCES]


def _plain(solve: _Solve) -> list[FrictionMethod]:
    return [FrictionMethod(kind=PLAIN, label=f"{count}", solve=solve, setting=count) for count in _ITERATIONS]


def _exact(task: str, gels: Sequence[GelContacts]) -> list[np.ndarray]:
    """Exact tractions: one array a gel, or a sequence."""
    if task == SEQUENCE:
        return [tangential_methods.exact_sequence(motion, gel.kernels) for gel in gels for motion in gel.sequences]
    return [tangential_methods.exact(task, gel.cases, gel.kernels) for gel in gels]


def _call(task: str, method: FrictionMethod, gels: Sequence[GelContacts]) -> Callable[[], list[Any]]:
    """All contacts, or all sequences, of a method, one after the other: tractions, one array a gel or a sequence."""
    setting = jnp.asarray(method.setting)
    if task == SEQUENCE:
        runs = [(motion, gel.kernels) for gel in gels for motion in gel.sequences]
        return lambda: [tangential_methods.sequence(method.solve, *each, setting)[0] for each in runs]
    return lambda: [tangential_methods.every(method.solve, gel.cases, gel.kernels, setting) for gel in gels]


def _errors(task: str, found: list[Any], true: list[np.ndarray], gels: Sequence[GelContacts]) -> np.ndarray:
    """Relative L₂ error of the marker displacement of every contact, or frame of a sequence in units of its rms."""
    benches = [gel.kernels for gel in gels for _ in (gel.sequences if task == SEQUENCE else (None,))]
    errors = []
    for tractions, exact, kernels in zip(found, true, benches, strict=True):
        ours, seen = (
            np.asarray(tangential_methods.marker_motion(jnp.asarray(t, jnp.complex64), kernels))
            for t in (tractions, exact)
        )
        size = np.linalg.norm(seen, axis=(1, 2))
        moved = size > 0
        scale = np.sqrt(np.mean(size[moved] ** 2)) if task == SEQUENCE else size[moved]
        errors.append(np.linalg.norm(ours - seen, axis=(1, 2))[moved] / scale)
    return np.concatenate(errors)


DEFAULT = TangentialConfig()
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

EXPERIMENT = Experiment(name="pareto_tangential", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
