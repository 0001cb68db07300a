"""Nested grids of one window: what a contact looks like on a grid two or four times coarser, and back."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

COARSEST = 16
"""Least side of a coarse grid, pixels: below it a grid costs as much as the next finer one."""

_FACTORS = (4, 2)


def factors(points: int, padded: int) -> tuple[int, ...]:
    """By how much the grids are coarser on which a contact is solved first, coarsest first.

    Args:
      points: N, side of the finest grid.
      padded: M, its side with padding; both must be divisible.
    """
    return tuple(f for f in _FACTORS if points % f == 0 and padded % f == 0 and points // f >= COARSEST)


def coarsen(field: Float[Array, "N N"], factor: int) -> Float[Array, "n n"]:
    """Mean over blocks of factor × factor pixels."""
    n = field.shape[0] // factor
    return field.reshape(n, factor, n, factor).mean((1, 3))


def refine(field: Float[Array, "n n"]) -> Float[Array, "N N"]:
    """Twice the resolution, linear between the centres of pixels; block means of the inner pixels change little."""
    return _refine_rows(_refine_rows(field).T).T


def resample(field: Float[Array, "n n"], points: int) -> Float[Array, "N N"]:
    """The field on a finer grid of any side, linear between the centres of pixels: `refine` for twice the side."""
    side = field.shape[0]
    at = np.clip((np.arange(points) + 0.5) * side / points - 0.5, 0, side - 1)
    weights = np.maximum(1 - np.abs(at[:, None] - np.arange(side)), 0).astype(np.float32)
    return weights @ field @ weights.T


def truncate(spectrum: Float[Array, "M K"], factor: int) -> Float[Array, "m k"]:
    """The spectrum of the same kernel on a grid coarser by `factor`: its low wave numbers."""
    m = spectrum.shape[0] // factor
    positive = (m + 1) // 2
    rows = jnp.concatenate([spectrum[:positive], spectrum[spectrum.shape[0] - (m - positive) :]])
    return rows[:, : m // 2 + 1]


def _refine_rows(field: Array) -> Array:
    padded = jnp.concatenate([field[:1], field, field[-1:]])
    before, after = 0.75 * field + 0.25 * padded[:-2], 0.75 * field + 0.25 * padded[2:]
    return jnp.stack([before, after], 1).reshape(-1, field.shape[1])
