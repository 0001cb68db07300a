"""The contact solver compared with closed forms, a float64 reference and published solvers.

Published solvers are measured where they are installed (`pip install touchr1-jax[oracles]`): Tamaas solves a periodic
half-space, ContactMechanics a periodic layer bonded to a rigid base, both by conjugate gradients in float64.
"""

import functools
import importlib.util
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Cell, Table, named_table
from experiments.mechanics.contact_scenes import GEL, SIDE_MM, rough_sphere
from sensors_io import layer
from sensors_io.scenes import contact
from sensors_io.scenes.hertz import Hertz, half_space_spectrum
from sensors_io.scenes.reference import solve_reference

TIGHT = 2e-5  # float32 carries little more
RADII_PX = (4, 6, 8, 12, 16, 20)
SPHERE_RADIUS_MM, PLANE_MODULUS_MPA = 8.0, 0.4


def hertz(grid: int, context: Context) -> dict[str, float]:
    """Deviation of the solver from Hertz for contact radii of 4 pixels and more: exponent of F(δ), peak pressure.

    The apex lies on a pixel's centre.
    """
    spacing = SIDE_MM / grid
    x = (np.arange(grid) - grid // 2) * spacing
    gap = jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / (2 * SPHERE_RADIUS_MM), jnp.float32)
    kernel = jnp.asarray(half_space_spectrum(grid, spacing, PLANE_MODULUS_MPA), jnp.float32)
    forces, depths, peaks = [], [], []
    for pixels in context.each("Hertz", (p for p in RADII_PX if p <= grid / 4)):
        force = 4 * PLANE_MODULUS_MPA * (pixels * spacing) ** 3 / (3 * SPHERE_RADIUS_MM)
        solved = contact.solve(gap, force, kernel, jnp.zeros_like(kernel), spacing, TIGHT)
        closed = Hertz(radius_mm=SPHERE_RADIUS_MM, plane_modulus_mpa=PLANE_MODULUS_MPA, force_n=force)
        forces.append(force)
        depths.append(float(solved.approach_mm))
        peaks.append(float(solved.pressure_mpa.max()) / closed.peak_pressure_mpa - 1)
    exponent = float(np.polyfit(np.log(depths), np.log(forces), 1)[0])
    return {"exponent": abs(exponent - 1.5), "peak": float(np.abs(peaks).max())}


def oracle_errors(count: int, grid: int, seed: int, context: Context) -> dict[str, float]:
    """Worst relative L₂ error of the pressure of `count` rough spheres, by oracle; bodies are periodic."""
    errors: dict[str, float] = {}
    for gap, force in context.each("other solvers' scenes", _rough_presses(count, grid, seed)):
        for body, spectrum in _bodies(grid).items():
            ours, _ = _package_pressure(gap, force, spectrum, TIGHT)
            oracles = {f"float64 reference ({body})": _reference_pressure(gap, force, spectrum)}
            if body in installed():
                oracle = installed()[body]
                oracles[f"{oracle.name} ({body})"], _ = oracle.solve(gap, force, oracle.tight)
            for name, theirs in oracles.items():
                errors[name] = max(errors.get(name, 0.0), _relative_error(ours, theirs))
    return errors


def solver_table(count: int, grid: int, seed: int, context: Context) -> Table:
    """Time and error of the pressure of every installed solver, and of the package's, on the same periodic bodies."""
    scenes = _rough_presses(count, grid, seed)
    rows: list[dict[str, Cell]] = []
    for body, spectrum in _bodies(grid).items():
        shown = context.each(f"exact scenes, {body}", scenes)
        exact = [_reference_pressure(gap, force, spectrum) for gap, force in shown]
        ours = functools.partial(_package_pressure, spectrum=spectrum)
        solvers = [("nested SPG", t, functools.partial(ours, tolerance=t)) for t in (1e-3, TIGHT)]
        if body in installed():
            name, _, theirs, _ = installed()[body]
            solvers += [(name, t, functools.partial(theirs, tolerance=t)) for t in (1e-3, 1e-6)]
        for name, tolerance, solve in context.each(f"solvers, {body}", solvers, still=True):
            solve(*scenes[0])  # compiles, plans its transforms
            found, seconds = zip(*(solve(gap, force) for gap, force in scenes), strict=True)
            error = float(np.median(list(map(_relative_error, found, exact))))
            ms = 1e3 * float(np.median(seconds))
            rows.append({"solver": f"{name}, {body}", "its tolerance": tolerance, "time": ms, "error": error})
    return named_table(
        f"Published solvers at {grid}², {count} rough spheres",
        rows,
        formats={"its tolerance": ".0e", "time": ".2f", "error": ".1e"},
        units={"time": "ms"},
        meanings={"error": "relative L₂ of the pressure, compared with the float64 reference"},
        note="Medians over scenes, one call per scene.  Each solver has its own stopping criterion.",
    )


def oracle_table(errors: dict[str, float]) -> Table:
    """The errors, and which oracles are not installed."""
    missing = sorted(solver.package for body, solver in PUBLISHED.items() if body not in installed())
    return named_table(
        "Pressure of rough spheres at tolerance 2e-5 by other solvers",
        [{"oracle": name, "worst error": error} for name, error in errors.items()],
        formats={"worst error": ".1e"},
        meanings={"worst error": "relative L₂ of the pressure"},
        note=f"Not installed: {', '.join(missing)}." if missing else "Both published solvers are installed.",
    )


def tamaas_pressure(gap_mm: np.ndarray, force_n: float, tolerance: float) -> tuple[np.ndarray, float]:
    """Pressure [N, N] MPa on a periodic half-space of the gel's material, and the seconds that the solve took."""
    import tamaas

    tamaas.set_log_level(tamaas.LogLevel.error)
    model = tamaas.ModelFactory.createModel(tamaas.model_type.basic_2d, [SIDE_MM, SIDE_MM], list(gap_mm.shape))
    model.E, model.nu = GEL.modulus_mpa, GEL.poisson
    solver = tamaas.PolonskyKeerRey(model, gap_mm.min() - gap_mm, tolerance)
    began = time.perf_counter()
    solver.solve(force_n / SIDE_MM**2)
    return np.array(model.traction).reshape(gap_mm.shape), time.perf_counter() - began


def contact_mechanics_pressure(gap_mm: np.ndarray, force_n: float, tolerance: float) -> tuple[np.ndarray, float]:
    """Pressure [N, N] MPa on a periodic layer, and the seconds that the solve took.

    The tolerance is the greatest penetration relative to the rms of the gap.

    Raises:
      RuntimeError: it did not converge.
    """
    n, sides = gap_mm.shape[0], (SIDE_MM, SIDE_MM)
    with np.errstate(all="ignore"), warnings.catch_warnings():  # its kernel overflows and repairs itself
        warnings.simplefilter("ignore", ImportWarning)  # it runs without MPI
        from ContactMechanics import PeriodicFFTElasticHalfSpace
        from ContactMechanics.Optimization import constrained_conjugate_gradients
        from SurfaceTopography import Topography

        base = PeriodicFFTElasticHalfSpace(
            gap_mm.shape, GEL.modulus_mpa, sides, thickness=GEL.thickness_mm, poisson=GEL.poisson
        )
        rigid = Topography(gap_mm.min() - gap_mm, sides)
        began = time.perf_counter()
        found = constrained_conjugate_gradients(
            base, rigid, external_force=force_n, pentol=tolerance * float(np.std(gap_mm)), maxiter=5000
        )
    if not found.success:
        raise RuntimeError(f"ContactMechanics stopped at {found.nit} iterations: {found.message}; raise its cap")
    return np.asarray(found.jac) * (n / SIDE_MM) ** 2, time.perf_counter() - began


class PublishedSolver(NamedTuple):
    """A published solver: gap [N, N] mm, force N, tolerance → pressure [N, N] MPa, seconds; an oracle if `tight`."""

    name: str
    package: str
    solve: Callable[..., tuple[np.ndarray, float]]
    tight: float


PUBLISHED = {
    "half-space": PublishedSolver("Tamaas", "tamaas", tamaas_pressure, 1e-10),
    "layer": PublishedSolver("ContactMechanics", "ContactMechanics", contact_mechanics_pressure, 1e-8),
}
"""Kind of body → its published solver."""


def installed() -> dict[str, PublishedSolver]:
    """Kind of body → its published solver, if that can be imported."""
    return {body: solver for body, solver in PUBLISHED.items() if importlib.util.find_spec(solver.package) is not None}


def _rough_presses(count: int, grid: int, seed: int) -> list[tuple[np.ndarray, float]]:
    """Gaps [N, N] mm and forces N."""
    rng = np.random.default_rng(seed)
    return [(rough_sphere(rng, grid), float(np.exp(rng.uniform(np.log(0.5), np.log(10))))) for _ in range(count)]


def _bodies(grid: int) -> dict[str, np.ndarray]:
    """Periodic spectra [N, N//2 + 1], mm/MPa, of the half-space, G = 2 / (E* q) with G(0) = 0, and of the layer."""
    plane_modulus = GEL.modulus_mpa / (1 - GEL.poisson**2)
    q = np.hypot(*layer.wave_numbers(grid, SIDE_MM / grid))
    return {
        "half-space": np.divide(2, plane_modulus * q, out=np.zeros_like(q), where=q > 0),
        "layer": layer.normal_compliance(q, GEL),
    }


def _package_pressure(
    gap: np.ndarray, force: float, spectrum: np.ndarray, tolerance: float
) -> tuple[np.ndarray, float]:
    """Pressure by the package's solver, and the seconds that the solve took."""
    spacing = SIDE_MM / gap.shape[0]
    kernel, height = jnp.asarray(spectrum, jnp.float32), jnp.asarray(gap, jnp.float32)
    began = time.perf_counter()
    solved = contact.solve(height, force, kernel, jnp.zeros_like(kernel), spacing, tolerance)
    pressure = np.asarray(solved.pressure_mpa, np.float64)
    return pressure, time.perf_counter() - began


def _relative_error(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def _reference_pressure(gap: np.ndarray, force: float, spectrum: np.ndarray) -> np.ndarray:
    return solve_reference(gap, force, spectrum, SIDE_MM / gap.shape[0], 1e-9, 20_000).pressure_mpa
