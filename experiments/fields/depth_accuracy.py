"""Depth under balls of known diameter, by maps that were calibrated without the scored presses."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence

import cv2
import numpy as np

from experiments.core.charts import speed_against_error
from experiments.core.context import Context
from experiments.core.results import Picture, Requirement, Table, at_least, at_most, named_table
from experiments.core.timing import median_ms
from experiments.fields.depth_methods import MAPS, Slopes, calibrated, depth_by
from experiments.fields.generated_presses import Optics, fitted_optics, generated_presses, near_lamps
from experiments.fields.published import gelslam
from experiments.fields.sections import FieldSection
from sensors_io.calibration.circles import align_circles, find_circles
from sensors_io.calibration.presses import BallPresses, Touches
from sensors_io.calibration.validate import BallErrors, score_ball, score_presses
from sensors_io.fields.depth import DepthReader
from sensors_io.fields.sources import read_pictures
from sensors_io.fields.types import Calibration

PACKAGE = "polynomial, varying"
"""The package's map among `MAPS`."""

BALL_MM, OTHER_BALLS_MM = 6.31, (4.0, 9.5)
"""Diameters of the calibration's ball and of the other generated balls that it is scored on."""

Bounds = tuple[float, float]
"""Greatest depth rmse in µm, greatest error of the radius in %."""

SAME_BALL, OTHER_BALL = (15.0, 4.0), (20.0, 5.0)

LEAST_HZ, SPEED_PX = 240.0, (240, 320)
"""Least number of pictures of this size, rows and columns, that become depth in a second."""


def generated_sections(
    presses: int, strange_lamps: bool, rounds: int, seed: int, context: Context
) -> list[FieldSection]:
    """Generated presses: balls of other diameters than the calibration's, under both kinds of lamps; the speed.

    Args:
      presses: of the calibration's ball; half as many of each other ball.
      strange_lamps: whether lamps outside the calibration's model are tried too.
      rounds: of timing.
      seed: of the presses.
      context: shows progress.
    """

    def other_balls(optics: Optics, source: str) -> tuple[Calibration, FieldSection]:
        made = calibrated(generated_presses(BALL_MM, presses, seed, optics), seed)
        others = {
            f"{diameter:g} mm": generated_presses(diameter, max(2, presses // 2), seed + 1, optics)
            for diameter in OTHER_BALLS_MM
        }
        return made, other_ball_section(made, others, source, context)

    made, usual = other_balls(fitted_optics, "generated, supposed optics")
    strange = [other_balls(near_lamps, "generated, near lamps")[1]] if strange_lamps else []
    return [usual, *strange, speed_section(made, rounds, "generated balls")]


def recorded_sections(root: pathlib.Path, folds: int, rounds: int, seed: int, context: Context) -> list[FieldSection]:
    """Recorded presses of the calibration's ball; the speed; a ball of 9.5 mm where it was recorded."""
    presses = gelslam(root)
    made = calibrated(presses, seed)
    sections = [
        held_out_section(presses, "gelslam", folds, rounds, seed, context),
        speed_section(made, rounds, "gelslam"),
    ]
    other = root / "gelslam" / "9.500mm"
    if other.is_dir():
        pictures = read_pictures([other], "gelsight_mini").frames
        bigger = dataclasses.replace(presses, pictures=pictures, radius_mm=9.5 / 2)
        sections.append(other_ball_section(made, {"9.5 mm": bigger}, "gelslam", context))
    return sections


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationFold:
    """Presses left out of one calibration, the presses that it is made with, and the touches of both."""

    train: BallPresses
    train_touches: Touches
    rest: BallPresses
    rest_touches: np.ndarray
    rest_index: np.ndarray


def folds_of(presses: BallPresses, folds: int, seed: int, context: Context) -> list[CalibrationFold]:
    """Circles of each fold's training presses; those of the rest are found by the optics of the training presses."""
    order, found = np.random.default_rng(seed).permutation(len(presses)), []
    for k in context.each("finding circles", range(folds)):
        out = order[k::folds]
        train, rest = presses.chosen(np.setdiff1d(order, out)), presses.chosen(out)
        circles = find_circles(train)
        touches = align_circles(rest, circles.optics).touches.stacked()
        fold = CalibrationFold(
            train=train, train_touches=circles.touches, rest=rest, rest_touches=touches, rest_index=out
        )
        found.append(fold)
    return found


def held_out_errors(
    folds: Sequence[CalibrationFold], make: Callable[[BallPresses, Touches, int], Slopes], seed: int
) -> BallErrors:
    """Errors of every press by a map that was made without it."""
    rows = np.full((3, sum(len(fold.rest_index) for fold in folds)), np.nan)
    for fold in folds:
        read = make(fold.train, fold.train_touches, seed)
        for i, picture, touch in zip(fold.rest_index, fold.rest.pictures, fold.rest_touches, strict=True):
            depth = depth_by(read, picture, fold.rest.mm_per_px)
            rows[:, i] = *score_ball(depth, touch, fold.rest.radius_mm, fold.rest.mm_per_px), depth.max()
    return BallErrors(depth_um=rows[0], radius_share=rows[1], tip_mm=rows[2])


def frame_ms(made: Calibration, size: tuple[int, int], rounds: Iterable[object]) -> float:
    """Milliseconds from one picture of a size (rows, columns) to depth, zero level and contact mask, on one core."""
    background = cv2.resize(made.background, size[::-1], interpolation=cv2.INTER_AREA)
    read = DepthReader(dataclasses.replace(made, background=background))
    picture = cv2.add(background, np.full_like(background, 3))
    return median_ms({"depth": lambda: read(picture)}, rounds)["depth"]


def held_out_section(
    presses: BallPresses, name: str, folds: int, rounds: int, seed: int, context: Context
) -> FieldSection:
    """All maps on the presses of one real sensor."""
    parts = folds_of(presses, folds, seed, context)
    errors = {kind: held_out_errors(parts, make, seed) for kind, make in context.each("maps", MAPS.items())}
    calls = {}
    for kind, make in context.each("maps to time", MAPS.items()):
        read = make(parts[0].train, parts[0].train_touches, seed)
        calls[kind] = functools.partial(depth_by, read, presses.pictures[0], presses.mm_per_px)
    ms = median_ms(calls, context.rounds("timing maps", rounds))
    figures = errors[PACKAGE].figures()
    return FieldSection(
        verdict=(
            f"On {int(figures['presses'])} real presses ({name}), with circles found without labels and {folds} folds "
            f"by press, the median depth rmse is {figures['depth rmse median, um']:.1f} µm and the median error of the "
            f"radius {figures['radius error median, %']:.1f} % (bias of the median radius "
            f"{figures['radius error of the median, %']:+.1f} %).",
        ),
        requirements=ball_requirements(figures, f"{name}, held out by press", SAME_BALL),
        tables=(_map_table(errors, ms, name, folds),),
        pictures=(map_picture(errors, ms, name),),
    )


def other_ball_section(
    made: Calibration, others: Mapping[str, BallPresses], source: str, context: Context
) -> FieldSection:
    """A calibration made with one ball, scored on balls of other diameters."""
    rows = []
    requirements: list[Requirement] = []
    for name, presses in context.each("balls", others.items()):
        figures = score_presses(made, presses, find_circles(presses).touches.stacked()).figures()
        requirements += ball_requirements(figures, f"{name}, {source}", OTHER_BALL)
        errors = {key: value for key, value in _error_cells(figures).items() if key in _BALL_COLUMNS}
        rows.append({"ball": name, "presses": figures["presses"], **errors})
    table = named_table(
        f"Balls of other diameters than the calibration's ({source})",
        rows,
        formats={"presses": ".0f"} | dict.fromkeys(_BALL_COLUMNS, ".1f"),
        units={name: _UNITS[name] for name in _BALL_COLUMNS},
        meanings={"depth rmse": "median", "radius error": "median of its size"},
    )
    return FieldSection(requirements=tuple(requirements), tables=(table,))


def speed_section(made: Calibration, rounds: int, source: str) -> FieldSection:
    """Speed from a picture to depth and contact, by a calibration made from some source."""
    ms, degrees, (height, width) = frame_ms(made, SPEED_PX, range(rounds)), made.colours, SPEED_PX
    speed = at_least(
        f"picture to depth and contact, {width} × {height}, map of {source}",
        1e3 / ms,
        LEAST_HZ,
        "Hz",
        note=f"{ms:.2f} ms, degree {degrees.degree} in colour, {degrees.position_degree} in place",
    )
    sentence = f"Depth and contact come at {speed.measured:.0f} Hz from pictures of {width} × {height} on one core"
    return FieldSection(verdict=(f"{sentence}, by the map of {source}.",), requirements=(speed,))


def ball_requirements(figures: Mapping[str, float], what: str, bounds: Bounds) -> tuple[Requirement, ...]:
    """Bounds on the medians of the depth's and the radius' error over presses."""
    rmse, radius = figures["depth rmse median, um"], figures["radius error median, %"]
    p90 = [f"p90 {figures[key]:.1f}" for key in ("depth rmse p90, um", "radius error p90, %")]
    return (
        at_most(f"ball, {what}: depth rmse", rmse, bounds[0], "µm", p90[0]),
        at_most(f"ball, {what}: error of the radius", radius, bounds[1], "%", p90[1]),
    )


def map_picture(errors: Mapping[str, BallErrors], ms: Mapping[str, float], name: str) -> Picture:
    """Depth error of every map against its time."""
    points = {}
    for kind, error in errors.items():
        figures = error.figures()
        label = f"this: {kind}" if kind == PACKAGE else kind
        points[kind] = [(label, ms[kind], figures["depth rmse median, um"], figures["depth rmse p90, um"])]
    return Picture(
        name=f"depth-{name}",
        title=f"Picture to depth on real presses ({name})",
        caption="Depth error inside the contact of a ball whose press was left out of the calibration: median over "
        f"presses, bar to the 90th percentile. The dotted corner is the bound: {LEAST_HZ:g} Hz and "
        f"{SAME_BALL[0]:g} µm.",
        content=speed_against_error(points, "depth rmse, µm", (1e3 / LEAST_HZ, SAME_BALL[0]), legend=False),
    )


def _error_cells(figures: Mapping[str, float]) -> dict[str, float]:
    return {
        "depth rmse": figures["depth rmse median, um"],
        "p90": figures["depth rmse p90, um"],
        "radius error": figures["radius error median, %"],
        "p90 of it": figures["radius error p90, %"],
        "bias of the radius": figures["radius error of the median, %"],
        "tip depth": figures["tip depth median, mm"],
    }


def _map_table(errors: Mapping[str, BallErrors], ms: Mapping[str, float], name: str, folds: int) -> Table:
    rows = [{"map": kind, **_error_cells(e.figures()), "time a frame": ms[kind]} for kind, e in errors.items()]
    return named_table(
        f"Colour to slope, {name}: balls left out of the calibration",
        rows,
        formats=dict.fromkeys(_UNITS, ".1f")
        | {"bias of the radius": "+.1f", "tip depth": ".2f", "time a frame": ".2f"},
        units=_UNITS,
        meanings={
            "depth rmse": "median over presses",
            "radius error": "median of its size over presses",
            "bias of the radius": "of the median radius",
            "tip depth": "median, relative to untouched gel",
            "time a frame": "picture to depth, one core",
        },
        note=f"{folds} folds by press; all maps have the same circles, pixels and normals. The depth rmse holds within "
        "0.7 contact radii, after a fit of the sphere's centre and offset; the error of the radius is from a second "
        "fit, in which the radius is free.",
    )


_UNITS = {
    "depth rmse": "µm", "p90": "µm", "radius error": "%", "p90 of it": "%", "bias of the radius": "%",
    "tip depth": "mm", "time a frame": "ms",
}  # fmt: skip
_BALL_COLUMNS = ("depth rmse", "p90", "radius error", "p90 of it")
