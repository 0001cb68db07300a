"""Scenes for contact solvers, with exact solutions: random presses, rough spheres, known failure cases."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

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

SIDE_MM = 16.0
GEL = layer.Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
"""Window and gel of the rough spheres and of the failure cases."""


class ContactScenes(NamedTuple):
    """S scenes on one grid: gaps [S, N, N] mm, forces [S] N, moduli [S] MPa of the objects; float32."""

    gap_mm: np.ndarray
    force_n: np.ndarray
    modulus_mpa: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelKernels:
    """Float64 spectra of a gel and of an object of 1 MPa [M, M//2 + 1], mm/MPa; pixel size; thickness of the gel."""

    gel: np.ndarray
    body: np.ndarray
    spacing_mm: float
    thickness_mm: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class FailureCase:
    """A rigid body on a gel; `must_flag`: small-strain theory does not hold here, so the solver must flag the frame."""

    name: str
    gap_mm: np.ndarray
    force_n: float
    gel: layer.Layer = GEL
    must_flag: bool = False

    def kernels(self) -> GelKernels:
        """Kernels of this gel on a grid padded to one and a half times its side."""
        grid = self.gap_mm.shape[0]
        spacing = SIDE_MM / grid
        gel = layer.normal_compliance(np.hypot(*layer.wave_numbers(grid * 3 // 2, spacing)), self.gel)
        return GelKernels(gel=gel, body=np.zeros_like(gel), spacing_mm=spacing, thickness_mm=self.gel.thickness_mm)


def normal_compliances(sensor: SensorModel, padded: int, spacing_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Spectra [M, M//2 + 1] of a sensor's gel and of an object of 1 MPa, mm/MPa."""
    q = np.hypot(*layer.wave_numbers(padded, spacing_mm))
    return layer.normal_compliance(q, sensor.gel), layer.normal_compliance(q, BODY)


def gel_kernels(sensor: SensorModel, grid: int) -> GelKernels:
    """Kernels of a sensor on its padded grid."""
    spacing, thickness = sensor.window_mm / grid, sensor.gel.thickness_mm
    gel, body = normal_compliances(sensor, press.padded_size(grid, sensor.window_mm, thickness), spacing)
    return GelKernels(gel=gel, body=body, spacing_mm=spacing, thickness_mm=thickness)


def draw_press(rng: np.random.Generator, solid: objects.Solid) -> tuple[surface.Skin, surface.SensorPose, float]:
    """Skin of the object, a pose near its apex and a log-uniform force, N."""
    skin = surface.make_skin(solid, rng.uniform(-2, 2, 2), 1.0)
    pose = surface.SensorPose(
        offset_mm=jnp.asarray(rng.uniform(-1, 1, 2), jnp.float32),
        turn_rad=jnp.float32(rng.uniform(0, 2 * np.pi)),
        tilt=jnp.asarray(rng.normal(0, 0.01, 2), jnp.float32),
    )
    return skin, pose, np.exp(rng.uniform(*np.log(FORCES_N)))


def sample_scenes(sensor: SensorModel, count: int, grid: int, seed: int) -> ContactScenes:
    """Draw presses of procedural objects; the same seed gives the same scenes on every grid."""
    rng = np.random.default_rng(seed)
    x = jnp.asarray((np.arange(grid) + 0.5) * sensor.window_mm / grid - sensor.window_mm / 2, jnp.float32)
    gap_of = jax.jit(surface.gap)
    gaps, forces, moduli = [], [], []
    for _ in range(count):
        solid = objects.sample(rng, 0.0, SHORTEST_WAVE_MM)
        skin, pose, force = draw_press(rng, solid)
        gaps.append(np.asarray(gap_of(skin, pose, x)))
        forces.append(force)
        moduli.append(solid.modulus_mpa)
    return ContactScenes(np.stack(gaps), np.array(forces, np.float32), np.array(moduli, np.float32))


def exact(scenes: Iterable[tuple[np.ndarray, ...]], kernels: GelKernels) -> np.ndarray:
    """Float64 displacement [S, N, N] mm of the gel on the same grid, for the gap, force and modulus of each scene."""
    found = []
    for gap, force, modulus in scenes:
        compliance = kernels.gel + kernels.body / float(modulus)
        solved = solve_reference(
            gap.astype(np.float64), float(force), compliance, kernels.spacing_mm, REFERENCE_TOLERANCE, 20_000
        )
        found.append(convolve(solved.pressure_mpa, kernels.gel))
    return np.stack(found)


def batch_solver(solve: Callable[..., Any], scenes: ContactScenes, kernels: GelKernels) -> Callable[[], Any]:
    """A compiled call that solves all scenes one after the other and stacks the results.

    `solve` maps gap [N, N] mm, force N, compliance of the gel and of the object [M, M//2 + 1] mm/MPa to arrays.
    """
    gel, body = jnp.asarray(kernels.gel, jnp.float32), jnp.asarray(kernels.body, jnp.float32)
    inputs = jax.tree.map(jnp.asarray, scenes)

    def solve_one(scene: ContactScenes) -> Any:
        return solve(scene.gap_mm, scene.force_n, gel, body / scene.modulus_mpa)

    compiled = jax.jit(lambda scenes: jax.lax.map(solve_one, scenes))
    return lambda: compiled(inputs)


def displacement_error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Relative L₂ error of each scene's displacement, [S]."""
    norm = lambda field: np.linalg.norm(field.reshape(len(field), -1), axis=1)
    found, true = np.asarray(found, np.float64), np.asarray(true, np.float64)
    return norm(found - true) / norm(true)


def slope_error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Relative L₂ error of each scene's surface slope, which a photometric sensor sees, [S]."""
    slopes = lambda field: np.stack([np.gradient(np.asarray(field, np.float64), axis=axis) for axis in (1, 2)], -1)
    return displacement_error(slopes(found), slopes(true))


# Shapes on the 16 mm window ------------------------------------------------------------------------------------------


def pixel_centres(grid: int) -> np.ndarray:
    """Coordinates of the pixels along one side of the window, [N] mm."""
    return (np.arange(grid) + 0.5) * SIDE_MM / grid - SIDE_MM / 2


def rough_sphere(rng: np.random.Generator, grid: int) -> np.ndarray:
    """Gap of a sphere with self-affine roughness, [N, N] mm."""
    x = pixel_centres(grid)
    k, a, phase = (v.astype(np.float64) for v in objects.rough_waves(rng, rng.uniform(0.01, 0.06), 5 * SIDE_MM / grid))
    angle = k[:, 0, None, None] * x[None] + k[:, 1, None, None] * x[:, None] + phase[:, None, None]
    return (x[None] ** 2 + x[:, None] ** 2) / rng.uniform(20, 60) + np.sum(a[:, None, None] * np.cos(angle), 0)


def failure_suite(grid: int) -> tuple[FailureCase, ...]:
    """Scenes at which contact solvers are known to fail: overflow, cycling, empty contacts, broken assumptions.

    Kernel overflow is that of sinh(qh) in float32, at qh > 88: the finest wave of a thick gel.  4 divides the grid.
    """
    x, half = pixel_centres(grid), grid // 2
    r2 = x[None] ** 2 + x[:, None] ** 2
    noise = np.random.default_rng(0).standard_normal((grid, grid))
    dimple = r2 / (2 * 1e3 * (2 * SIDE_MM / grid) ** 3)  # a dozen pixels at 1 mN, so flat that the gel hardly dents
    needle = np.full((grid, grid), 5.0)  # of 2 × 2 pixels, next to a flat shoulder 0.6 mm higher up, which just touches
    needle[:, : half - 4] = 0.6
    needle[half - 1 : half + 1, half + 4 : half + 6] = 0.0
    cap = 0.5 - np.sqrt(np.maximum(0.5**2 - r2, 0))
    pin = np.where(r2 < 0.5**2, cap, 0.5 + 3 * (np.sqrt(r2) - 0.5))  # a hemisphere on a steep cone
    gel = lambda **changes: dataclasses.replace(GEL, **changes)
    case = lambda name, gap_mm, force_n, **rest: FailureCase(name=name, gap_mm=gap_mm, force_n=force_n, **rest)
    return (
        case("kernel overflow: h = 40 mm", r2 / 16, 5.0, gel=gel(thickness_mm=40.0)),
        case("a few pixels at 1 mN", r2 / 16, 1e-3, must_flag=True),
        case("a dozen pixels at 1 mN", dimple, 1e-3),
        case("needle next to a shoulder", needle, 2.0),
        case("rough flat, 75 % contact", _waves(x, 0.03), 15.0),
        case("full pad", np.zeros((grid, grid)), 5.0),
        case("white noise", 0.1 * noise, 5.0),
        case("ν = 0.4999", r2 / 16, 5.0, gel=gel(poisson=0.4999)),
        case("ν = 0.5", r2 / 16, 5.0, gel=gel(poisson=0.5)),
        case("h = 0.3 mm", r2 / 16, 5.0, gel=gel(thickness_mm=0.3), must_flag=True),
        case("tilt", r2 / 60 + 0.2 * x[None], 5.0),
        case("E = 0.01 MPa", r2 / 16, 1.0, gel=gel(modulus_mpa=0.01), must_flag=True),
        case("sphere at 20 N, strain > 0.3", r2 / 8, 20.0, must_flag=True),
        case("pin R 0.5 mm at 5 N", pin, 5.0, must_flag=True),
    )


def _waves(x: np.ndarray, rms_mm: float) -> np.ndarray:
    """A flat with sixty waves between 4 and 0.9 mm."""
    rng = np.random.default_rng(3)
    q, angle, phase = rng.uniform(1.6, 7.0, 60), rng.uniform(0, 2 * np.pi, 60), rng.uniform(0, 2 * np.pi, 60)
    along = np.cos(angle)[:, None, None] * x[None, None] + np.sin(angle)[:, None, None] * x[None, :, None]
    height = np.cos(q[:, None, None] * along + phase[:, None, None]).sum(0)
    return height / height.std() * rms_mm
