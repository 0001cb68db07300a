"""Where does each way of reading a gel break, and does it say so?

    python -m experiments stability_fields --data-dir DIR [--scale smoke]

Known motion on pictures of marker gels (generated ones without `--data-dir`), under seven stresses from harmless to
hopeless: displacement, frame gaps, lost dots, noise, exposure down and up to saturation, contact at the border; for
shear the same on generated slides, with noise, lost nodes and a layer that is not what it is taken for; for depth on
generated presses of a ball, with noise, exposure, drifting lamps, contact at the border, too large and too steep.  A
method breaks where more than 5 % of the points that it gives are a pixel off, where shear errs by more than half of
itself or depth by a fifth of the press; the curves say where, and whether a flag said so.  How often flags fire on real
pictures, and how often a bare gel is taken for one with markers, on every folder of the data directory.  Pictures,
motions and noise set nothing in the tracker.

Six minutes on one core (`smoke` half a minute).  Expected: the package's tracker breaks last and never in silence; what
is matched from frame to frame or to the nearest dot breaks at half a pitch and says nothing.
"""

import collections
import dataclasses
import itertools
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.fields import gel_patterns, tracking_flags
from experiments.fields.depth_stress import BROKEN_DEPTH, DEPTH_STRESSES, attempt_depth
from experiments.fields.gels_at_rest import gels
from experiments.fields.sections import FieldSection
from experiments.fields.shear_stress import BROKEN, SHEAR_STRESSES, attempt_shear
from experiments.fields.stress_curves import StressCurve, break_curves
from experiments.fields.tracking_stress import OFF_PX, STRESSES, Stress, StressOutcome, attempt
from sensors_io.schema import Flag

METHODS = (
    "this",
    "this, LK alone",
    "LK to rest",
    "LK frame to frame",
    "DIS medium",
    "dots, nearest",
    "mean shift",
)
OURS = METHODS[0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldStabilityConfig:
    """Where the recordings lie; how many gels and motions; frames of a slide; presses of the ball that depth is
    calibrated with; pictures judged per folder.
    """

    data_dir: pathlib.Path | None = None
    gels: int = 3
    seeds: int = 2
    methods: tuple[str, ...] = METHODS
    slide_frames: int = 36
    ball_presses: int = 24
    pictures: int = 60
    seed: int = 900

    def __post_init__(self) -> None:
        for name in ("gels", "seeds", "pictures"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: must be ≥ 1; raise it")
        if OURS not in self.methods:
            raise ValueError(f"methods is {self.methods}: must hold {OURS!r}, which the rest is compared with; add it")


StressOutcomes = Mapping[str, Mapping[tuple[str, float], Sequence[StressOutcome]]]
"""Method → (stress, level) → outcomes over gels and motions."""


def run(config: FieldStabilityConfig, context: Context) -> Results:
    """Break everything, draw it, judge the gels."""
    chosen = gels(config.data_dir)[: config.gels]
    outcomes: dict[str, dict[tuple[str, float], list[StressOutcome]]] = {}
    seeds = range(config.seed, config.seed + config.seeds)
    for rest, seed in context.each("motions", itertools.product(chosen, seeds)):
        for method, stress, level, outcome in attempt(rest, config.methods, seed):
            outcomes.setdefault(method, {}).setdefault((stress, level), []).append(outcome)
    shear = attempt_shear(config.slide_frames, config.seed, context)
    depth = attempt_depth(config.ball_presses, config.seeds, config.seed, context)
    panels = [_tracking(outcomes), _shear(shear), _depth(depth)]
    if config.data_dir is not None:
        panels += [
            tracking_flags.panel(config.data_dir, context),
            gel_patterns.panel(config.data_dir, config.pictures, context),
        ]
    return Results(
        verdict=tuple(v for p in panels for v in p.verdict),
        requirements=tuple(r for p in panels for r in p.requirements),
        tables=tuple(t for p in panels for t in p.tables),
        pictures=tuple(c for p in panels for c in p.pictures),
        settings={
            "gels": [r.name for r in chosen],
            "motions a gel": config.seeds,
            "a point is wrong from": f"{OFF_PX} px",
        },
        data={f"silent, {name}": _silent(by) for name, by in outcomes.items()},
    )


def _tracking(outcomes: StressOutcomes) -> FieldSection:
    said, none_silent = _silence(outcomes, "frames", "frames broken")
    mild = [o for s in STRESSES for o in outcomes[OURS][s.name, s.levels[0]] if not o.broken]
    alarms = sum(o.flagged for o in mild)
    return FieldSection(
        verdict=(
            said,
            f"{OURS}: {alarms} of {len(mild)} frames under the mildest level of each stress are flagged.",
        ),
        requirements=(none_silent,),
        tables=(_break_table("Where tracking breaks first", outcomes, STRESSES),),
        pictures=(
            _curves(
                "stability_tracking",
                "Where tracking breaks",
                "95th percentile of the distance from the truth, the worst of all gels and motions. A method breaks "
                "where more than 5 % of all points are given wrongly; it says so where it refuses more than 5 % of "
                "them, or where the package calls the picture saturated.",
                outcomes,
                STRESSES,
                OFF_PX,
                "px",
            ),
        ),
    )


def _shear(outcomes: StressOutcomes) -> FieldSection:
    return FieldSection(
        tables=(_break_table("Where shear breaks first", outcomes, SHEAR_STRESSES),),
        pictures=(
            _curves(
                "stability_shear",
                "Where shear breaks",
                "Error over the true shear, root mean squares over a generated slide.",
                outcomes,
                SHEAR_STRESSES,
                BROKEN,
                "relative",
            ),
        ),
    )


def _depth(outcomes: StressOutcomes) -> FieldSection:
    said, none_silent = _silence(outcomes, "presses", "depth wrong")
    return FieldSection(
        verdict=(said,),
        requirements=(none_silent,),
        tables=(_break_table("Where depth breaks first", outcomes, DEPTH_STRESSES),),
        pictures=(
            _curves(
                "stability_depth",
                "Where depth breaks",
                "Root mean square error over the contact of a generated press of a ball, as a share of its depth, the "
                f"worst of all presses; from {BROKEN_DEPTH:g} on it is wrong. Exposure and lamps change after the gel "
                "at rest was recorded.",
                outcomes,
                DEPTH_STRESSES,
                BROKEN_DEPTH,
                "share of the depth",
            ),
        ),
    )


def _silence(outcomes: StressOutcomes, things: str, fault: str) -> tuple[str, Requirement]:
    """How often each method was at fault without a flag, in words, and that ours must never be."""
    silent = {name: _silent(by) for name, by in outcomes.items()}
    total = sum(len(o) for o in outcomes[OURS].values())
    counts = ", ".join(f"{name} {count}" for name, count in silent.items())
    return (
        f"Of {total} {things} under stress, {fault} and not flagged: {counts}.",
        Requirement(name=f"{OURS}: {fault} and not flagged", measured=float(silent[OURS]), bound=0, better="lower"),
    )


def _silent(by: Mapping[tuple[str, float], Sequence[StressOutcome]]) -> int:
    return sum(o.silent for many in by.values() for o in many)


def _break_table(title: str, outcomes: StressOutcomes, stresses: Sequence[Stress]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, by in outcomes.items():
        cells: list[Cell] = [name]
        for stress in stresses:
            broken = [level for level in stress.levels if any(o.broken for o in by[stress.name, level])]
            cells.append(_said([o for level in broken for o in by[stress.name, level] if o.broken], broken))
        rows.append(tuple(cells))
    return Table(
        title=title,
        columns=(Column(name="method"), *(Column(name=s.name) for s in stresses)),
        rows=tuple(rows),
        note="First level at which any gel and motion breaks; which flags the broken frames of all levels carry.",
    )


def _said(broken: Sequence[StressOutcome], levels: Sequence[float]) -> str:
    """Where it breaks first, and the frames by flag: 24: marker_loss 3, silent 1."""
    if not broken:
        return "–"
    names = collections.Counter(
        " + ".join(str(f.name).lower() for f in Flag if f & o.flags) or "silent" for o in broken
    )
    return f"{levels[0]:.3g}: " + ", ".join(f"{name} {count}" for name, count in names.items())


def _curves(
    name: str,
    title: str,
    caption: str,
    outcomes: StressOutcomes,
    stresses: Sequence[Stress],
    tolerance: float,
    unit: str,
) -> Picture:
    curves = {
        method: [_curve([by[stress.name, level] for level in stress.levels]) for stress in stresses]
        for method, by in outcomes.items()
    }
    labels = [(s.name, s.levels) for s in stresses]
    return Picture(name=name, title=title, caption=caption, content=break_curves(curves, labels, tolerance, unit))


def _curve(levels: Sequence[Sequence[StressOutcome]]) -> StressCurve:
    return StressCurve(
        error=np.array([max(o.error_px for o in many) for many in levels]),
        flagged=np.array([all(o.flagged for o in many) for many in levels]),
        broken=np.array([any(o.broken for o in many) for many in levels]),
        silent=np.array([any(o.silent for o in many) for many in levels]),
    )


DEFAULT = FieldStabilityConfig()
SMOKE = FieldStabilityConfig(
    gels=1, seeds=1, methods=(OURS, "LK to rest", "dots, nearest"), slide_frames=18, ball_presses=10, pictures=4
)

EXPERIMENT = Experiment(name="stability_fields", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
