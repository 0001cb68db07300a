"""Accuracy without ordinal credit."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from touchr1_jax import masked
from touchr1_jax.rewards.accuracy import UNPARSABLE
from touchr1_jax.types import Parsed, Target


def exact(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """Mean over the asked attributes of 1 if right, 0 if wrong, −0.1 if unparsable, ordinal or not.

    An unknown label (−1), which training never asks for, earns 0.
    """
    right = (parsed.conclude == target.label).astype(jnp.float32)
    earned = jnp.where(parsed.conclude < 0, UNPARSABLE, right)
    return masked.mean(jnp.where(target.label < 0, 0.0, earned), target.asked)
