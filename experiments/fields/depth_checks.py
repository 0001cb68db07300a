"""Depth where the truth is known without a calibration: analytic slopes, presses at known depth, failed contacts."""

import dataclasses
import functools
import pathlib
from collections.abc import Iterable, Mapping

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Column, Table, at_most, named_table
from experiments.core.timing import median_ms
from experiments.fields.depth_methods import INTEGRATORS, Integrator, calibrated, depth_by
from experiments.fields.published import (
    FOLDERS,
    ball_presses,
    feelanyforce_rows,
    gelslam,
    known_depths,
    known_truth,
    read_folder,
)
from experiments.fields.sections import FieldSection
from sensors_io import quality
from sensors_io.fields.contact import ContactConfig, changed_contacts, steepest_change
from sensors_io.fields.depth import DepthReader
from sensors_io.fields.poisson import dirichlet, neumann
from sensors_io.fields.slopes import SlopeReader
from sensors_io.fields.types import Calibration

SHAPE, PITCH_MM = (240, 320), 0.0634
"""Size in pixels and pitch of the analytic surfaces."""

MOST_SCALE, MOST_UM, MOST_SHAPE_UM = 2.0, 55.0, 30.0
"""Bounds: error of the depth's scale in %, rmse at known depth in µm, and the same without its offset."""

_CENTRE, _BORDER = (160.0, 120.0), (14.0, 120.0)  # of the analytic surfaces, px


def analytic_surfaces() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Surfaces whose slopes are known exactly: name → depth, ∂z/∂x, ∂z/∂y, float64 [H, W]."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    found = {}
    for place, (x_0, y_0) in (("centre", _CENTRE), ("border", _BORDER)):
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


def integrator_section(rounds: Iterable[object]) -> FieldSection:
    """Every integrator on every analytic surface, and its time."""
    surfaces = analytic_surfaces()
    errors = {name: [scale_error(f, *surface) for surface in surfaces.values()] for name, f in INTEGRATORS.items()}
    slope_x, slope_y = (a.astype(np.float32) for a in surfaces["ball, centre"][1:])
    calls = {name: functools.partial(f, slope_x, slope_y, PITCH_MM) for name, f in INTEGRATORS.items()}
    ms = median_ms(calls, rounds)
    worst = max(abs(scale) for scale, _ in errors["this, Neumann"])
    pairs = [
        (Column(name=f"scale, {name}", unit="%", format="+.2f"), Column(name="rmse", unit="µm")) for name in surfaces
    ]
    table = Table(
        title="Slopes to depth on analytic surfaces",
        columns=(
            Column(name="integrator"),
            *(column for pair in pairs for column in pair),
            Column(name="time a frame", unit="ms", format=".2f"),
        ),
        rows=tuple((name, *(value for pair in errors[name] for value in pair), ms[name]) for name in INTEGRATORS),
        note="Other projects' integrators are reimplemented with the faults that they ship with.",
    )
    return FieldSection(
        verdict=(f"On analytic slopes the scale of depth is off by {worst:.2f} % at most, centre and border.",),
        requirements=(
            at_most("scale of depth from analytic slopes, worst of centre and border", worst, MOST_SCALE, "%"),
        ),
        tables=(table,),
    )


def known_depth_section(root: pathlib.Path, seed: int, context: Context) -> FieldSection:
    """Presses at known depth, by a calibration made with the ball presses of the same sensor."""
    presses = ball_presses("gelsight sim2real", root)
    read = SlopeReader(calibrated(presses, seed).colours, presses.background)
    found: dict[str, dict[str, list[tuple[float, float]]]] = {"Neumann": {}, "Dirichlet": {}}
    for (shape, depth_mm), picture in context.each("presses", known_depths(root).items()):
        truth, mask = known_truth(shape, depth_mm, presses.shape)
        for name, integrate in (("Neumann", neumann), ("Dirichlet", dirichlet)):
            depth = depth_by(read, picture, presses.mm_per_px, integrate)
            error = 1e3 * (np.maximum(depth, 0) - truth)[mask]
            found[name].setdefault(shape, []).append((float(np.sqrt(np.mean(error**2))), float(np.std(error))))
    rows, means = [], {}
    for name, by_shape in found.items():
        means[name] = np.mean([pair for pairs in by_shape.values() for pair in pairs], axis=0)
        rows += [(f"{name}, {shape}", len(pairs), np.mean(pairs, axis=0)) for shape, pairs in by_shape.items()]
        rows.append((f"{name}, all", sum(map(len, by_shape.values())), means[name]))
    table = named_table(
        "Presses at known depth (gelsight_sim2real)",
        [
            {"border and shape": row, "presses": n, "rmse": float(mean[0]), "offset removed": float(mean[1])}
            for row, n, mean in rows
        ],
        formats={"presses": "d", "rmse": ".1f", "offset removed": ".1f"},
        units={"rmse": "µm", "offset removed": "µm"},
        meanings={"rmse": "mean over presses"},
        note="Calibrated with the 22 ball presses of the folder, circles found automatically; the press depth is "
        "known to about 50 µm.",
    )
    (rmse, shape_only), fixed = means["Neumann"], means["Dirichlet"]
    return FieldSection(
        verdict=(
            f"At known press depth the mean rmse is {rmse:.0f} µm, {shape_only:.1f} µm with the offset removed "
            f"({fixed[0]:.0f} and {fixed[1]:.0f} µm with a fixed border).",
        ),
        requirements=(
            at_most("known press depth, mean rmse", rmse, MOST_UM, "µm"),
            at_most("known press depth, offset removed", shape_only, MOST_SHAPE_UM, "µm"),
        ),
        tables=(table,),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactRejections:
    """N pictures [N]: steepest change, grey levels/mm; rejection as failed contact by colour, and by depth if read."""

    steepness: np.ndarray
    by_colour: np.ndarray
    by_depth: np.ndarray | None = None

    @property
    def rejected(self) -> int:
        """Number of pictures that either test rejects."""
        either = self.by_colour if self.by_depth is None else self.by_colour | self.by_depth
        return int(either.sum())


def rejections(
    frames: np.ndarray, background: np.ndarray, mm_per_px: float, made: Calibration | None = None
) -> ContactRejections:
    """Pictures that the extraction rejects as failed contacts, by colour, and by the depth of a calibration."""
    config = ContactConfig()
    steep = np.array([steepest_change(f, background, mm_per_px, config.smoothing_mm) for f in frames])
    alone = np.array([changed_contacts(f, background, mm_per_px, config).count == 0 for f in frames])
    read = None if made is None else DepthReader(made)
    return ContactRejections(
        steepness=steep,
        by_colour=(steep < config.steepness) | alone,
        by_depth=None if read is None else np.array([read(f)[1].count == 0 for f in frames]),
    )


def contact_section(root: pathlib.Path, seed: int) -> FieldSection:
    """Pictures and table rows that the filters reject, with one setting for all recordings."""
    folder = FOLDERS["FeelAnyForce, untouched"]
    frames, _, background = read_folder(folder, root)
    presses = {"gelslam": gelslam(root), "FOTS": ball_presses("FOTS Mini", root)}
    found = {
        "feelanyforce": rejections(frames, background, folder.mm_per_px),
        **{n: rejections(p.pictures, p.background, p.mm_per_px, calibrated(p, seed)) for n, p in presses.items()},
    }
    rejected = found["feelanyforce"].rejected
    real = sum(found[name].rejected for name in presses)
    rows = feelanyforce_rows(root)
    empty, flagged = np.isnan(rows).all(1), quality.incomplete(rows)
    return FieldSection(
        verdict=(
            f"{rejected} of {len(frames)} pictures without contact are rejected, {real} of "
            f"{sum(map(len, presses.values()))} real contacts; {int((flagged & empty).sum())} of {int(empty.sum())} "
            "empty rows are flagged.",
        ),
        requirements=(
            at_most("pictures without contact that pass", len(frames) - rejected, 0.0),
            at_most("real contacts that are rejected, by colour or by depth", real, 0.0),
            at_most("rows flagged wrongly or not", int(np.count_nonzero(flagged != empty)), 0.0),
        ),
        tables=(_contact_table(found),),
    )


def _contact_table(found: Mapping[str, ContactRejections]) -> Table:
    rows = [
        {
            "recording": name,
            "pictures": len(r.steepness),
            "rejected by colour": int(r.by_colour.sum()),
            "rejected by depth": None if r.by_depth is None else int(r.by_depth.sum()),
            "flattest": float(r.steepness.min()),
            "steepest": float(r.steepness.max()),
        }
        for name, r in found.items()
    ]
    config = ContactConfig()
    return named_table(
        "Failed contact",
        rows,
        formats=dict.fromkeys(list(rows[0])[1:4], "d") | {"flattest": ".1f", "steepest": ".1f"},
        units={"flattest": "levels/mm", "steepest": "levels/mm"},
        meanings={"rejected by depth": "of the folder's own calibration", "flattest": "least steepest change"},
        note=f"A contact changes some channel by {config.steepness:g} grey levels/mm somewhere; its depth reaches "
        f"{1e3 * config.high_mm:g} µm and a slope of {config.rim:g}.",
    )
