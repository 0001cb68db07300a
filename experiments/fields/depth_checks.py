"""Depth where the truth is known without a calibration: analytic slopes, presses at known depth, failed contacts."""

import functools
import pathlib
from collections.abc import Iterable

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Table, at_most, named_table
from experiments.core.timing import median_ms
from experiments.fields.depth_methods import INTEGRATORS, Integrator, calibrated, depth_by
from experiments.fields.sections import ReportPart
from sensors_io import quality
from sensors_io.calibration.published import (
    FOLDERS,
    ball_presses,
    feelanyforce_rows,
    gelslam,
    known_depths,
    known_truth,
    read_folder,
)
from sensors_io.fields.contact import ContactConfig, changed_contacts, steepest_change
from sensors_io.fields.depth import DepthReader
from sensors_io.fields.poisson import dirichlet, neumann
from sensors_io.fields.slopes import SlopeReader
from sensors_io.fields.types import Calibration

SHAPE, PITCH_MM = (240, 320), 0.0634  # size in pixels and pitch of the analytic surfaces
MOST_SCALE, MOST_UM, MOST_SHAPE_UM = 2.0, 55.0, 30.0
"""Bounds: error of the depth's scale in %, rmse at known depth in µm, and the same without its offset."""


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
    errors = {name: [scale_error(f, *surface) for surface in surfaces.values()] for name, f in INTEGRATORS.items()}
    slope_x, slope_y = (a.astype(np.float32) for a in surfaces["ball, centre"][1:])
    ms = median_ms({name: functools.partial(f, slope_x, slope_y, PITCH_MM) for name, f in INTEGRATORS.items()}, rounds)
    worst = max(abs(scale) for scale, _ in errors["this, Neumann"])
    columns = [Column(name="integrator")]
    for name in surfaces:
        columns += [Column(name=f"scale, {name}", unit="%", format="+.2f"), Column(name="rmse", unit="µm")]
    table = Table(
        title="Slopes to depth on analytic surfaces",
        columns=(*columns, Column(name="time a frame", unit="ms", format=".2f")),
        rows=tuple((name, *(value for pair in errors[name] for value in pair), ms[name]) for name in INTEGRATORS),
        note="Other projects' integrators are reimplemented with the faults that they ship with.",
    )
    scale = at_most("scale of depth from analytic slopes, worst of centre and border", worst, MOST_SCALE, "%")
    return [f"On analytic slopes the scale of depth is off by {worst:.2f} % at most, centre and border.", scale, table]


def known_depth_section(root: pathlib.Path, seed: int, context: Context) -> list[ReportPart]:
    """Presses at known depth, by a calibration made with the ball presses of the same sensor."""
    presses = ball_presses("gelsight sim2real", root)
    read = SlopeReader(calibrated(presses, seed).colours, presses.background)
    borders, found = {"Neumann": neumann, "Dirichlet": dirichlet}, dict[str, list[tuple[float, float]]]()
    for (shape, depth_mm), picture in context.each("presses", known_depths(root).items()):
        truth, mask = known_truth(shape, depth_mm, presses.shape)
        for name, integrate in borders.items():
            depth = depth_by(read, picture, presses.mm_per_px, integrate)
            error = 1e3 * (np.maximum(depth, 0) - truth)[mask]
            found.setdefault(f"{name}, {shape}", []).append((float(np.sqrt(np.mean(error**2))), float(np.std(error))))
    rows = []
    for name in borders:
        of_border = {row: pairs for row, pairs in found.items() if row.startswith(name)}
        rows += [*of_border.items(), (f"{name}, all", [pair for pairs in of_border.values() for pair in pairs])]
    means = {row: np.mean(pairs, axis=0) for row, pairs in rows}
    (rmse, shape_only), fixed = means["Neumann, all"], means["Dirichlet, all"]
    table = named_table(
        "Presses at known depth (gelsight_sim2real)",
        [
            {
                "border and shape": row,
                "presses": len(pairs),
                "rmse": float(means[row][0]),
                "offset removed": float(means[row][1]),
            }
            for row, pairs in rows
        ],
        formats={"presses": "d", "rmse": ".1f", "offset removed": ".1f"},
        units={"rmse": "µm", "offset removed": "µm"},
        meanings={"rmse": "mean over presses"},
        note="Calibrated with the 22 ball presses of the folder, circles found automatically; the press depth is "
        "known to about 50 µm.",
    )
    return [
        f"At known press depth the mean rmse is {rmse:.0f} µm, {fixed[0]:.0f} µm with a fixed border.",
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
    folder, config = FOLDERS["FeelAnyForce, untouched"], ContactConfig()
    frames, _, background = read_folder(folder, root)
    presses = {"gelslam": gelslam(root), "FOTS": ball_presses("FOTS Mini", root)}
    found = {
        "feelanyforce": rejections(frames, background, folder.mm_per_px),
        **{n: rejections(p.pictures, p.background, p.mm_per_px, calibrated(p, seed)) for n, p in presses.items()},
    }
    rejected, real = found["feelanyforce"][1], sum(found[name][1] for name in presses)
    rows = feelanyforce_rows(root)
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
        f"{rejected} of {len(frames)} pictures without contact are rejected, {real} of "
        f"{sum(map(len, presses.values()))} real contacts.",
        at_most("pictures without contact that pass", len(frames) - rejected, 0.0),
        at_most("real contacts that are rejected, by colour or by depth", real, 0.0),
        at_most("rows flagged wrongly or not", int(np.count_nonzero(flagged != empty)), 0.0),
        table,
    ]
