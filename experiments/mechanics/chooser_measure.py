"""Time and error of every setting of the chooser's menu on random scenes.

The error of a setting is that of its displacement, interpolated by cubic splines to the reference's grid and averaged
to half of it, by a solution on a finer grid than any setting's, with more padding.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.ndimage import zoom

from experiments.core.timing import interleaved
from experiments.mechanics.chooser_draw import SceneBatch
from sensors_io import layer
from sensors_io.scenes import chooser, contact, nested
from sensors_io.scenes.batching import chunks, gather, map_live
from sensors_io.scenes.chooser import ContactScene
from sensors_io.scenes.chooser_law import Setting, Survey
from sensors_io.scenes.sensors import BODY, SensorModel

REFERENCE_PADDING = 2.5
"""Side of the reference's padded grid over that of its window: more than any setting's."""

REFERENCE_TOLERANCE = 1e-4
"""Makes slopes exact to about 1e-3; float32 carries little further."""

ROUNDS = 3
"""Visits of every call whose time is taken; the median counts."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MenuMeasurements:
    """Measurements of S scenes in B batches under T settings, each solved from scratch.

    Features [S, K] and lengths [S] of the surveys; errors [S, T], the greater of displacement's and slope's; ms a scene
    of every setting, [B, T].
    """

    features: np.ndarray
    radius_mm: np.ndarray
    slope_share: np.ndarray
    window_mm: np.ndarray
    thickness_mm: np.ndarray
    errors: np.ndarray
    ms: np.ndarray
    family: tuple[str, ...]

    @property
    def survey(self) -> Survey:
        """The surveys, stacked."""
        return Survey(**{f.name: jnp.asarray(getattr(self, f.name), jnp.float32) for f in dataclasses.fields(Survey)})

    def to_json(self) -> dict[str, Any]:
        """Lists of numbers."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: v.tolist() if isinstance(v, np.ndarray) else list(v) for name, v in fields.items()}


def join(parts: Sequence[Mapping[str, Any]]) -> MenuMeasurements:
    """The outcomes of several batches, each as `Outcomes.to_json` gives it."""
    arrays = {name: np.concatenate([np.asarray(p[name]) for p in parts]) for name in parts[0] if name != "family"}
    return MenuMeasurements(family=tuple(f for p in parts for f in p["family"]), **arrays)


def stage_of(sensor: SensorModel) -> ContactScene:
    """Where a sensor's contacts take place."""
    return ContactScene(gel=sensor.gel, body=BODY, window_mm=sensor.window_mm)


def measure(batch: SceneBatch, menu: Iterable[Setting], true: Array) -> MenuMeasurements:
    """Errors and times of all settings."""
    everything = np.arange(len(batch.force_n))
    errors, ms = [], []
    for setting in menu:
        call = functools.partial(from_scratch, batch, setting, everything)
        errors.append(errors_of(call(), true))
        ms.append(1e3 * np.median(interleaved({"": call}, range(ROUNDS))[""]) / len(everything))
    seen = chooser.look(1.0, batch.gaps, batch.force_n, batch.modulus_mpa, stage_of(batch.sensor)).survey
    surveys = {f.name: np.asarray(getattr(seen, f.name)) for f in dataclasses.fields(Survey)}
    return MenuMeasurements(errors=np.stack(errors, 1), ms=np.array([ms]), family=batch.family, **surveys)


def reference(batch: SceneBatch, grid: int) -> Array:
    """Displacement on half the reference's grid, [S, K, K]."""
    setting = Setting(grid=grid, padded=round(grid * REFERENCE_PADDING), tolerance=REFERENCE_TOLERANCE)
    return jax.vmap(lambda u: nested.coarsen(u, 2))(from_scratch(batch, setting, np.arange(len(batch.force_n))))


def from_scratch(batch: SceneBatch, setting: Setting, rows: np.ndarray) -> np.ndarray:
    """Displacement of some scenes under one setting, [R, n, n]."""
    spacing = batch.sensor.window_mm / setting.grid
    gel, body = _spectra(batch.sensor, setting.padded, spacing)
    parts = []
    for chunk, live in chunks(rows):
        given = (batch.gaps(setting.grid, chunk), batch.force_n[chunk], batch.modulus_mpa[chunk])
        parts.append(_solve_all(live, given, gel, body, spacing, setting.tolerance))
    return np.asarray(gather(parts, len(rows)))


def errors_of(found: Array | np.ndarray, true: Array) -> np.ndarray:
    """The greater of the relative L₂ errors of displacement and slope, [S]."""
    return np.asarray(_errors(found, _resampling(found.shape[-1], 2 * true.shape[-1]), true)).max(-1)


@jax.jit
def _solve_all(
    live: Array, given: tuple[Array, Array, Array], gel: Array, body: Array, spacing_mm: float, tolerance: float
) -> Array:
    def solve(scene: tuple[Array, Array, Array]) -> Array:
        gap, force, modulus = scene
        return contact.solve(gap, force, gel, body / modulus, spacing_mm, tolerance).displacement_mm

    return map_live(solve, live, given)


@functools.lru_cache(maxsize=256)
def _spectra(sensor: SensorModel, padded: int, spacing_mm: float) -> tuple[Array, Array]:
    q = np.hypot(*layer.wave_numbers(padded, spacing_mm))
    gel, body = (layer.normal_compliance(q, b) for b in (sensor.gel, BODY))
    return jnp.asarray(gel, jnp.float32), jnp.asarray(body, jnp.float32)


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
