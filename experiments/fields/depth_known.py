"""The depth panel, part two: integrators on analytic slopes, presses at known depth."""

import pathlib
from collections.abc import Callable, Iterable

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Requirement, Table
from experiments.core.timing import interleaved
from experiments.fields import ball_recordings
from experiments.fields.depth_balls import calibrated
from experiments.fields.depth_methods import one_sided_dirichlet, published_poisson
from experiments.fields.sections import FieldSection
from sensors_io.fields.depth import ZeroConfig, zero_level
from sensors_io.fields.poisson import dirichlet, neumann
from sensors_io.fields.slopes import SlopeReader

Integrator = Callable[[np.ndarray, np.ndarray, float], np.ndarray]

INTEGRATORS: dict[str, Integrator] = {
    "this, Neumann": neumann,
    "this, Dirichlet": dirichlet,
    "as gs_sdk and gsrobotics": published_poisson,
    "as GelSlim": one_sided_dirichlet,
}

SHAPE, PITCH_MM = (240, 320), 0.0634
SCALE, KNOWN, SHAPE_ONLY = 2.0, 55.0, 30.0
"""Bounds: error of the depth's scale in %, rmse at known depth in µm, and with the offset removed."""

_CENTRE, _BORDER = (160.0, 120.0), (14.0, 120.0)  # of analytic surfaces, px


def analytic() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Surfaces of which slopes are known exactly: name → depth, ∂z/∂x, ∂z/∂y, float64 [H, W]."""
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
    """Error of the scale in % and rmse in µm, the zero level taken from the pixels that are flat."""
    depth = integrate(slope_x.astype(np.float32), slope_y.astype(np.float32), PITCH_MM).astype(np.float64)
    deep = truth > 0.01
    depth -= np.median(depth[truth < 1e-3])
    scale = float((depth[deep] * truth[deep]).sum() / (truth[deep] ** 2).sum())
    return 100 * (scale - 1), 1e3 * float(np.sqrt(np.mean((depth - truth)[deep] ** 2)))


def poisson_panel(rounds: Iterable[object]) -> FieldSection:
    """Every integrator on every analytic surface, and its time."""
    surfaces = analytic()
    slopes = [a.astype(np.float32) for a in surfaces["ball, centre"][1:]]
    calls = {name: (lambda f=f: f(*slopes, PITCH_MM)) for name, f in INTEGRATORS.items()}
    for call in calls.values():
        call()
    ms = {name: 1e3 * float(np.median(s)) for name, s in interleaved(calls, rounds).items()}
    errors = {name: [scale_error(f, *surface) for surface in surfaces.values()] for name, f in INTEGRATORS.items()}
    worst = max(abs(scale) for scale, _ in errors["this, Neumann"])
    columns = [Column(name="integrator")]
    for name in surfaces:
        columns += [Column(name=f"scale, {name}", unit="%", format="+.2f"), Column(name="rmse", unit="µm")]
    columns.append(Column(name="time a frame", unit="ms", format=".2f"))
    rows: list[tuple[Cell, ...]] = []
    for name, pairs in errors.items():
        rows.append((name, *(value for pair in pairs for value in pair), ms[name]))
    return FieldSection(
        verdict=(f"On analytic slopes the scale of depth is off by {worst:.2f} % at most, centre and border.",),
        requirements=(
            Requirement(
                name="scale of depth from analytic slopes, worst of centre and border",
                measured=worst,
                bound=SCALE,
                better="lower",
                unit="%",
            ),
        ),
        tables=(
            Table(
                title="Slopes to depth on analytic surfaces",
                columns=tuple(columns),
                rows=tuple(rows),
                note="Peers' integrators are written anew from what they compute, faults included.",
            ),
        ),
    )


def known_panel(root: pathlib.Path, seed: int, context: Context) -> FieldSection:
    """Presses at known depth under a calibration made with the ball presses of the same sensor."""
    presses = ball_recordings.sim2real(root)
    read = SlopeReader(calibrated(presses, seed).colours, presses.background)
    found: dict[str, dict[str, list[tuple[float, float]]]] = {"Neumann": {}, "Dirichlet": {}}
    for (shape, depth_mm), picture in context.each("presses", ball_recordings.known_depths(root).items()):
        slope_x, slope_y = read(picture)
        truth, mask = ball_recordings.known_truth(shape, depth_mm, presses.shape)
        for name, integrate in (("Neumann", neumann), ("Dirichlet", dirichlet)):
            depth = integrate(slope_x, slope_y, presses.mm_per_px)
            depth -= zero_level(depth, np.hypot(slope_x, slope_y), presses.mm_per_px, ZeroConfig())
            error = 1e3 * (np.maximum(depth, 0) - truth)[mask]
            found[name].setdefault(shape, []).append((float(np.sqrt(np.mean(error**2))), float(np.std(error))))
    means = {name: np.mean([pair for pairs in by.values() for pair in pairs], axis=0) for name, by in found.items()}
    rows = []
    for name, by in found.items():
        rows += [(f"{name}, {shape}", len(pairs), *np.mean(pairs, axis=0).tolist()) for shape, pairs in by.items()]
        rows.append((f"{name}, all", sum(map(len, by.values())), *means[name].tolist()))
    return FieldSection(
        verdict=(
            f"At known press depth the mean rmse is {means['Neumann'][0]:.0f} µm, {means['Neumann'][1]:.1f} µm with "
            f"the offset removed ({means['Dirichlet'][0]:.0f} and {means['Dirichlet'][1]:.0f} µm with a fixed border).",
        ),
        requirements=tuple(
            Requirement(
                name=f"known press depth, {what}", measured=float(found_um), bound=bound, better="lower", unit="µm"
            )
            for what, found_um, bound in zip(
                ("mean rmse", "offset removed"), means["Neumann"], (KNOWN, SHAPE_ONLY), strict=True
            )
        ),
        tables=(
            Table(
                title="Presses at known depth (gelsight_sim2real)",
                columns=(
                    Column(name="border and shape"),
                    Column(name="presses", format="d"),
                    Column(name="rmse", unit="µm", format=".1f", meaning="mean over presses"),
                    Column(name="offset removed", unit="µm", format=".1f"),
                ),
                rows=tuple(rows),
                note="Calibrated with the 22 ball presses of the folder, circles found automatically; the press depth "
                "itself is good to some 50 µm.",
            ),
        ),
    )
