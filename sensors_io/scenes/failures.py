"""Sensor failures in one frame: clipped pixels, unreadable markers, contact at the border of the window.

All functions take one frame and run inside or outside compiled code; `flags` makes the bits of `schema.Flag`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8, UInt32

from sensors_io.schema import Flag

SATURATED_SHARE = 0.005
"""Share of pixels with a clipped channel above which a frame is saturated: a patch of 8 × 8 in a picture of 112²."""

LOST_SHARE = 0.05
"""Share of field nodes that are lost above which a frame is flagged; a trusted frame loses 0.4 %."""

PROJECTED_AREA = (0.5, 2.0)
"""Seen area of a marker over its area at rest between which a blob detector takes it for a marker.  Assumed."""

STEEPEST = 1.0
"""Slope of the marker plane past which its far side is hidden from the camera: 45°.  Assumed."""


def saturated(picture: UInt8[Array, "H W 3"]) -> Bool[Array, ""]:
    """True if too many pixels have a channel at either end of its range."""
    clipped = jnp.any((picture == 0) | (picture == 255), -1)
    return jnp.mean(clipped) > SATURATED_SHARE


def lost_markers(
    x_mm: Float[Array, "N N"], y_mm: Float[Array, "N N"], depth_mm: Float[Array, "N N"], spacing_mm: float
) -> Bool[Array, "N N"]:
    """Mask of nodes whose markers cannot be read: squeezed, stretched or folded too far, or turned away.

    The camera looks along the normal of the undeformed gel, so that the area it sees is that at rest times
    det(1 + ∇u), u the lateral displacement.

    Args:
      x_mm, y_mm, depth_mm: displacement of the marker plane; rows are y.
      spacing_mm: of the grid.
    """
    (x_y, x_x), (y_y, y_x), (d_y, d_x) = (jnp.gradient(f, spacing_mm) for f in (x_mm, y_mm, depth_mm))
    area = (1 + x_x) * (1 + y_y) - x_y * y_x
    low, high = PROJECTED_AREA
    return (area < low) | (area > high) | (d_x**2 + d_y**2 > STEEPEST**2)


def marker_loss(valid: Bool[Array, "h w"]) -> Bool[Array, ""]:
    """True if too many nodes of the field are lost."""
    return jnp.mean(~valid) > LOST_SHARE


def border_contact(pressure_mpa: Float[Array, "N N"]) -> Bool[Array, ""]:
    """True if contact reaches the outermost pixels of the window."""
    touching = pressure_mpa > 0
    return jnp.any(touching[0] | touching[-1]) | jnp.any(touching[:, 0] | touching[:, -1])


def flags(
    *, saturated: Bool[Array, "..."], marker_loss: Bool[Array, "..."], border_contact: Bool[Array, "..."]
) -> UInt32[Array, "..."]:
    """The failures as bits of `schema.Flag`, of any common shape."""
    named = ((saturated, Flag.SATURATED), (marker_loss, Flag.MARKER_LOSS), (border_contact, Flag.BORDER_CONTACT))
    bits = [jnp.where(failed, jnp.uint32(flag.value), jnp.uint32(0)) for failed, flag in named]
    return bits[0] | bits[1] | bits[2]
