"""Answers that differ from the others of their group."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from touchr1_jax.types import Parsed, Target


def diversity(tokens: Int[Array, "G T"], parsed: Parsed, target: Target) -> Float[Array, "G"]:
    """Share of the group's other rollouts with other tokens, 1/(G − 1) Σ_{j≠i} 1[o_j ≠ o_i]; 0 for a lone rollout.

    The reward pays for any difference, also nonsense; a small weight prevents a group of equal answers.
    """
    del parsed, target
    differs = jnp.any(tokens[:, None] != tokens[None], axis=-1)
    return jnp.sum(differs, axis=1) / jnp.float32(max(len(tokens) - 1, 1))
