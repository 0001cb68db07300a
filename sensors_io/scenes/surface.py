"""The height of an object's skin under a sensor, in JAX, exactly translatable and rotatable."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from sensors_io.scenes.objects import Solid, Variation


@struct.dataclass
class Seam:
    """Change of relief and roughness over the skin: factors of their far side, and the line of `objects.Variation`.

    The line lies `offset_mm` from the site, along `direction_rad`.
    """

    relief_factor: Float[Array, ""]
    roughness_factor: Float[Array, ""]
    direction_rad: Float[Array, ""]
    offset_mm: Float[Array, ""]
    width_mm: Float[Array, ""]


@struct.dataclass
class Skin:
    """Shape of one object at one contact site, in the object's frame; the fields are those of `Solid`.

    `site_mm` is the point of the relief and of the roughness that comes to lie at the apex.  `seam` is `None` where the
    object is the same everywhere.
    """

    curvature_per_mm: Float[Array, "2"]
    turn_rad: Float[Array, ""]
    feature_height_mm: Float[Array, ""]
    feature_pitch_mm: Float[Array, ""]
    feature_width: Float[Array, ""]
    pattern: Int[Array, ""]
    site_mm: Float[Array, "2"]
    wave_numbers: Float[Array, "K 2"]
    wave_amplitudes_mm: Float[Array, "K"]
    wave_phases_rad: Float[Array, "K"]
    seam: Seam | None = None


@struct.dataclass
class SensorPose:
    """Position of the sensor over the site: offset, turn about the normal, tilt as a slope along x and y."""

    offset_mm: Float[Array, "2"]
    turn_rad: Float[Array, ""]
    tilt: Float[Array, "2"]


def as_f32(value: float | np.ndarray) -> Any:
    """A NumPy array in the place of a JAX array; the call of a compiled program takes all of them to the device."""
    return np.asarray(value, np.float32)


def make_skin(solid: Solid, site_mm: np.ndarray, curvature_factor: float) -> Skin:
    """Skin of an object at a site; the body is more or less curved there by `curvature_factor`."""

    pattern: Any = np.asarray(solid.pattern, np.int32)
    return Skin(
        curvature_per_mm=as_f32(np.array([curvature_factor / solid.radius_1_mm, curvature_factor / solid.radius_2_mm])),
        turn_rad=as_f32(solid.turn_rad),
        feature_height_mm=as_f32(solid.feature_height_mm),
        feature_pitch_mm=as_f32(solid.feature_pitch_mm),
        feature_width=as_f32(solid.feature_width),
        pattern=pattern,
        site_mm=as_f32(site_mm),
        wave_numbers=as_f32(solid.wave_numbers),
        wave_amplitudes_mm=as_f32(solid.wave_amplitudes_mm),
        wave_phases_rad=as_f32(solid.wave_phases_rad),
        seam=None if solid.variation is None else _seam(solid, solid.variation, site_mm),
    )


def _seam(solid: Solid, variation: Variation, site_mm: np.ndarray) -> Seam:
    direction = variation.direction_rad
    along = site_mm[0] * np.cos(direction) + site_mm[1] * np.sin(direction)
    numbers = {
        "relief_factor": variation.feature_height_mm / solid.feature_height_mm,
        "roughness_factor": variation.rms_mm / solid.rms_mm,
        "direction_rad": direction,
        "offset_mm": variation.offset_mm - along,
        "width_mm": variation.width_mm,
    }
    return Seam(**{name: as_f32(value) for name, value in numbers.items()})


def gap(skin: Skin, pose: SensorPose, x_mm: Float[Array, "N"]) -> Float[Array, "N N"]:
    """Distance of the undeformed skin from the flat gel on the grid [y, x] of `x_mm` × `x_mm`, least value 0.

    z = A²/2R₁ + B²/2R₂ − height · pattern(A, B) + Σ a cos(k·r + φ) + tilt · r

    Over a seam, height and a change by the power of their factors that is the share of the far side.
    """
    turn = pose.turn_rad
    x, y = x_mm[None, :] - pose.offset_mm[0], x_mm[:, None] - pose.offset_mm[1]
    a, b = _turned(x, y, turn + skin.turn_rad)
    body = (skin.curvature_per_mm[0] * a**2 + skin.curvature_per_mm[1] * b**2) / 2
    site_a, site_b = _turned(skin.site_mm[0], skin.site_mm[1], skin.turn_rad)
    relief = _relief(skin, a + site_a, b + site_b)
    roughness = _roughness(skin, pose, x_mm)
    if skin.seam is not None:
        far, _ = _turned(x, y, turn + skin.seam.direction_rad)
        share = 0.5 + 0.5 * jnp.tanh((far - skin.seam.offset_mm) / skin.seam.width_mm)
        relief, roughness = relief * skin.seam.relief_factor**share, roughness * skin.seam.roughness_factor**share
    z = body - skin.feature_height_mm * relief + roughness + pose.tilt[0] * x + pose.tilt[1] * y
    return z - jnp.min(z)


def _turned(x: Array, y: Array, angle: Array) -> tuple[Array, Array]:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x + s * y, c * y - s * x


def _relief(skin: Skin, a: Array, b: Array) -> Array:
    """The periodic features, between 0 and 1, in the order of `objects.PATTERNS`."""
    u, v = a / skin.feature_pitch_mm, b / skin.feature_pitch_mm
    du, dv = u - jnp.round(u), v - jnp.round(v)
    width = 2 * skin.feature_width**2
    bumps = jnp.exp(-(du**2 + dv**2) / width)
    ridges = jnp.exp(-(du**2) / width)
    plateaus = 0.5 + 0.5 * jnp.tanh(4 * jnp.cos(2 * jnp.pi * u) * jnp.cos(2 * jnp.pi * v))
    return jnp.select([skin.pattern == 0, skin.pattern == 1], [bumps, ridges], plateaus)


def _roughness(skin: Skin, pose: SensorPose, x_mm: Array) -> Array:
    """Σ a cos(k·r + φ) as two matrix products: cos(k_y y + φ) cos(k_x x) − sin(k_y y + φ) sin(k_x x)."""
    k_x, k_y = _turned(skin.wave_numbers[:, 0], skin.wave_numbers[:, 1], -pose.turn_rad)
    phase = skin.wave_phases_rad + skin.wave_numbers @ skin.site_mm
    phase = phase - k_x * pose.offset_mm[0] - k_y * pose.offset_mm[1]
    along_x = x_mm[:, None] * k_x
    along_y = x_mm[:, None] * k_y + phase
    cosine = skin.wave_amplitudes_mm * jnp.cos(along_y) @ jnp.cos(along_x).T
    return cosine - skin.wave_amplitudes_mm * jnp.sin(along_y) @ jnp.sin(along_x).T
