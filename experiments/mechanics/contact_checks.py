"""The contact solver against closed forms and against published solvers."""

import functools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping

import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Column, Table
from experiments.mechanics import oracles as contact_oracles
from sensors_io import layer
from sensors_io.scenes import contact
from sensors_io.scenes.hertz import Hertz, half_space_spectrum
from sensors_io.scenes.objects import rough_waves
from sensors_io.scenes.reference import solve_reference

Timed = Callable[[np.ndarray, float], tuple[np.ndarray, float]]
"""Gap [N, N] mm and force N → pressure [N, N] MPa and seconds."""

SIDE_MM = 16.0
GEL = layer.Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
TIGHT = 2e-5  # float32 carries little more
RADII_PX = (4, 6, 8, 12, 16, 20)


def hertz(grid: int, context: Context, radius_mm: float = 8.0, modulus_mpa: float = 0.4) -> dict[str, float]:
    """How far the solver is from Hertz, for contact radii of 4 pixels and more: exponent, peak pressure.

    The apex lies on a pixel's centre.
    """
    spacing = SIDE_MM / grid
    x = (np.arange(grid) - grid // 2) * spacing
    gap = jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / (2 * radius_mm), jnp.float32)
    kernel = jnp.asarray(half_space_spectrum(grid, spacing, modulus_mpa), jnp.float32)
    forces, depths, peaks = [], [], []
    for pixels in context.each("Hertz", (p for p in RADII_PX if p <= grid / 4)):
        force = 4 * modulus_mpa * (pixels * spacing) ** 3 / (3 * radius_mm)
        solved = contact.solve(gap, force, kernel, jnp.zeros_like(kernel), spacing, TIGHT)
        closed = Hertz(radius_mm=radius_mm, plane_modulus_mpa=modulus_mpa, force_n=force)
        forces.append(force)
        depths.append(float(solved.approach_mm))
        peaks.append(float(solved.pressure_mpa.max()) / closed.peak_pressure_mpa - 1)
    exponent = float(np.polyfit(np.log(depths), np.log(forces), 1)[0])
    return {"exponent": abs(exponent - 1.5), "peak": float(np.abs(peaks).max())}


def against_oracles(scenes: Iterable[object], grid: int, seed: int) -> dict[str, float]:
    """Worst relative L₂ error of the pressure over rough spheres, by every oracle; the seeds of all are the same.

    The bodies are periodic here, as the published solvers take them.

    Args:
      scenes: a sphere is drawn for each item.
      grid: its side.
      seed: of the spheres.
    """
    spacing = SIDE_MM / grid
    rng = np.random.default_rng(seed)
    errors: dict[str, list[float]] = {}
    for _ in scenes:
        gap, force = rough_sphere(rng, grid), float(np.exp(rng.uniform(np.log(0.5), np.log(10))))
        for name, spectrum in _bodies(grid).items():
            ours, _ = _pressure(gap, force, spectrum, spacing, TIGHT)
            for oracle, theirs in _oracle_pressures(name, gap, force, spectrum, spacing).items():
                errors.setdefault(oracle, []).append(float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)))
    return {oracle: max(e) for oracle, e in errors.items()}


def published(count: int, grid: int, seed: int, context: Context) -> Table:
    """Time and error of the pressure of every installed solver, and of the package's, on the same periodic bodies."""
    rng = np.random.default_rng(seed)
    scenes = [(rough_sphere(rng, grid), float(np.exp(rng.uniform(np.log(0.5), np.log(10))))) for _ in range(count)]
    rows: list[tuple[Cell, ...]] = []
    for body, spectrum in _bodies(grid).items():
        exact = [
            solve_reference(gap, force, spectrum, SIDE_MM / grid, 1e-9, 20_000).pressure_mpa
            for gap, force in context.each(f"exact scenes, {body}", scenes)
        ]
        for name, tolerance, solve in context.each(f"solvers, {body}", _solvers(body, spectrum, grid), still=True):
            solve(*scenes[0])  # compiles, plans its transforms
            found, seconds = zip(*(solve(gap, force) for gap, force in scenes), strict=True)
            errors = [np.linalg.norm(p - e) / np.linalg.norm(e) for p, e in zip(found, exact, strict=True)]
            rows.append((f"{name}, {body}", tolerance, 1e3 * float(np.median(seconds)), float(np.median(errors))))
    return Table(
        title=f"Published solvers at {grid}², {count} rough spheres",
        columns=(
            Column(name="solver"),
            Column(name="its tolerance", format=".0e"),
            Column(name="time", unit="ms", format=".2f"),
            Column(name="error", format=".1e", meaning="relative L₂ of the pressure, by the float64 reference"),
        ),
        rows=tuple(rows),
        note="Medians over scenes, one call a scene.  Every solver stops on a measure of its own.",
    )


def oracle_table(errors: Mapping[str, float]) -> Table:
    """The errors, and what was not installed."""
    missing = {"tamaas", "ContactMechanics"} - set(contact_oracles.installed())
    return Table(
        title="Pressure of rough spheres at tolerance 2e-5 by other solvers",
        columns=(
            Column(name="oracle"),
            Column(name="worst error", format=".1e", meaning="relative L₂ of the pressure"),
        ),
        rows=tuple(errors.items()),
        note=f"Not installed: {', '.join(sorted(missing))}." if missing else "Both published solvers were installed.",
    )


def rough_sphere(rng: np.random.Generator, grid: int) -> np.ndarray:
    """Gap of a sphere with self-affine roughness, [N, N] mm."""
    x = (np.arange(grid) + 0.5) * SIDE_MM / grid - SIDE_MM / 2
    k, a, phase = (v.astype(np.float64) for v in rough_waves(rng, rng.uniform(0.01, 0.06), 5 * SIDE_MM / grid))
    angle = k[:, 0, None, None] * x[None] + k[:, 1, None, None] * x[:, None] + phase[:, None, None]
    return (x[None] ** 2 + x[:, None] ** 2) / rng.uniform(20, 60) + np.sum(a[:, None, None] * np.cos(angle), 0)


def _bodies(grid: int) -> dict[str, np.ndarray]:
    """Periodic spectra [N, N//2 + 1] of the half-space and of the layer."""
    spacing = SIDE_MM / grid
    plane_modulus = GEL.modulus_mpa / (1 - GEL.poisson**2)
    return {
        "half-space": contact_oracles.half_space_spectrum(grid, spacing, plane_modulus),
        "layer": layer.normal_compliance(np.hypot(*layer.wave_numbers(grid, spacing)), GEL),
    }


def _solvers(body: str, spectrum: np.ndarray, grid: int) -> Iterator[tuple[str, float, Timed]]:
    """Name, tolerance and call of every solver of this kind of body."""
    spacing, found = SIDE_MM / grid, contact_oracles.installed()
    for t in (1e-3, TIGHT):
        yield "nested SPG", t, functools.partial(_pressure, spectrum=spectrum, spacing=spacing, tolerance=t)
    for t in (1e-3, 1e-6):
        if body == "half-space" and "tamaas" in found:
            yield "Tamaas", t, functools.partial(contact_oracles.tamaas_pressure, side_mm=SIDE_MM, gel=GEL, tolerance=t)
        if body == "layer" and "ContactMechanics" in found:
            solve = contact_oracles.contact_mechanics_pressure
            yield "ContactMechanics", t, functools.partial(solve, side_mm=SIDE_MM, gel=GEL, tolerance=t)


def _pressure(
    gap: np.ndarray, force: float, spectrum: np.ndarray, spacing: float, tolerance: float
) -> tuple[np.ndarray, float]:
    """By the package's solver; and the seconds that it took."""
    kernel, height = jnp.asarray(spectrum, jnp.float32), jnp.asarray(gap, jnp.float32)
    began = time.perf_counter()
    solved = contact.solve(height, force, kernel, jnp.zeros_like(kernel), spacing, tolerance)
    pressure = np.asarray(solved.pressure_mpa, np.float64)
    return pressure, time.perf_counter() - began


def _oracle_pressures(
    name: str, gap: np.ndarray, force: float, spectrum: np.ndarray, spacing: float
) -> dict[str, np.ndarray]:
    """Pressure by the float64 reference, and by the published solver of this kind of body where it is installed."""
    found = {f"float64 reference ({name})": solve_reference(gap, force, spectrum, spacing, 1e-9, 20_000).pressure_mpa}
    if name == "half-space" and "tamaas" in contact_oracles.installed():
        tamaas, _ = contact_oracles.tamaas_pressure(gap, force, SIDE_MM, GEL, 1e-10)
        found["Tamaas (half-space)"] = tamaas
    if name == "layer" and "ContactMechanics" in contact_oracles.installed():
        mechanics, _ = contact_oracles.contact_mechanics_pressure(gap, force, SIDE_MM, GEL, 1e-8)
        found["ContactMechanics (layer)"] = mechanics
    return found
