"""Readout of a deformed gel by a sensor: fields on a coarse grid and a picture, with gains, noise and losses."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, UInt8, UInt32

from sensors_io.scenes import failures, noise, optics
from sensors_io.scenes.sensors import SensorModel

FIELD_GRID = 20
LOST_NODE_SHARE = 0.004
"""Share of field nodes that a frame cannot read."""


@struct.dataclass
class Unit:
    """One physical sensor: its gel's modulus relative to the model's, its light, the gains of its calibration."""

    modulus_factor: Float[Array, ""]
    light: optics.Light
    lateral_gain: Float[Array, ""]
    depth_gain: Float[Array, ""]


@struct.dataclass
class Gel:
    """The gel in one frame, on the contact grid, mm: indentation of the surface, displacement of the marker plane.

    Plane vectors are complex, x + iy; `shear_mm` is that part of `markers_mm` which the traction makes.  A gel without
    markers shows its surface: `marker_depth_mm` is then `depth_mm` and nothing moves sideways.
    """

    depth_mm: Float[Array, "N N"]
    marker_depth_mm: Float[Array, "N N"]
    markers_mm: Array
    shear_mm: Array


@struct.dataclass
class FrameFields:
    """One frame on the 20 × 20 grid: displacement, its part by traction, indentation, and which nodes are read."""

    deformation_mm: Float[Array, "h w 2"]
    shear_mm: Float[Array, "h w 2"]
    depth_mm: Float[Array, "h w"]
    valid: Bool[Array, "h w"]


@struct.dataclass
class Resampling:
    """Matrices from the contact grid to picture pixels and to field nodes."""

    to_image: Float[Array, "H N"]
    to_field: Float[Array, "h N"]


def make_resampling(grid: int, image_px: int) -> Resampling:
    """Cubic to `image_px` pixels; linear from the centres of `grid` pixels to the centres of FIELD_GRID cells."""
    at = np.clip((np.arange(FIELD_GRID) + 0.5) * grid / FIELD_GRID - 0.5, 0, grid - 1)
    nodes = np.maximum(1 - np.abs(at[:, None] - np.arange(grid)), 0)
    return Resampling(to_image=optics.cubic_matrix(image_px, grid), to_field=jnp.asarray(nodes, jnp.float32))


def measure(gel: Gel, unit: Unit, resampling: Resampling, key: UInt32[Array, "2"], sensor: SensorModel) -> FrameFields:
    """The fields as the sensor reports them: with its gains, drifting zero plane, noise, and lost nodes set to 0."""
    planes = [gel.markers_mm.real, gel.markers_mm.imag, gel.shear_mm.real, gel.shear_mm.imag, gel.marker_depth_mm]
    nodes = _resample(resampling.to_field, jnp.stack(planes))
    cells = (FIELD_GRID, FIELD_GRID)
    error = noise.normal(noise.fold(key, 0), (5, *cells))
    lateral = nodes[:4] * unit.lateral_gain + sensor.lateral_noise_mm * error[:4]
    offset, slope_x, slope_y = 0.5 * sensor.depth_noise_mm * noise.normal(noise.fold(key, 1), (3,))
    x = jnp.linspace(-1, 1, FIELD_GRID)
    zero = offset + slope_x * x + slope_y * x[:, None]
    depth = nodes[4] * unit.depth_gain + zero + sensor.depth_noise_mm * error[4]
    valid = (noise.uniform(noise.fold(key, 2), cells) >= LOST_NODE_SHARE) & ~_unreadable(gel, resampling, sensor)
    return FrameFields(
        deformation_mm=jnp.where(valid[..., None], jnp.moveaxis(lateral[:2], 0, -1), 0),
        shear_mm=jnp.where(valid[..., None], jnp.moveaxis(lateral[2:], 0, -1), 0),
        depth_mm=jnp.where(valid, depth, 0),
        valid=valid,
    )


def photograph(
    gel: Gel,
    unit: Unit,
    exposure: Float[Array, ""],
    resampling: Resampling,
    key: UInt32[Array, "2"],
    sensor: SensorModel,
) -> UInt8[Array, "H W 3"] | None:
    """The picture, `None` without a camera; `exposure` is that of this frame, relative to the unit's."""
    if sensor.render is None:
        return None
    seen = optics.DeformedGel(
        depth_mm=_resample(resampling.to_image, gel.depth_mm),
        marker_x_mm=_resample(resampling.to_image, gel.markers_mm.real),
        marker_y_mm=_resample(resampling.to_image, gel.markers_mm.imag),
        marker_depth_mm=_resample(resampling.to_image, gel.marker_depth_mm),
        window_mm=sensor.window_mm,
    )
    light = dataclasses.replace(unit.light, exposure=unit.light.exposure * exposure)
    image = sensor.render(seen, light)
    grain = noise.normal(noise.fold(key, 3), image.shape)
    return optics.expose(image, grain, sensor.read_noise, sensor.shot_noise)


def _unreadable(gel: Gel, resampling: Resampling, sensor: SensorModel) -> Bool[Array, "h w"]:
    """Field nodes at most of whose neighbours on the contact grid no marker can be read."""
    if sensor.marker_depth_mm is None:
        return jnp.zeros((FIELD_GRID, FIELD_GRID), bool)
    spacing = sensor.window_mm / gel.depth_mm.shape[0]
    lost = failures.lost_markers(gel.markers_mm.real, gel.markers_mm.imag, gel.marker_depth_mm, spacing)
    return _resample(resampling.to_field, lost.astype(jnp.float32)) > 0.5


def _resample(matrix: Array, field: Array) -> Array:
    return matrix @ field @ matrix.T
