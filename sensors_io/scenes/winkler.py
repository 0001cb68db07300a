"""A bed of independent springs: the cheapest contact, used as a first guess and as a look at a scene."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

BISECTIONS = 26
"""Halvings of the bracket of δ: float32 has 24 bits."""

_BED_WAVE_NUMBER = 0.2
"""Wave number, rad/mm, at which the bed is as stiff as the layer: the scale of a finger-sized contact."""

_TINY = 1e-30


@struct.dataclass
class WinklerEstimate:
    """Estimates of a bed of springs for a scene before anything is solved.

    `contact` are the pixels that touch, `radius_mm` is √(area / π), `slope` the rms slope of the undeformed gap inside,
    `at_border` says that they reach the edge of the grid.
    """

    pressure_mpa: Float[Array, "N N"]
    contact: Bool[Array, "N N"]
    radius_mm: Float[Array, ""]
    slope: Float[Array, ""]
    at_border: Bool[Array, ""]


def bed_compliance(compliance: Float[Array, "M K"], spacing_mm: float) -> Float[Array, ""]:
    """Compliance of one spring, mm/MPa: G at the wave number of a finger-sized contact."""
    points = compliance.shape[0]
    index = jnp.round(_BED_WAVE_NUMBER * points * spacing_mm / (2 * jnp.pi)).astype(jnp.int32)
    return compliance[0, jnp.clip(index, 1, compliance.shape[1] - 1)]


def pressure(gap: Float[Array, "N N"], total: Float[Array, ""], stiffness: Float[Array, ""]) -> Float[Array, "N N"]:
    """Pressure p = K max(δ − g₀, 0) with δ bisected, by geometric midpoints, so that Σ p = total.

    Args:
      gap: g₀, least value 0, mm.
      total: sum of the pressure over all pixels, MPa.
      stiffness: K, MPa/mm.

    Source: Johnson, Contact Mechanics (1985), §4.3.
    """
    target = total / stiffness
    high = jnp.max(gap) + target / gap.size
    low = jnp.minimum(target / gap.size, high) * 1e-3 + 1e-9

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = jnp.sqrt(low * high)
        short = jnp.sum(jnp.maximum(middle - gap, 0)) < target
        return jnp.where(short, middle, low), jnp.where(short, high, middle)

    low, high = jax.lax.fori_loop(0, BISECTIONS, halve, (low, high))
    rise = jnp.maximum(high - gap, 0)
    rise = jnp.where(jnp.sum(rise) > 0, rise, (gap <= jnp.min(gap)).astype(gap.dtype))  # never an empty contact
    return rescale(rise, total)


def rescale(p: Float[Array, "N N"], total: Float[Array, ""]) -> Float[Array, "N N"]:
    """The same pressure with the sum asked for."""
    return p * (total / jnp.maximum(jnp.sum(p), _TINY))


def look(
    gap_mm: Float[Array, "N N"], force_n: Float[Array, ""], compliance: Float[Array, "M K"], spacing_mm: float
) -> WinklerEstimate:
    """Look at a scene without a single convolution.

    Args:
      gap_mm: distance of the undeformed bodies [N, N], any offset.
      force_n: prescribed force, > 0.
      compliance: spectrum of gel and object together [M, M//2 + 1], mm/MPa.
      spacing_mm: pixel size.
    """
    gap = gap_mm - jnp.min(gap_mm)
    p = pressure(gap, force_n / spacing_mm**2, 1 / bed_compliance(compliance, spacing_mm))
    touching = p > 0
    count = jnp.sum(touching)
    slope_y, slope_x = jnp.gradient(gap, spacing_mm)
    inner = jnp.zeros(gap.shape, bool).at[1:-1, 1:-1].set(True)
    return WinklerEstimate(
        pressure_mpa=p,
        contact=touching,
        radius_mm=spacing_mm * jnp.sqrt(count / jnp.pi),
        slope=jnp.sqrt(jnp.sum(jnp.where(touching, slope_x**2 + slope_y**2, 0)) / jnp.maximum(count, 1)),
        at_border=jnp.any(touching & ~inner),
    )
