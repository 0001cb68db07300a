"""Force at which the deepest indentation of a contact passes the strain limit: a cheap estimate for every object.

The look solves five forces on a coarse grid for every sensor.  Strain grows nearly as a power of force, so the limit
lies on the log–log line between two of them.  Every object is looked at twice: as it is, and as if it were rigid.  The
rigid limit is the lower one and depends on shape alone, so choosing forces by it reveals nothing about hardness.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sensors_io import layer
from sensors_io.scenes import contact, surface
from sensors_io.scenes.press import padded_size
from sensors_io.scenes.sensors import BODY, MODELS, SensorModel
from sensors_io.scenes.validity import STRAIN_LIMIT

_MARGIN = 0.93  # strain grows by 2.5 % for a gel 5 % softer; the rest is placement and grid
_FORCES_N = (1.5, 3.0, 6.0, 11.0, 20.0)
_GRID = 32
_TOLERANCE, _MAX_ITERATIONS = 1e-2, 60
_BATCH = 16


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits:
    """Greatest force that all sensors bear, N, [n]: of the objects as they are, and as if they were rigid."""

    actual_n: np.ndarray
    rigid_n: np.ndarray


def look(
    skins: list[surface.Skin],
    turn_rad: np.ndarray,
    modulus_mpa: np.ndarray,
    models: tuple[SensorModel, ...] = MODELS,
) -> Limits:
    """Limits of n contacts.

    Args:
      skins: at their sites.
      turn_rad: direction of each contact, [n].
      modulus_mpa: effective modulus of each object, [n].
      models: sensors that press.
    """
    found = []
    for start in range(0, len(skins), _BATCH):
        rows = np.minimum(np.arange(start, start + _BATCH), len(skins) - 1)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[skins[i] for i in rows])
        turn, modulus = (jnp.asarray(a[rows], jnp.float32) for a in (turn_rad, modulus_mpa))
        strain = [np.asarray(_strains(stacked, turn, modulus, *_spectra(s), s)) for s in models]
        found.append(np.max(strain, 0)[: len(skins) - start])
    limits = _limit(np.concatenate(found))
    return Limits(actual_n=limits[:, 0], rigid_n=limits[:, 1])


@functools.partial(jax.jit, static_argnames="sensor")
def _strains(
    skins: surface.Skin, turn_rad: Array, modulus_mpa: Array, gel: Array, body: Array, sensor: SensorModel
) -> Array:
    """Greatest strain of every contact, as it is and rigid, at every force: [n, 2, forces]."""
    spacing = sensor.window_mm / _GRID
    x = (jnp.arange(_GRID, dtype=jnp.float32) + 0.5) * spacing - sensor.window_mm / 2
    still = jnp.zeros(2, jnp.float32)

    def one(inputs: tuple[surface.Skin, Array, Array]) -> Array:
        skin, turn, modulus = inputs
        gap = surface.gap(skin, surface.SensorPose(offset_mm=still, turn_rad=turn, tilt=still), x)

        def strain(case: tuple[Array, Array]) -> Array:
            force, compliance = case
            solved = contact.solve(gap, force, gel, body * compliance, spacing, _TOLERANCE, _MAX_ITERATIONS)
            return jnp.max(solved.displacement_mm) / sensor.gel.thickness_mm

        force, compliance = jnp.meshgrid(jnp.asarray(_FORCES_N), jnp.stack([1 / modulus, jnp.zeros(())]))
        return jax.lax.map(strain, (force.ravel(), compliance.ravel())).reshape(2, -1)

    return jax.lax.map(one, (skins, turn_rad, modulus_mpa))


@functools.lru_cache(maxsize=8)
def _spectra(sensor: SensorModel) -> tuple[Array, Array]:
    """Compliance of gel and body on the coarse padded grid."""
    size = padded_size(_GRID, sensor.window_mm, sensor.gel.thickness_mm)
    q = np.hypot(*layer.wave_numbers(size, sensor.window_mm / _GRID))
    gel, body = (jnp.asarray(layer.normal_compliance(q, each), jnp.float32) for each in (sensor.gel, BODY))
    return gel, body


def _limit(strain: np.ndarray) -> np.ndarray:
    """Force at the limit for strains [..., forces], on the log–log line of the two nearest forces, also beyond them."""
    x, y = np.log(_FORCES_N), np.log(np.maximum.accumulate(strain, -1))
    goal = np.log(_MARGIN * STRAIN_LIMIT)
    upper = np.clip((y < goal).sum(-1), 1, len(x) - 1)
    y_low, y_high = (np.take_along_axis(y, i[..., None], -1)[..., 0] for i in (upper - 1, upper))
    slope = np.maximum(y_high - y_low, 1e-3) / (x[upper] - x[upper - 1])
    return np.exp(x[upper] + (goal - y_high) / slope)
