"""Cross-sensor agreement that counts only where the answer is right."""

from jaxtyping import Array, Float

from touchr1_jax import masked
from touchr1_jax.rewards.consistency import agreement
from touchr1_jax.types import Parsed, Target


def consistency_gated(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """Mean over the asked ordinal attributes of agreement · 1[d = 0], d = |ŷ − y| of the conclusion.

    A departure from the paper: without the gate a constant answer earns the full reward.  A gate at d ≤ 1 would be
    worse, since the middle level always passes it.
    """
    right = (parsed.conclude == target.label) & (target.label >= 0)
    return masked.mean(agreement(parsed, target) * right, target.asked & target.ordinal)
