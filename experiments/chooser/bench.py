"""What every setting of the chooser's menu costs and how far it is off, over random scenes on all four gels.

The error of a setting is that of its displacement, interpolated by cubic splines to the reference's grid and averaged
to half of it, by the solution on the finest grid with twice the window as padding.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.ndimage import zoom

from experiments.contact.scenes import FORCES_N, SHORTEST_WAVE_MM
from sensors_io.scenes import chooser, contact, layer, nested, objects, surface
from sensors_io.scenes.chooser import LOOK_GRID, Setting
from sensors_io.scenes.objects import Solid
from sensors_io.scenes.sensors import BODY, SensorModel

FINE_GRID = 384
"""The gap is evaluated here and averaged to every grid of the menu."""

REFERENCE_TOLERANCE = 1e-4
"""Makes slopes exact to about 1e-3; float32 carries little further."""


def _as_drawn(rng: np.random.Generator, solid: Solid) -> Solid:
    return solid


def _ball(rng: np.random.Generator, solid: Solid) -> Solid:
    """Smooth, of one radius."""
    radius = float(np.exp(rng.uniform(np.log(3), np.log(30))))
    return dataclasses.replace(_rescaled(solid, 1e-5, 0.0), radius_1_mm=radius, radius_2_mm=radius)


def _cylinder(rng: np.random.Generator, solid: Solid) -> Solid:
    """Curved one way only."""
    return dataclasses.replace(_rescaled(solid, 1e-5, 0.0), radius_1_mm=rng.uniform(3, 20), radius_2_mm=1e4)


def _rough(rng: np.random.Generator, solid: Solid) -> Solid:
    """A nearly flat, very rough body."""
    flat = dataclasses.replace(solid, radius_1_mm=rng.uniform(40, 200), radius_2_mm=rng.uniform(40, 200))
    return _rescaled(flat, rng.uniform(0.04, 0.16), 0.0)


def _fine_pattern(rng: np.random.Generator, solid: Solid) -> Solid:
    """Steep features, closer than any drawn."""
    close = dataclasses.replace(solid, feature_pitch_mm=rng.uniform(1.5, 2.5))
    return _rescaled(close, 5e-3, rng.uniform(0.1, 0.6))


def _rescaled(solid: Solid, rms_mm: float, height_mm: float) -> Solid:
    waves = (solid.wave_amplitudes_mm * (rms_mm / solid.rms_mm)).astype(np.float32)
    return dataclasses.replace(solid, rms_mm=rms_mm, wave_amplitudes_mm=waves, feature_height_mm=height_mm)


FAMILIES: Mapping[str, Callable[[np.random.Generator, Solid], Solid]] = {
    "generator": _as_drawn,
    "balls": _ball,
    "cylinders": _cylinder,
    "rough flats": _rough,
    "fine patterns": _fine_pattern,
}
"""Kinds of objects: those that the generator draws, and departures from them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Batch:
    """S scenes on one gel: gaps [S, n, n] mm by the side n, forces [S] N, moduli [S] MPa, families [S]."""

    sensor: SensorModel
    gap_mm: Mapping[int, np.ndarray]
    force_n: np.ndarray
    modulus_mpa: np.ndarray
    family: tuple[str, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcomes:
    """What was measured of S scenes in B batches under T settings.

    Features [S, K] and lengths [S] of the surveys; errors [S, T, 2] of displacement and slope; ms a scene of every
    setting [B, T] and of the look [B].
    """

    features: np.ndarray
    radius_mm: np.ndarray
    window_mm: np.ndarray
    thickness_mm: np.ndarray
    errors: np.ndarray
    ms: np.ndarray
    look_ms: np.ndarray
    family: tuple[str, ...]

    @property
    def survey(self) -> chooser.Survey:
        """The surveys, stacked."""
        return chooser.Survey(
            features=jnp.asarray(self.features),
            radius_mm=jnp.asarray(self.radius_mm),
            window_mm=jnp.asarray(self.window_mm),
            thickness_mm=jnp.asarray(self.thickness_mm),
        )

    def to_json(self) -> dict[str, Any]:
        """Lists of numbers."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: v.tolist() if isinstance(v, np.ndarray) else list(v) for name, v in fields.items()}


def join(parts: Sequence[Mapping[str, Any]]) -> Outcomes:
    """The outcomes of several batches, each as `Outcomes.to_json` gives it."""
    arrays = {name: np.concatenate([np.asarray(p[name]) for p in parts]) for name in parts[0] if name != "family"}
    return Outcomes(family=tuple(f for p in parts for f in p["family"]), **arrays)


def draw(
    sensor: SensorModel, count: int, grids: Sequence[int], reference: int, families: Sequence[str], seed: int
) -> Batch:
    """Draw scenes: an object of each family in turn, a pose near the apex, a log-uniform force."""
    rng = np.random.default_rng(seed)
    fine, finest = (_centres(n, sensor.window_mm) for n in (FINE_GRID, reference))
    sides = tuple(sorted({*grids, LOOK_GRID}))
    family = tuple(families[i % len(families)] for i in range(count))
    gaps, forces, moduli = [], [], []
    for name in family:
        solid = FAMILIES[name](rng, objects.sample(rng, 0.0, SHORTEST_WAVE_MM))
        skin = surface.make_skin(solid, rng.uniform(-2, 2, 2), 1.0)
        pose = surface.Pose(
            offset_mm=jnp.asarray(rng.uniform(-1, 1, 2), jnp.float32),
            turn_rad=jnp.float32(rng.uniform(0, 2 * np.pi)),
            tilt=jnp.asarray(rng.normal(0, 0.01, 2), jnp.float32),
        )
        gaps.append(jax.device_get(_gaps(skin, pose, fine, finest, sides)))
        forces.append(np.exp(rng.uniform(*np.log(FORCES_N))))
        moduli.append(solid.modulus_mpa)
    return Batch(
        sensor=sensor,
        gap_mm={n: np.stack([g[n] for g in gaps]) for n in gaps[0]},
        force_n=np.array(forces, np.float32),
        modulus_mpa=np.array(moduli, np.float32),
        family=family,
    )


def measure(batch: Batch, menu: tuple[Setting, ...], reference: int) -> Outcomes:
    """Errors and times of all settings; compiles each program before it is timed."""
    true = jax.block_until_ready(_reference(batch, reference))  # else its time is the first setting's
    errors, ms = [], []
    for setting in menu:
        _compile(setting.grid, setting.padded, len(batch.force_n))
        _spectra(batch.sensor, setting.padded, batch.sensor.window_mm / setting.grid)
        displacement, seconds = _timed(functools.partial(_solve, batch, setting))
        ms.append(1e3 * seconds / len(batch.force_n))
        errors.append(np.asarray(_errors(displacement, _resampling(setting.grid, reference), true)))
    _look(batch)
    survey, seconds = _timed(functools.partial(_look, batch))
    return Outcomes(
        features=np.asarray(survey.features),
        radius_mm=np.asarray(survey.radius_mm),
        window_mm=np.asarray(survey.window_mm),
        thickness_mm=np.asarray(survey.thickness_mm),
        errors=np.stack(errors, 1),
        ms=np.array([ms]),
        look_ms=np.array([1e3 * seconds / len(batch.force_n)]),
        family=batch.family,
    )


def _centres(grid: int, window_mm: float) -> Array:
    return jnp.asarray((np.arange(grid) + 0.5) * window_mm / grid - window_mm / 2, jnp.float32)


@functools.partial(jax.jit, static_argnames="sides")
def _gaps(skin: surface.Skin, pose: surface.Pose, fine: Array, finest: Array, sides: tuple[int, ...]) -> dict:
    gap = surface.gap(skin, pose, fine)
    coarse = {n: nested.coarsen(gap, gap.shape[0] // n) for n in sides}
    return coarse | {finest.shape[0]: surface.gap(skin, pose, finest)}


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and the processor's seconds that it took: another process's load does not count."""
    began = time.process_time()
    found = jax.block_until_ready(call())
    return found, time.process_time() - began


@functools.cache
def _compile(grid: int, padded: int, count: int) -> None:
    """Compile the program of a setting: a flat body, at a tolerance that the first guess keeps."""
    scenes = (jnp.zeros((count, grid, grid)), jnp.ones(count), jnp.ones(count))
    spectrum = jnp.ones((padded, padded // 2 + 1))
    jax.block_until_ready(_solve_all(scenes, spectrum, spectrum, 1.0, 1e9))


def _reference(batch: Batch, reference: int) -> Array:
    """Displacement on half the reference's grid, [S, K, K]."""
    setting = Setting(grid=reference, padded=2 * reference, tolerance=REFERENCE_TOLERANCE)
    return jax.vmap(lambda u: nested.coarsen(u, 2))(_solve(batch, setting))


def _solve(batch: Batch, setting: Setting) -> Array:
    """Displacement of every scene."""
    spacing = batch.sensor.window_mm / setting.grid
    gel, body = _spectra(batch.sensor, setting.padded, spacing)
    scenes = (batch.gap_mm[setting.grid], batch.force_n, batch.modulus_mpa)
    return _solve_all(scenes, gel, body, spacing, setting.tolerance)


@jax.jit
def _solve_all(scenes: tuple[Array, Array, Array], gel: Array, body: Array, spacing: Array, tolerance: Array) -> Array:
    def solve(scene: tuple[Array, Array, Array]) -> Array:
        gap, force, modulus = scene
        return contact.solve(gap, force, gel, body / modulus, spacing, tolerance).displacement_mm

    return jax.lax.map(solve, scenes)


@functools.lru_cache(maxsize=256)
def _spectra(sensor: SensorModel, padded: int, spacing_mm: float) -> tuple[Array, Array]:
    q = np.hypot(*layer.wave_numbers(padded, spacing_mm))
    gel, body = (layer.normal_compliance(q, b) for b in (sensor.gel, BODY))
    return jnp.asarray(gel, jnp.float32), jnp.asarray(body, jnp.float32)


def _look(batch: Batch) -> chooser.Survey:
    """Survey, promises and choice of every scene: all that choosing takes."""
    spectra = tuple(chooser.look_compliance(b, batch.sensor.window_mm) for b in (batch.sensor.gel, BODY))
    scenes = (batch.gap_mm[LOOK_GRID], batch.force_n, batch.modulus_mpa)
    return _look_all(scenes, spectra, batch.sensor.window_mm, batch.sensor.gel.thickness_mm)[0]


@jax.jit
def _look_all(
    scenes: tuple[Array, Array, Array], spectra: tuple[Array, Array], window_mm: float, thickness_mm: float
) -> tuple[chooser.Survey, Array]:
    def look(gap: Array, force: Array, modulus: Array) -> tuple[chooser.Survey, Array]:
        seen = chooser.survey(gap, force, spectra[0], spectra[1] / modulus, window_mm, thickness_mm)
        return seen, chooser.pick(0.05, chooser.promise(seen))[0]

    return jax.vmap(look)(*scenes)


@functools.lru_cache(maxsize=32)
def _resampling(grid: int, reference: int) -> np.ndarray:
    """Matrix [K, n] from a grid to half the reference's: cubic splines, then means of two."""
    up = zoom(np.eye(grid), (reference / grid, 1), order=3, mode="nearest", grid_mode=True)
    return up.reshape(reference // 2, 2, grid).mean(1).astype(np.float32)


@jax.jit
def _errors(found: Array, resampling: Array, true: Array) -> Array:
    """Relative L₂ errors of displacement and slope, [S, 2]."""
    off = resampling @ found @ resampling.T - true
    norm = lambda field: jnp.sqrt(jnp.sum(field**2, (1, 2)))
    slope_norm = lambda field: jnp.sqrt(sum(norm(jnp.gradient(field, axis=axis)) ** 2 for axis in (1, 2)))
    return jnp.stack([norm(off) / norm(true), slope_norm(off) / slope_norm(true)], 1)
