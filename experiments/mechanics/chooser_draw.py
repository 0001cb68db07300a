"""Random scenes for the chooser: objects that the generator draws and departures from them, gaps on every grid."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.mechanics.contact_scenes import SHORTEST_WAVE_MM, draw_press
from sensors_io.scenes import nested, objects, surface
from sensors_io.scenes.chooser import LOOK_GRIDS
from sensors_io.scenes.objects import Solid
from sensors_io.scenes.sensors import SensorModel


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
class SceneBatch:
    """S scenes on one gel: gaps [S, n, n] mm by the side n, forces [S] N, moduli [S] MPa, families [S]."""

    sensor: SensorModel
    gap_mm: Mapping[int, np.ndarray]
    force_n: np.ndarray
    modulus_mpa: np.ndarray
    family: tuple[str, ...]

    def gaps(self, grid: int, rows: np.ndarray) -> np.ndarray:
        """Gaps of some scenes on one grid, as `chooser.solve_many` asks for them."""
        return self.gap_mm[grid][rows]


def draw(
    sensor: SensorModel, count: int, grids: Sequence[int], reference: int, families: Sequence[str], seed: int
) -> SceneBatch:
    """Draw scenes: an object of each family in turn, a pose near the apex, a log-uniform force.

    Gaps are evaluated on the reference's grid, and averaged to all coarser ones, whose sides must divide its own.
    """
    rng = np.random.default_rng(seed)
    x = jnp.asarray((np.arange(reference) + 0.5) * sensor.window_mm / reference - sensor.window_mm / 2, jnp.float32)
    sides = tuple(sorted({*grids, *LOOK_GRIDS, reference}))
    family = tuple(families[i % len(families)] for i in range(count))
    gaps, forces, moduli = [], [], []
    for name in family:
        solid = FAMILIES[name](rng, objects.sample(rng, 0.0, SHORTEST_WAVE_MM))
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
