"""Fixed features of touch and force, and statistics of the true shape.

The statistics of shape set the line that touch has to exceed.  The material ties the properties of an object together,
so its shape predicts its hardness in part; roughness and protrusion are shape, so for them the line is a ceiling.
"""

import dataclasses
import itertools
from collections.abc import Sequence as Seq
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from sensors_io.scenes import surface
from sensors_io.scenes.cards import solid_of
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.schedule import Slot
from sensors_io.selection import FIELD_MM_PER_COUNT
from touchr1_jax.models.tactile_vit import force_features
from touchr1_jax.training.linear_probe import stream_features

WINDOW_MM, POINTS = 18.0, 108
"""Part of the skin that is used: as much as a sensor covers, six points per mm."""

WAVES_MM = (16.0, 8.0, 5.0, 3.5, 2.5, 1.8, 1.2, 0.7)
"""Edges of the bands of wavelength, from the width of the window to below the shortest wave of any skin."""

HEIGHTS_MM = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Heights above the deepest point at which the area below is taken."""

_TINY = 1e-6  # mm; keeps logarithms of a perfectly smooth skin finite


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactData:
    """n contacts: force features [n, S, E], true shape [n, G], levels [n] by property, objects [n]."""

    force: np.ndarray
    shape: np.ndarray
    levels: dict[str, np.ndarray]
    objects: np.ndarray


def truth(config: SceneConfig, slots: Seq[Slot], skins: Seq[surface.Skin]) -> dict[str, Any]:
    """The fields of `ContactData` that are known without touch."""
    levels = [solid_of(config, slot.object_index).levels() for slot in slots]
    return {
        "shape": statistics(skins),
        "levels": {name: np.array([level[name] for level in levels]) for name in levels[0]},
        "objects": np.array([slot.object_index for slot in slots]),
    }


def features_of(
    pictures: UInt8[Array, "*n F H W 3"] | None,
    deformation_mm: Float[Array, "*n F h w 2"],
    depth_mm: Float[Array, "*n F h w"],
) -> Array:
    """Fixed features [*n, D] of a sensor's pictures, if any, and of its fields, without its force.

    Displacement and depth become a picture, 128 for none, on the scale of the clips that policies see.
    """
    mm = jnp.concatenate([deformation_mm, depth_mm[..., None]], -1)
    fields = jnp.clip(jnp.round(128 + mm / FIELD_MM_PER_COUNT), 0, 255).astype(jnp.uint8)
    unknown = jnp.zeros((*fields.shape[:-3], 3))
    parts = [fields] if pictures is None else [pictures, fields]
    return jnp.concatenate([stream_features(part, unknown) for part in parts], -1)


def force_of(force_n: np.ndarray) -> np.ndarray:
    """Features of measured forces [..., F, 3], flat."""
    found = np.asarray(force_features(jnp.asarray(force_n)))
    return found.reshape(*found.shape[:-2], -1)


def statistics(skins: Seq[surface.Skin]) -> np.ndarray:
    """Curvatures, roughness by band and bearing curve of every skin, all logarithmic, float32 [n, 14].

    Per skin: the two principal curvatures of the least-squares paraboloid, the rms of its residual in each band of
    `WAVES_MM` under a Hann window, and the share of the window below each of `HEIGHTS_MM` (Abbott & Firestone 1933).
    """
    spacing = WINDOW_MM / POINTS
    x = (np.arange(POINTS) + 0.5) * spacing - WINDOW_MM / 2
    columns, rows = (a.ravel() for a in np.meshgrid(x, x))
    basis = np.stack([np.ones_like(columns), columns, rows, columns**2, columns * rows, rows**2], -1)  # [N², 6]
    inverse = np.linalg.pinv(basis)
    frequency = np.fft.fftfreq(POINTS, spacing)
    per_mm = np.hypot(frequency[:, None], frequency[None]).ravel()
    edges = itertools.pairwise(1 / np.array(WAVES_MM))
    bands = np.array([(per_mm >= low) & (per_mm < high) for low, high in edges], float)  # [bands, N²]
    taper = np.hanning(POINTS)

    def summary(gap: np.ndarray) -> np.ndarray:
        coefficients = inverse @ gap.ravel()
        xx, xy, yy = coefficients[3:]
        curvature = np.linalg.eigvalsh(np.array([[2 * xx, xy], [xy, 2 * yy]]))
        left = (gap.ravel() - basis @ coefficients).reshape(gap.shape)
        power = np.abs(np.fft.fft2(left * np.outer(taper, taper))).ravel() ** 2 / gap.size**2
        rms = np.sqrt(bands @ power)
        below = np.mean(gap.ravel()[:, None] <= np.array(HEIGHTS_MM), axis=0)
        return np.log(np.concatenate([np.maximum(curvature, 0) + _TINY, rms + _TINY, below + 1 / gap.size]))

    level = surface.SensorPose(offset_mm=jnp.zeros(2), turn_rad=jnp.zeros(()), tilt=jnp.zeros(2))
    stacked = jax.tree.map(lambda *leaf: np.stack(leaf), *jax.device_get(list(skins)))
    gap_of = lambda skin: surface.gap(skin, level, jnp.asarray(x, jnp.float32))
    gaps = np.asarray(jax.jit(lambda s: jax.lax.map(gap_of, s))(stacked), np.float64)
    return np.stack([summary(gap) for gap in gaps]).astype(np.float32)
