"""The generator's flag for adhesion, compared with adhesive presses of spheres on the layered gels.

The generator takes the threshold of the flag from JKR's sphere on a half-space.  Here presses without adhesion are
solved on the layered gels and converted to presses with adhesion at equal contact areas (Ciavarella 2018), which
assumes no half-space; the flag must be set wherever adhesion widens the contact by more than the tolerance.
"""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.results import Table, named_table
from sensors_io import layer
from sensors_io.scenes import adhesion, contact, hertz, press
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.sensors import MODELS, SensorModel

RADII_MM = (5.0, 15.0, 40.0)
"""Radii of spheres, from the most curved to the flattest bodies of the generator."""

_FORCES = (5e-3, 3.0)  # of a press over that at which the flag stops: from below the pull-off of a half-space on
_RAMP = 28  # forces of a press, geometric
_SIDE = 2.5  # of the grid, over the contact's radius on a half-space, which is wider than on a layer
_DEGREE = 4  # of the polynomials in log δ that smooth a ramp
_TOLERANCE, _ITERATIONS = 1e-4, 400


def thresholds(grid: int, context: Context) -> list[dict[str, Any]]:
    """For every gel and radius: force up to which frames are flagged, and up to which adhesion matters, N; their ratio.

    Frames are missed where the ratio exceeds 1.
    """
    spheres = itertools.product(MODELS, RADII_MM)
    return [_threshold(sensor, radius, grid) for sensor, radius in context.each("adhesion", spheres)]


def threshold_table(rows: list[dict[str, Any]]) -> Table:
    """All thresholds."""
    config = SceneConfig()
    return named_table(
        "Adhesion: where it is flagged, and where it counts",
        rows,
        formats={"flagged below": ".3f", "counts below": ".3f", "counts over flagged": ".2f"},
        units={"flagged below": "N", "counts below": "N"},
        meanings={"flagged below": "by JKR's sphere on a half-space", "counts below": "on the gel's finite thickness"},
        note=f"Work of adhesion {config.adhesion_j_per_m2:g} J/m²; it counts where it widens the contact by more than "
        f"{config.adhesion_tolerance:.0%}.",
    )


def _threshold(sensor: SensorModel, radius_mm: float, grid: int) -> dict[str, Any]:
    config = SceneConfig()
    work = 1e-3 * config.adhesion_j_per_m2  # N/mm
    modulus = adhesion.plane_modulus_mpa(sensor.gel)
    sphere = adhesion.Adhesion(radius_mm=radius_mm, plane_modulus_mpa=modulus, work_n_per_mm=work)
    flagged = sphere.least_force_n(config.adhesion_tolerance)
    force, approach, area = _smooth(*_press(sensor, radius_mm, flagged * np.geomspace(*_FORCES, _RAMP), grid))
    stuck_force, _ = adhesion.adhesive_ramp(force, approach, area, work)
    stable = slice(int(np.argmin(stuck_force)), None)
    wider = np.sqrt(area[stable] / np.interp(stuck_force[stable], force, area)) - 1
    matters = (wider > config.adhesion_tolerance) & (stuck_force[stable] >= force[0])
    most = float(np.max(stuck_force[stable], where=matters, initial=0.0))
    return {
        "sensor and sphere": f"{sensor.name}, R = {radius_mm:g} mm",
        "flagged below": flagged,
        "counts below": most,
        "counts over flagged": most / flagged,
    }


def _press(
    sensor: SensorModel, radius_mm: float, force_n: np.ndarray, grid: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force, approach and contact area [K] of a press without adhesion, on a grid that its widest contact fills."""
    modulus = adhesion.plane_modulus_mpa(sensor.gel)
    widest = hertz.Hertz(radius_mm=radius_mm, plane_modulus_mpa=modulus, force_n=float(force_n[-1])).contact_radius_mm
    side = _SIDE * widest
    spacing = side / grid
    size = press.padded_size(grid, side, sensor.gel.thickness_mm)
    gel = jnp.asarray(layer.normal_compliance(np.hypot(*layer.wave_numbers(size, spacing)), sensor.gel), jnp.float32)
    x = (np.arange(grid) + 0.5) * spacing - side / 2
    gap = jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / (2 * radius_mm), jnp.float32)

    @jax.jit
    def touch(force: jax.Array) -> tuple[jax.Array, jax.Array]:
        solved = contact.solve(gap, force, gel, 0 * gel, spacing, _TOLERANCE, _ITERATIONS)
        return solved.approach_mm, _area_px(solved.pressure_mpa)

    approach, pixels = (np.asarray(a, float) for a in jax.lax.map(touch, jnp.asarray(force_n, jnp.float32)))
    return force_n, approach, pixels * spacing**2


def _area_px(pressure: jax.Array) -> jax.Array:
    """Area of a round contact, pixels, by the second moment of its pressure, which pixels blur less than its edge.

    a² = 5/2 · Σ p r² / Σ p, exact for p ∝ √(1 − r²/a²), Hertz; 17 % too small for the parabola of a thin layer.
    """
    n = pressure.shape[0]
    x = jnp.arange(n) - (n - 1) / 2
    second = jnp.sum(pressure * (x[None] ** 2 + x[:, None] ** 2)) / jnp.sum(pressure)
    return jnp.pi * 2.5 * second


def _smooth(force: np.ndarray, approach: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ramp on a fine grid of approaches, by polynomials of the logarithms."""
    at = np.geomspace(approach[0], approach[-1], 2000)
    fitted = (np.polynomial.Polynomial.fit(np.log(approach), np.log(y), _DEGREE) for y in (force, area))
    fine_force, fine_area = (np.exp(curve(np.log(at))) for curve in fitted)
    return fine_force, at, fine_area
