"""Random scenes for measuring contact solvers: gaps, forces, moduli, the spectra of one sensor, float64 solutions."""

import dataclasses
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sensors_io import layer
from sensors_io.scenes import objects, press, surface
from sensors_io.scenes.reference import convolve, solve_reference
from sensors_io.scenes.sensors import BODY, SensorModel

FORCES_N = (0.2, 20.0)
SHORTEST_WAVE_MM = 0.8
REFERENCE_TOLERANCE = 1e-8


class ContactScene(NamedTuple):
    """Gap [N, N] mm, force N, modulus MPa of the object."""

    gap_mm: np.ndarray
    force_n: np.ndarray
    modulus_mpa: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactScenes:
    """S scenes on one grid: gaps [S, N, N] mm, forces [S] N, moduli [S] MPa of the objects; float32."""

    gap_mm: np.ndarray
    force_n: np.ndarray
    modulus_mpa: np.ndarray

    def __len__(self) -> int:
        return len(self.force_n)

    def __iter__(self) -> Iterator[ContactScene]:
        return map(ContactScene, self.gap_mm, self.force_n, self.modulus_mpa)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelKernels:
    """Float64 spectra of a sensor's gel and of an object of 1 MPa [M, M//2 + 1], mm/MPa, and the pixel size."""

    gel: np.ndarray
    body: np.ndarray
    spacing_mm: float
    thickness_mm: float


def gel_kernels(sensor: SensorModel, grid: int) -> GelKernels:
    """The kernels of a sensor on its padded grid."""
    spacing = sensor.window_mm / grid
    q = np.hypot(*layer.wave_numbers(press.padded_size(grid, sensor.window_mm, sensor.gel.thickness_mm), spacing))
    return GelKernels(
        gel=layer.normal_compliance(q, sensor.gel),
        body=layer.normal_compliance(q, BODY),
        spacing_mm=spacing,
        thickness_mm=sensor.gel.thickness_mm,
    )


def sample(sensor: SensorModel, count: int, grid: int, seed: int) -> ContactScenes:
    """Draw scenes: a procedural object each, a pose near the apex, a log-uniform force.

    The draws do not depend on the grid, so the same seed gives the same scenes on every grid.
    """
    rng = np.random.default_rng(seed)
    x = jnp.asarray((np.arange(grid) + 0.5) * sensor.window_mm / grid - sensor.window_mm / 2, jnp.float32)
    gaps, forces, moduli = [], [], []
    for _ in range(count):
        solid = objects.sample(rng, 0.0, SHORTEST_WAVE_MM)
        skin = surface.make_skin(solid, rng.uniform(-2, 2, 2), 1.0)
        pose = surface.Pose(
            offset_mm=jnp.asarray(rng.uniform(-1, 1, 2), jnp.float32),
            turn_rad=jnp.float32(rng.uniform(0, 2 * np.pi)),
            tilt=jnp.asarray(rng.normal(0, 0.01, 2), jnp.float32),
        )
        gaps.append(np.asarray(_gap(skin, pose, x)))
        forces.append(np.exp(rng.uniform(*np.log(FORCES_N))))
        moduli.append(solid.modulus_mpa)
    return ContactScenes(
        gap_mm=np.stack(gaps), force_n=np.array(forces, np.float32), modulus_mpa=np.array(moduli, np.float32)
    )


def exact(scenes: Iterable[ContactScene], kernels: GelKernels) -> np.ndarray:
    """Float64 displacement of the gel on the same grid, [S, N, N] mm."""
    found = []
    for gap, force, modulus in scenes:
        compliance = kernels.gel + kernels.body / float(modulus)
        solved = solve_reference(
            gap.astype(np.float64), float(force), compliance, kernels.spacing_mm, REFERENCE_TOLERANCE, 20_000
        )
        found.append(convolve(solved.pressure_mpa, kernels.gel))
    return np.stack(found)


def displacement_error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Relative L₂ error of each scene's displacement, [S]."""
    return _relative(np.asarray(found, np.float64), np.asarray(true, np.float64))


def slope_error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Relative L₂ error of each scene's surface slope, [S]: what a photometric sensor sees."""
    slopes = lambda field: np.stack([np.gradient(np.asarray(field, np.float64), axis=axis) for axis in (1, 2)], -1)
    return _relative(slopes(found), slopes(true))


def _relative(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    norm = lambda field: np.linalg.norm(field.reshape(len(field), -1), axis=1)
    return norm(found - true) / norm(true)


_gap = jax.jit(surface.gap)
