"""Penalty for answers close to the longest length that is allowed."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from touchr1_jax.types import Parsed, Target

SOFT_SHARE = 0.2
"""Share of the allowed tokens over which the penalty grows: 4,096 of 20,480 in the source."""


def overlong(tokens: Int[Array, "G T"], parsed: Parsed, target: Target) -> Float[Array, "G"]:
    """max(−1, min(0, (T − C − |o|)/C)) with |o| tokens, end token included, T allowed and C = .2 T; −1 if cut off.

    Soft overlong punishment (DAPO, arXiv 2503.14476, eq. 13).
    """
    del target
    longest = tokens.shape[-1]
    soft = max(SOFT_SHARE * longest, 1.0)
    return jnp.where(parsed.truncated, -1.0, jnp.clip((longest - soft - (parsed.length + 1)) / soft, -1.0, 0.0))
