"""Validity of a solved contact: which assumptions of small-strain theory, grid and solver hold."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

STRAIN_LIMIT = 0.3
"""Indentation over the gel's thickness past which linear elasticity is not to be believed."""

RESOLVED_PIXELS = 12
"""Fewest pixels of a contact: with fewer (a/dx < 2) the pressure is that of the grid, not of the body."""


@struct.dataclass
class Validity:
    """Each assumption by name; `all` says that every one is kept."""

    converged: Bool[Array, "..."]
    small_strain: Bool[Array, "..."]
    resolved: Bool[Array, "..."]

    @property
    def all(self) -> Bool[Array, "..."]:
        """True if the frame may be used."""
        return self.converged & self.small_strain & self.resolved


def judge(pressure: Float[Array, "... N N"], strain: Float[Array, "..."], converged: Bool[Array, "..."]) -> Validity:
    """Hold a contact against the limits.

    Args:
      pressure: p ≥ 0.
      strain: greatest indentation over the gel's thickness; 0 for a half-space.
      converged: whether the solver reached its tolerance.
    """
    return Validity(
        converged=converged,
        small_strain=strain <= STRAIN_LIMIT,
        resolved=jnp.sum(pressure > 0, (-2, -1)) >= RESOLVED_PIXELS,
    )
