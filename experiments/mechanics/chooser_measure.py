"""Random scenes for the chooser, and time and error of every setting of its menu on them.

The error of a setting is that of its displacement, interpolated by cubic splines to the reference's grid and averaged
to half of it, compared with a solution on a finer grid than any setting's and with more padding.
"""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.ndimage import zoom

from experiments.core.timing import interleaved
from experiments.mechanics.contact_scenes import SHORTEST_WAVE_MM, draw_press, normal_compliances
from sensors_io.scenes import chooser, contact, nested, objects, surface
from sensors_io.scenes.batching import chunks, gather, map_live
from sensors_io.scenes.chooser import LOOK_GRIDS, ContactScene
from sensors_io.scenes.chooser_law import Setting, Survey
from sensors_io.scenes.objects import Solid
from sensors_io.scenes.sensors import BODY, SensorModel

REFERENCE_GRID = 384
"""Side of the reference's grid: twice that of the finest setting."""

REFERENCE_PADDING = 2.5
"""Side of the reference's padded grid over that of its window: more than any setting's."""

REFERENCE_TOLERANCE = 1e-4
"""Makes slopes exact to about 1e-3; float32 carries little further."""

ROUNDS = 3
"""Timed rounds of every call; the median counts."""

Saved = TypeVar("Saved")


def join(kind: type[Saved], parts: Sequence[Mapping[str, Any]]) -> Saved:
    """One record of several saved batches: arrays are concatenated, scalars are those of the first batch."""
    joined = lambda values: np.concatenate([np.asarray(v) for v in values]) if np.ndim(values[0]) else values[0]
    return kind(**{name: joined([part[name] for part in parts]) for name in parts[0]})


# Scenes --------------------------------------------------------------------------------------------------------------


FAMILIES = ("generator", "balls", "cylinders", "rough flats", "fine patterns")
"""Kinds of objects: those that the generator draws, and departures from them."""


def _in_family(family: str, rng: np.random.Generator, solid: Solid) -> Solid:
    """The drawn object, or one of the family that has its other properties."""
    radii, pitch, rms, height = (solid.radius_1_mm, solid.radius_2_mm), solid.feature_pitch_mm, 1e-5, 0.0
    if family == "generator":
        return solid
    if family == "balls":
        radii = (float(np.exp(rng.uniform(np.log(3), np.log(30)))),) * 2
    elif family == "cylinders":
        radii = (rng.uniform(3, 20), 1e4)
    elif family == "rough flats":
        radii, rms = (rng.uniform(40, 200), rng.uniform(40, 200)), rng.uniform(0.04, 0.16)
    else:  # steep features, closer than any drawn
        pitch, rms, height = rng.uniform(1.5, 2.5), 5e-3, rng.uniform(0.1, 0.6)
    return dataclasses.replace(
        solid,
        radius_1_mm=radii[0],
        radius_2_mm=radii[1],
        feature_pitch_mm=pitch,
        feature_height_mm=height,
        rms_mm=rms,
        wave_amplitudes_mm=(solid.wave_amplitudes_mm * (rms / solid.rms_mm)).astype(np.float32),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneBatch:
    """S scenes on one gel: gaps [S, n, n] mm by the side n, forces [S] N, moduli [S] MPa, families [S]."""

    sensor: SensorModel
    gap_mm: Mapping[int, np.ndarray]
    force_n: np.ndarray
    modulus_mpa: np.ndarray
    family: np.ndarray

    @property
    def stage(self) -> ContactScene:
        """Gel, object and window of the contacts."""
        return ContactScene(gel=self.sensor.gel, body=BODY, window_mm=self.sensor.window_mm)

    def gaps(self, grid: int, rows: np.ndarray) -> np.ndarray:
        """Gaps of some scenes on one grid, in the form that `chooser.solve_many` takes."""
        return self.gap_mm[grid][rows]


def draw(sensor: SensorModel, count: int, grids: Iterable[int], seed: int) -> SceneBatch:
    """Draw scenes: an object of each family in turn, a pose near the apex, a log-uniform force.

    Gaps are evaluated on the reference's grid and averaged to all coarser ones, whose sides must divide its own.
    """
    rng, n = np.random.default_rng(seed), REFERENCE_GRID
    x = jnp.asarray((np.arange(n) + 0.5) * sensor.window_mm / n - sensor.window_mm / 2, jnp.float32)
    sides = tuple(sorted({*grids, *LOOK_GRIDS, n}))
    family = np.array([FAMILIES[i % len(FAMILIES)] for i in range(count)])
    gaps, forces, moduli = [], [], []
    for name in family:
        solid = _in_family(name, rng, objects.sample(rng, 0.0, SHORTEST_WAVE_MM))
        skin, pose, force = draw_press(rng, solid)
        gaps.append(jax.device_get(_gaps(skin, pose, x, sides)))
        forces.append(force)
        moduli.append(solid.modulus_mpa)
    return SceneBatch(
        sensor=sensor,
        gap_mm={n: np.stack([g[n] for g in gaps]) for n in sides},
        force_n=np.array(forces, np.float32),
        modulus_mpa=np.array(moduli, np.float32),
        family=family,
    )


@functools.partial(jax.jit, static_argnames="sides")
def _gaps(skin: surface.Skin, pose: surface.SensorPose, x_mm: Array, sides: tuple[int, ...]) -> dict[int, Array]:
    gap = surface.gap(skin, pose, x_mm)
    return {n: nested.coarsen(gap, gap.shape[0] // n) for n in sides}


# Measurement ---------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class MenuMeasurements:
    """Measurements of S scenes in B batches under T settings, each solved from scratch.

    Features [S, K] and lengths [S] of the surveys; errors [S, T], the greater of displacement's and slope's; ms a scene
    of every setting, [B, T]; families [S].
    """

    features: np.ndarray
    radius_mm: np.ndarray
    slope_share: np.ndarray
    window_mm: np.ndarray
    thickness_mm: np.ndarray
    errors: np.ndarray
    ms: np.ndarray
    family: np.ndarray

    @property
    def survey(self) -> Survey:
        """The surveys, stacked."""
        return Survey(**{f.name: jnp.asarray(getattr(self, f.name), jnp.float32) for f in dataclasses.fields(Survey)})


def measure(batch: SceneBatch, menu: Iterable[Setting], true: Array) -> MenuMeasurements:
    """Errors and times of all settings."""
    everything = np.arange(len(batch.force_n))
    errors, ms = [], []
    for setting in menu:
        call = functools.partial(from_scratch, batch, setting, everything)
        errors.append(errors_of(call(), true))
        ms.append(1e3 * np.median(interleaved({"": call}, range(ROUNDS))[""]) / len(everything))
    seen = chooser.look(1.0, batch.gaps, batch.force_n, batch.modulus_mpa, batch.stage).survey
    surveys = {f.name: np.asarray(getattr(seen, f.name)) for f in dataclasses.fields(Survey)}
    return MenuMeasurements(errors=np.stack(errors, 1), ms=np.array([ms]), family=batch.family, **surveys)


def reference(batch: SceneBatch) -> Array:
    """Displacement on half the reference's grid, [S, K, K]."""
    padded = round(REFERENCE_GRID * REFERENCE_PADDING)
    setting = Setting(grid=REFERENCE_GRID, padded=padded, tolerance=REFERENCE_TOLERANCE)
    return jax.vmap(lambda u: nested.coarsen(u, 2))(from_scratch(batch, setting, np.arange(len(batch.force_n))))


def from_scratch(batch: SceneBatch, setting: Setting, rows: np.ndarray) -> np.ndarray:
    """Displacement of some scenes under one setting, [R, n, n]."""
    spacing = batch.sensor.window_mm / setting.grid
    gel, body = spectra(batch.sensor, setting.padded, spacing)
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
def spectra(sensor: SensorModel, padded: int, spacing_mm: float) -> tuple[Array, Array]:
    """`normal_compliances` in float32, computed once."""
    gel, body = normal_compliances(sensor, padded, spacing_mm)
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
