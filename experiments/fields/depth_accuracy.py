"""Depth under balls of known diameter, by maps calibrated without the scored presses, and where no ball is needed.

Without a calibration the truth is known of analytic slopes, of presses at known depth and of failed contacts.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from experiments.core.charts import speed_against_error
from experiments.core.context import Context
from experiments.core.results import Cell, Picture, ReportPart, Requirement, Table, at_least, at_most, named_table
from experiments.core.timing import median_ms
from experiments.fields.depth_methods import INTEGRATORS, MAPS, Integrator, SlopeMap, calibrated, depth_by
from sensors_io import quality
from sensors_io.calibration import published
from sensors_io.calibration.circles import align_circles, find_circles
from sensors_io.calibration.generated_presses import fitted_optics, generated_presses, near_lamps
from sensors_io.calibration.presses import BallPresses
from sensors_io.calibration.validate import BallErrors, score_ball, score_presses
from sensors_io.fields.contact import ContactConfig, changed_contacts, steepest_change
from sensors_io.fields.depth import DepthReader
from sensors_io.fields.poisson import dirichlet, neumann
from sensors_io.fields.slopes import SlopeReader
from sensors_io.fields.sources import read_pictures
from sensors_io.fields.types import Calibration

PACKAGE = "polynomial, varying"  # the package's map among `MAPS`
BALL_MM, OTHER_BALLS_MM = 6.31, (4.0, 9.5)
"""Diameters of the calibration's ball and of the other generated balls that it is scored on."""

SAME_BALL, OTHER_BALL = (15.0, 4.0), (20.0, 5.0)
"""Greatest depth rmse in µm and greatest error of the radius in %, for the calibration's ball and for others."""

LEAST_HZ, SPEED_PX = 240.0, (240, 320)
"""Least number of pictures of this size, rows and columns, that become depth in a second."""

SHAPE, PITCH_MM = (240, 320), 0.0634  # size in pixels and pitch of the analytic surfaces
MOST_SCALE, MOST_UM, MOST_SHAPE_UM = 2.0, 55.0, 30.0
"""Bounds: error of the depth's scale in %, rmse at known depth in µm, and the same without its offset."""

ERRORS = {
    "depth rmse": ("depth rmse median, um", "µm", ".1f"),
    "p90": ("depth rmse p90, um", "µm", ".1f"),
    "radius error": ("radius error median, %", "%", ".1f"),
    "p90 of it": ("radius error p90, %", "%", ".1f"),
    "bias of the radius": ("radius error of the median, %", "%", "+.1f"),
    "tip depth": ("tip depth median, mm", "mm", ".2f"),
}
"""Column → figure of `BallErrors`, unit, format."""


def generated_sections(presses: int, strange_lamps: bool, rounds: int, seed: int, context: Context) -> list[ReportPart]:
    """Balls of other diameters, half as many presses of each, under the supposed optics; the speed.

    With `strange_lamps` also under near lamps, which the calibration's model does not cover.
    """
    lamps = {"generated, supposed optics": fitted_optics}
    lamps |= {"generated, near lamps": near_lamps} if strange_lamps else {}
    calibrations, parts = [], list[ReportPart]()
    for source, optics in lamps.items():
        calibrations.append(calibrated(generated_presses(BALL_MM, presses, seed, optics), seed))
        others = {
            f"{diameter:g} mm": generated_presses(diameter, max(2, presses // 2), seed + 1, optics)
            for diameter in OTHER_BALLS_MM
        }
        parts += other_ball_section(calibrations[-1], others, source, context)
    return [*parts, *speed_section(calibrations[0], rounds, "generated balls")]


def recorded_sections(root: pathlib.Path, folds: int, rounds: int, seed: int, context: Context) -> list[ReportPart]:
    """Recorded presses of the calibration's ball; the speed; a ball of 9.5 mm where it was recorded."""
    presses = published.gelslam(root)
    made = calibrated(presses, seed)
    parts = held_out_section(presses, "gelslam", folds, rounds, seed, context) + speed_section(made, rounds, "gelslam")
    other = root / "gelslam" / "9.500mm"
    if other.is_dir():
        pictures = read_pictures([other], "gelsight_mini").frames
        bigger = dataclasses.replace(presses, pictures=pictures, radius_mm=9.5 / 2)
        parts += other_ball_section(made, {"9.5 mm": bigger}, "gelslam", context)
    return parts


def held_out_errors(
    presses: BallPresses, folds: int, seed: int, context: Context
) -> tuple[dict[str, BallErrors], dict[str, SlopeMap]]:
    """Errors of every press by each of `MAPS` made without it; the maps of the first fold.

    The circles of a fold's training presses are found without labels, those of the rest by the optics of these.
    """
    order, first = np.random.default_rng(seed).permutation(len(presses)), dict[str, SlopeMap]()
    rows = {kind: np.full((3, len(presses)), np.nan) for kind in MAPS}
    for k in context.each("folds", range(folds)):
        out = order[k::folds]
        train, rest = presses.chosen(np.setdiff1d(order, out)), presses.chosen(out)
        circles = find_circles(train)
        touches = align_circles(rest, circles.optics).touches.stacked()
        maps = {kind: make(train, circles.touches, seed) for kind, make in MAPS.items()}
        first = first or maps
        for kind, read in maps.items():
            for i, picture, touch in zip(out, rest.pictures, touches, strict=True):
                depth = depth_by(read, picture, rest.mm_per_px)
                rows[kind][:, i] = *score_ball(depth, touch, rest.radius_mm, rest.mm_per_px), depth.max()
    errors = {kind: BallErrors(depth_um=um, radius_share=r, tip_mm=tip) for kind, (um, r, tip) in rows.items()}
    return errors, first


def held_out_section(
    presses: BallPresses, name: str, folds: int, rounds: int, seed: int, context: Context
) -> list[ReportPart]:
    """All maps on the presses of one real sensor."""
    errors, maps = held_out_errors(presses, folds, seed, context)
    still, pitch = presses.pictures[0], presses.mm_per_px
    calls = {kind: functools.partial(depth_by, read, still, pitch) for kind, read in maps.items()}
    ms = median_ms(calls, context.rounds("timing maps", rounds))
    figures = {kind: error.figures() for kind, error in errors.items()}
    own = figures[PACKAGE]
    table = _error_table(
        f"Colour to slope, {name}: balls left out of the calibration",
        [{"map": kind, **_error_cells(f), "time a frame": ms[kind]} for kind, f in figures.items()],
        note=f"{folds} folds by press; all maps have the same circles, pixels and normals. The depth rmse holds within "
        "0.7 contact radii, after a fit of the sphere's centre and offset; the error of the radius is from a second "
        "fit, in which the radius is free.",
    )
    points = {
        kind: [(label, ms[kind], f["depth rmse median, um"], f["depth rmse p90, um"])]
        for kind, f in figures.items()
        for label in [f"this: {kind}" if kind == PACKAGE else kind]
    }
    picture = Picture(
        name=f"depth-{name}",
        title=f"Picture to depth on real presses ({name})",
        caption="Depth error inside the contact of a ball whose press was left out of the calibration: median over "
        f"presses, bar to the 90th percentile. The dotted corner is the bound: {LEAST_HZ:g} Hz and "
        f"{SAME_BALL[0]:g} µm.",
        content=speed_against_error(points, "depth rmse, µm", (1e3 / LEAST_HZ, SAME_BALL[0]), legend=False),
    )
    return [
        f"On {int(own['presses'])} real presses ({name}) left out of the calibration, the median depth rmse is "
        f"{own['depth rmse median, um']:.1f} µm.",
        *ball_requirements(own, f"{name}, held out by press", SAME_BALL),
        table,
        picture,
    ]


def other_ball_section(
    made: Calibration, others: Mapping[str, BallPresses], source: str, context: Context
) -> list[ReportPart]:
    """A calibration made with one ball, scored on balls of other diameters."""
    rows, requirements = [], list[Requirement]()
    for name, presses in context.each("balls", others.items()):
        figures = score_presses(made, presses, find_circles(presses).touches.stacked()).figures()
        requirements += ball_requirements(figures, f"{name}, {source}", OTHER_BALL)
        rows.append({"ball": name, "presses": figures["presses"], **_error_cells(figures, list(ERRORS)[:4])})
    table = _error_table(f"Balls of other diameters than the calibration's ({source})", rows)
    return [*requirements, table]


def speed_section(made: Calibration, rounds: int, source: str) -> list[ReportPart]:
    """Speed from a picture to depth, zero level and contact mask on one core, by a calibration from some source."""
    height, width = SPEED_PX
    background = cv2.resize(made.background, (width, height), interpolation=cv2.INTER_AREA)
    read = DepthReader(dataclasses.replace(made, background=background))
    picture = cv2.add(background, np.full_like(background, 3))
    ms = median_ms({"depth": lambda: read(picture)}, range(rounds))["depth"]
    return [
        at_least(
            f"picture to depth and contact, {width} × {height}, map of {source}",
            1e3 / ms,
            LEAST_HZ,
            "Hz",
            note=f"{ms:.2f} ms, degree {made.colours.degree} in colour, {made.colours.position_degree} in place",
        )
    ]


def ball_requirements(
    figures: Mapping[str, float], what: str, bounds: tuple[float, float]
) -> tuple[Requirement, Requirement]:
    """Bounds on the medians of the depth's and the radius' error over presses."""
    rmse, radius = figures["depth rmse median, um"], figures["radius error median, %"]
    p90 = [f"p90 {figures[key]:.1f}" for key in ("depth rmse p90, um", "radius error p90, %")]
    return (
        at_most(f"ball, {what}: depth rmse", rmse, bounds[0], "µm", p90[0]),
        at_most(f"ball, {what}: error of the radius", radius, bounds[1], "%", p90[1]),
    )


def _error_cells(figures: Mapping[str, float], columns: Sequence[str] = tuple(ERRORS)) -> dict[str, float]:
    return {column: figures[ERRORS[column][0]] for column in columns}


def _error_table(title: str, rows: Sequence[Mapping[str, Any]], note: str = "") -> Table:
    units = {name: unit for name, (_, unit, _) in ERRORS.items()} | {"time a frame": "ms"}
    formats = {name: form for name, (*_, form) in ERRORS.items()} | {"time a frame": ".2f", "presses": ".0f"}
    meanings = {
        "depth rmse": "median over presses",
        "radius error": "median of its size over presses",
        "bias of the radius": "of the median radius",
        "tip depth": "median, relative to untouched gel",
        "time a frame": "picture to depth, one core",
    }
    units, formats, meanings = ({k: v for k, v in d.items() if k in rows[0]} for d in (units, formats, meanings))
    return named_table(title, rows, formats=formats, units=units, meanings=meanings, note=note)


# Truth without a calibration -----------------------------------------------------------------------------------------


def analytic_surfaces() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Surfaces whose slopes are known exactly: name → depth, ∂z/∂x, ∂z/∂y, float64 [H, W]."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    found = {}
    for place, x_0, y_0 in (("centre", 160.0, 120.0), ("border", 14.0, 120.0)):
        dx, dy = (x - x_0) * PITCH_MM, (y - y_0) * PITCH_MM
        square = dx**2 + dy**2
        bump = 0.5 * np.exp(-square / (2 * 1.5**2))  # 0.5 mm deep, 1.5 mm wide
        found[f"bump, {place}"] = bump, -dx / 1.5**2 * bump, -dy / 1.5**2 * bump
        radius, depth = 3.155, 0.5
        inside = square < radius**2 - (radius - depth) ** 2
        height = np.sqrt(np.where(inside, radius**2 - square, 1))
        cap = np.where(inside, height - (radius - depth), 0)
        found[f"ball, {place}"] = cap, np.where(inside, -dx / height, 0), np.where(inside, -dy / height, 0)
    return found


def scale_error(
    integrate: Integrator, truth: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray
) -> tuple[float, float]:
    """Error of the scale in % and rmse in µm; the zero level is the median over the flat pixels."""
    depth = integrate(slope_x.astype(np.float32), slope_y.astype(np.float32), PITCH_MM).astype(np.float64)
    deep = truth > 0.01
    depth -= np.median(depth[truth < 1e-3])
    scale = float((depth[deep] * truth[deep]).sum() / (truth[deep] ** 2).sum())
    return 100 * (scale - 1), 1e3 * float(np.sqrt(np.mean((depth - truth)[deep] ** 2)))


def integrator_section(rounds: Iterable[object]) -> list[ReportPart]:
    """Every integrator on every analytic surface, and its time."""
    surfaces = analytic_surfaces()
    errors = {
        name: {at: scale_error(f, *surface) for at, surface in surfaces.items()} for name, f in INTEGRATORS.items()
    }
    slope_x, slope_y = (a.astype(np.float32) for a in surfaces["ball, centre"][1:])
    ms = median_ms({name: functools.partial(f, slope_x, slope_y, PITCH_MM) for name, f in INTEGRATORS.items()}, rounds)
    worst = max(abs(scale) for scale, _ in errors["this, Neumann"].values())
    scales, rmses = ({at: f"{what}, {at}" for at in surfaces} for what in ("scale", "rmse"))
    table = named_table(
        "Slopes to depth on analytic surfaces",
        [
            {"integrator": name}
            | {scales[at]: scale for at, (scale, _) in by_surface.items()}
            | {rmses[at]: rmse for at, (_, rmse) in by_surface.items()}
            | {"time a frame": ms[name]}
            for name, by_surface in errors.items()
        ],
        formats=dict.fromkeys(scales.values(), "+.2f") | {"time a frame": ".2f"},
        units=dict.fromkeys(scales.values(), "%") | dict.fromkeys(rmses.values(), "µm") | {"time a frame": "ms"},
        note="Other projects' integrators are reimplemented with the faults that they ship with.",
    )
    scale = at_most("scale of depth from analytic slopes, worst of centre and border", worst, MOST_SCALE, "%")
    return [
        f"On analytic slopes the error of the depth scale is at most {worst:.2f} %, at centre and border.",
        scale,
        table,
    ]


def known_depth_section(root: pathlib.Path, seed: int, context: Context) -> list[ReportPart]:
    """Presses at known depth, by a calibration made with the ball presses of the same sensor."""
    presses = published.ball_presses("gelsight sim2real", root)
    read = SlopeReader(calibrated(presses, seed).colours, presses.background)
    borders, found = {"Neumann": neumann, "Dirichlet": dirichlet}, dict[str, list[tuple[float, float]]]()
    for (shape, depth_mm), picture in context.each("presses", published.known_depths(root).items()):
        truth, mask = published.known_truth(shape, depth_mm, presses.shape)
        for name, integrate in borders.items():
            depth = depth_by(read, picture, presses.mm_per_px, integrate)
            error = 1e3 * (np.maximum(depth, 0) - truth)[mask]
            found.setdefault(f"{name}, {shape}", []).append((float(np.sqrt(np.mean(error**2))), float(np.std(error))))
    for name in borders:
        found[f"{name}, all"] = [pair for row, pairs in found.items() if row.startswith(name) for pair in pairs]
    means = {row: np.mean(pairs, axis=0).tolist() for row, pairs in sorted(found.items())}
    rmse, shape_only = means["Neumann, all"]
    table = named_table(
        "Presses at known depth (gelsight_sim2real)",
        [
            {"border and shape": row, "presses": len(found[row]), "rmse": mean, "offset removed": left}
            for row, (mean, left) in means.items()
        ],
        formats={"presses": "d", "rmse": ".1f", "offset removed": ".1f"},
        units={"rmse": "µm", "offset removed": "µm"},
        meanings={"rmse": "mean over presses"},
        note="Calibrated with the 22 ball presses of the folder, circles found automatically; the press depth is "
        "known to about 50 µm.",
    )
    return [
        at_most("known press depth, mean rmse", rmse, MOST_UM, "µm"),
        at_most("known press depth, offset removed", shape_only, MOST_SHAPE_UM, "µm"),
        table,
    ]


def rejections(
    frames: np.ndarray, background: np.ndarray, mm_per_px: float, made: Calibration | None = None
) -> tuple[dict[str, Cell], int]:
    """Cells of the table on failed contacts, and how many pictures colour or the depth of a calibration rejects."""
    config = ContactConfig()
    steep = np.array([steepest_change(f, background, mm_per_px, config.smoothing_mm) for f in frames])
    alone = np.array([changed_contacts(f, background, mm_per_px, config).count == 0 for f in frames])
    by_colour, by_depth = (steep < config.steepness) | alone, np.zeros(len(frames), bool)
    if made is not None:
        read = DepthReader(made)
        by_depth = np.array([read(f)[1].count == 0 for f in frames])
    cells: dict[str, Cell] = {
        "pictures": len(frames),
        "rejected by colour": int(by_colour.sum()),
        "rejected by depth": None if made is None else int(by_depth.sum()),
        "flattest": float(steep.min()),
        "steepest": float(steep.max()),
    }
    return cells, int((by_colour | by_depth).sum())


def contact_section(root: pathlib.Path, seed: int) -> list[ReportPart]:
    """Pictures and table rows that the filters reject, with one setting for all recordings."""
    folder, config = published.FOLDERS["FeelAnyForce, untouched"], ContactConfig()
    frames, _, background = published.read_folder(folder, root)
    presses = {"gelslam": published.gelslam(root), "FOTS": published.ball_presses("FOTS Mini", root)}
    found = {
        "feelanyforce": rejections(frames, background, folder.mm_per_px),
        **{n: rejections(p.pictures, p.background, p.mm_per_px, calibrated(p, seed)) for n, p in presses.items()},
    }
    rejected, real = found["feelanyforce"][1], sum(found[name][1] for name in presses)
    contacts = sum(map(len, presses.values()))
    rows = published.feelanyforce_rows(root)
    empty, flagged = np.isnan(rows).all(1), quality.incomplete(rows)
    table = named_table(
        "Failed contact",
        [{"recording": name, **cells} for name, (cells, _) in found.items()],
        formats=dict.fromkeys(("pictures", "rejected by colour", "rejected by depth"), "d")
        | {"flattest": ".1f", "steepest": ".1f"},
        units={"flattest": "levels/mm", "steepest": "levels/mm"},
        meanings={"rejected by depth": "of the folder's own calibration", "flattest": "least steepest change"},
        note=f"A contact changes some channel by {config.steepness:g} grey levels/mm somewhere; its depth reaches "
        f"{1e3 * config.high_mm:g} µm and a slope of {config.rim:g}.",
    )
    return [
        at_most("pictures without contact that pass", len(frames) - rejected, 0.0, note=f"of {len(frames)}"),
        at_most("real contacts that are rejected, by colour or by depth", real, 0.0, note=f"of {contacts}"),
        at_most("rows flagged wrongly or not", int(np.count_nonzero(flagged != empty)), 0.0),
        table,
    ]
