"""Format of an answer that concludes."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from touchr1_jax.types import Parsed, Target


def format_strict(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """1[formatted and every asked attribute is concluded]: an answer that abstains earns 0.

    A departure from the paper.
    """
    answered = jnp.all((parsed.conclude >= 0) | ~target.asked)
    return (parsed.formatted & answered).astype(jnp.float32)
