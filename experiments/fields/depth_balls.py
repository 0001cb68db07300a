"""The depth panel, part one: balls of known diameter, reconstructed by maps that have not seen the press."""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np

from experiments.core.charts import speed_against_error
from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Table
from experiments.core.timing import interleaved
from experiments.fields.depth_methods import MAPS, Slopes
from experiments.fields.sections import FieldSection
from sensors_io.calibration.circles import align_circles, find_circles
from sensors_io.calibration.fit import fit_map
from sensors_io.calibration.presses import BallPresses, Touches
from sensors_io.calibration.validate import BallErrors, score_ball, score_presses
from sensors_io.fields.depth import DepthReader, ZeroConfig, zero_level
from sensors_io.fields.poisson import neumann
from sensors_io.fields.types import Calibration

PACKAGE = "polynomial, varying"
MICROMETRES, RADIUS = 15.0, 4.0
OTHER_MICROMETRES, OTHER_RADIUS = 20.0, 5.0
"""Bounds: depth rmse in µm, error of the radius in %; of the calibration's ball, and of another one."""

LEAST_HZ = 240.0
"""Pictures of 320 × 240 to depth, a second."""

_SCORES = (
    "depth rmse median, um",
    "depth rmse p90, um",
    "radius error median, %",
    "radius error p90, %",
    "radius error of the median, %",
    "tip depth median, mm",
)
OTHER_BALLS_MM = (4.0, 9.5)
"""Diameters of generated balls that the calibration, made with 6.31 mm, has not seen."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationFold:
    """Presses left out of one calibration, its training presses and all their touches."""

    train: BallPresses
    train_touches: Touches
    rest: BallPresses
    rest_touches: np.ndarray
    rest_index: np.ndarray


def folds_of(presses: BallPresses, folds: int, seed: int, context: Context) -> list[CalibrationFold]:
    """Circles of each fold's training presses, and those of the rest by the optics of the training presses alone."""
    order, found = np.random.default_rng(seed).permutation(len(presses)), []
    for k in context.each("finding circles", range(folds)):
        out = order[k::folds]
        train, rest = presses.chosen(np.setdiff1d(order, out)), presses.chosen(out)
        circles = find_circles(train)
        touches = align_circles(rest, circles.optics).touches.stacked()
        found.append(
            CalibrationFold(train=train, train_touches=circles.touches, rest=rest, rest_touches=touches, rest_index=out)
        )
    return found


def held_out(
    folds: list[CalibrationFold], make: Callable[[BallPresses, Touches, int], Slopes], seed: int
) -> BallErrors:
    """Errors of every press by maps made without it."""
    count = sum(len(fold.rest_index) for fold in folds)
    rows = np.full((3, count), np.nan)
    for fold in folds:
        read = make(fold.train, fold.train_touches, seed)
        for i, picture, touch in zip(fold.rest_index, fold.rest.pictures, fold.rest_touches, strict=True):
            depth = depth_by(read, picture, fold.rest.mm_per_px)
            rows[:, i] = *score_ball(depth, touch, fold.rest.radius_mm, fold.rest.mm_per_px), depth.max()
    return BallErrors(depth_um=rows[0], radius_share=rows[1], tip_mm=rows[2])


def depth_by(read: Slopes, picture: np.ndarray, mm_per_px: float) -> np.ndarray:
    """Depth of one picture by some map and the package's integration and zero level."""
    slope_x, slope_y = read(picture)
    depth = neumann(slope_x, slope_y, mm_per_px)
    return depth - zero_level(depth, np.hypot(slope_x, slope_y), mm_per_px, ZeroConfig())


def real_panel(presses: BallPresses, name: str, folds: int, rounds: int, seed: int, context: Context) -> FieldSection:
    """All maps on the presses of one real sensor: table, chart of speed against error, requirements."""
    parts = folds_of(presses, folds, seed, context)
    errors = {kind: held_out(parts, make, seed) for kind, make in context.each("maps", MAPS.items())}
    readers = {
        kind: make(parts[0].train, parts[0].train_touches, seed)
        for kind, make in context.each("maps to time", MAPS.items())
    }
    picture = presses.pictures[0]
    calls = {kind: (lambda read=read: depth_by(read, picture, presses.mm_per_px)) for kind, read in readers.items()}
    for call in calls.values():
        call()
    ms = {
        kind: 1e3 * float(np.median(s)) for kind, s in interleaved(calls, context.rounds("timing maps", rounds)).items()
    }
    figures = errors[PACKAGE].figures()
    return FieldSection(
        verdict=(
            f"On {int(figures['presses'])} real presses ({name}), circles found without labels and {folds}-fold by "
            f"press, depth is off by {figures['depth rmse median, um']:.1f} µm and the radius by "
            f"{figures['radius error median, %']:.1f} % (medians; of the median radius "
            f"{figures['radius error of the median, %']:+.1f} %).",
        ),
        requirements=ball_requirements(figures, f"{name}, held out by press", MICROMETRES, RADIUS),
        tables=(map_table(errors, ms, name, folds),),
        pictures=(map_picture(errors, ms, name),),
    )


def ball_requirements(
    figures: dict[str, float], what: str, micrometres: float, radius: float
) -> tuple[Requirement, ...]:
    """Depth and radius, medians over the presses."""
    return (
        Requirement(
            name=f"ball, {what}: depth rmse",
            measured=figures["depth rmse median, um"],
            bound=micrometres,
            better="lower",
            unit="µm",
            note=f"p90 {figures['depth rmse p90, um']:.1f}",
        ),
        Requirement(
            name=f"ball, {what}: error of the radius",
            measured=figures["radius error median, %"],
            bound=radius,
            better="lower",
            unit="%",
            note=f"p90 {figures['radius error p90, %']:.1f}",
        ),
    )


def map_table(errors: dict[str, BallErrors], ms: dict[str, float], name: str, folds: int) -> Table:
    """One row a map."""
    rows: list[tuple[Cell, ...]] = []
    for kind, error in errors.items():
        figures = error.figures()
        rows.append((kind, *(figures[key] for key in _SCORES), ms[kind]))
    return Table(
        title=f"Colour to slope, {name}: balls left out of the calibration",
        columns=(
            Column(name="map"),
            Column(name="depth rmse", unit="µm", format=".1f", meaning="median over presses"),
            Column(name="p90", unit="µm", format=".1f"),
            Column(name="radius error", unit="%", format=".1f", meaning="median of its size over presses"),
            Column(name="p90 of it", unit="%", format=".1f"),
            Column(name="bias of the radius", unit="%", format="+.1f", meaning="of the median radius"),
            Column(name="tip depth", unit="mm", format=".2f", meaning="median, against untouched gel"),
            Column(name="time a frame", unit="ms", format=".2f", meaning="picture to depth, one core"),
        ),
        rows=tuple(rows),
        note=f"{folds} folds by press; same circles, same pixels, same normals for every map; centre and offset of the "
        "sphere fitted within 0.7 contact radii; the radius of another fit is free.",
    )


def map_picture(errors: dict[str, BallErrors], ms: dict[str, float], name: str) -> Picture:
    """Speed against depth error."""
    points = {}
    for kind, error in errors.items():
        figures = error.figures()
        label = f"this: {kind}" if kind == PACKAGE else kind
        points[kind] = [(label, ms[kind], figures["depth rmse median, um"], figures["depth rmse p90, um"])]
    return Picture(
        name=f"depth-{name}",
        title=f"Picture to depth on real presses ({name})",
        caption="Depth error inside the contact of a ball that the calibration has not seen; the bar ends at the 90th "
        "percentile over presses. The dotted corner is the bound: 240 Hz and 15 µm.",
        content=speed_against_error(points, "depth rmse, µm", (1e3 / 240, MICROMETRES), legend=False),
    )


def other_ball_panel(made: Calibration, others: dict[str, BallPresses], source: str, context: Context) -> FieldSection:
    """A calibration made with one ball, scored on balls of other diameters."""
    rows: list[tuple[Cell, ...]] = []
    requirements: list[Requirement] = []
    for name, presses in context.each("balls", others.items()):
        circles = find_circles(presses)
        figures = score_presses(made, presses, circles.touches.stacked()).figures()
        requirements += ball_requirements(figures, f"{name}, {source}", OTHER_MICROMETRES, OTHER_RADIUS)
        rows.append((name, *(figures[key] for key in ("presses", *_SCORES[:4]))))
    table = Table(
        title=f"Balls of other diameters than the calibration's ({source})",
        columns=(
            Column(name="ball"),
            Column(name="presses", format=".0f"),
            Column(name="depth rmse", unit="µm", format=".1f", meaning="median"),
            Column(name="p90", unit="µm", format=".1f"),
            Column(name="radius error", unit="%", format=".1f", meaning="median of its size"),
            Column(name="p90 of it", unit="%", format=".1f"),
        ),
        rows=tuple(rows),
    )
    return FieldSection(requirements=tuple(requirements), tables=(table,))


def calibrated(presses: BallPresses, seed: int) -> Calibration:
    """A calibration with all presses."""
    colours, _, _ = fit_map(presses, find_circles(presses).touches, seed=seed)
    return Calibration(
        sensor="gelsight_mini",
        background=presses.background,
        mm_per_px=presses.mm_per_px,
        colours=colours,
        made_from={},
    )


def speed_requirement(made: Calibration, size: tuple[int, int], rounds: int, source: str) -> Requirement:
    """How many pictures of a size become depth and contact a second, by a map of some source."""
    ms, degrees = frame_ms(made, size, rounds), made.colours
    return Requirement(
        name=f"picture to depth and contact, {size[1]} × {size[0]}, map of {source}",
        measured=1e3 / ms,
        bound=LEAST_HZ,
        better="higher",
        unit="Hz",
        note=f"{ms:.2f} ms, degree {degrees.degree} in colour, {degrees.position_degree} in place",
    )


def frame_ms(made: Calibration, size: tuple[int, int], rounds: int) -> float:
    """Time of one picture to depth, zero level and contact mask, at (rows, columns), one core."""
    height, width = size
    background = cv2.resize(made.background, (width, height), interpolation=cv2.INTER_AREA)
    read = DepthReader(dataclasses.replace(made, background=background))
    picture = cv2.add(background, np.full_like(background, 3))
    read(picture)
    return 1e3 * float(np.median(interleaved({"depth": lambda: read(picture)}, range(rounds))["depth"]))
