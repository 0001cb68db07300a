"""Format of the answer."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from touchr1_jax.types import Parsed, Target


def formatted(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """R_fmt = 1[formatted]: six tags once and in order, no empty body, nothing after the last (see `types.Parsed`)."""
    del target
    return parsed.formatted.astype(jnp.float32)
