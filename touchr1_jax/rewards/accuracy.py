"""Accuracy with ordinal credit."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.types import Parsed, Target

NEXT_LEVEL = 0.4
UNPARSABLE = -0.1


def credit(
    answer: Int[Array, "*#n"], label: Int[Array, "*#n"], levels: Int[Array, "*#n"], ordinal: Bool[Array, "*#n"]
) -> Float[Array, "*#n"]:
    """Credit of each answer, with d = |ŷ − y|; the arguments broadcast.

    Ordinal: 1 at d = 0, 0.4 at d = 1, 0 at d ≥ 2, −0.1 where unparsable.  Categorical: 1 if right, else 0.  Source:
    Touch-R1 (arXiv 2605.27154).  Departure: an attribute of two levels would earn 0.4 for the opposite answer and gets
    exact match.  An unknown label (−1), which training never asks for, earns 0 whatever the answer.
    """
    distance = jnp.abs(answer - label)
    near = jnp.where(ordinal & (levels > 2) & (distance == 1), NEXT_LEVEL, 0.0)
    parsable = jnp.where(distance == 0, 1.0, near)
    earned = jnp.where(answer < 0, jnp.where(ordinal, UNPARSABLE, 0.0), parsable)
    return jnp.where(label < 0, 0.0, earned)


def accuracy(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """R_acc: mean `credit` of the conclusions over the asked attributes."""
    return masked.mean(credit(parsed.conclude, target.label, target.levels, target.ordinal), target.asked)
