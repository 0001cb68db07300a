"""R_tu, the reward for answers that the policy does not reach without touch.

With s = max(R_acc, 0) and, for each control c of the touch, the mean s̄^c of its own rollouts: b = max_c s̄^c.
  Literal:      m_i = 1[s̄ > b + δ] · 1[d_i = 0], added to the reward (Touch-R1, arXiv 2605.27154, abstract).
  Recommended:  m_i = 1[s̄ > b + δ] · 1[formatted_i] · max(0, s_i − b), added to the advantage.
Both are 0 where nothing is right, and the recommended one does not cancel when all right rollouts earn it.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from touchr1_jax import masked
from touchr1_jax.rewards.accuracy import accuracy
from touchr1_jax.types import Parsed, Target


def score(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """s = max(R_acc, 0) of one rollout."""
    return jnp.maximum(accuracy(parsed, target), 0.0)


def right(parsed: Parsed, target: Target) -> Bool[Array, ""]:
    """d = 0: every asked attribute is answered right."""
    return jnp.all((parsed.conclude == target.label) | ~target.asked)


def bar(control: Float[Array, "C J"], counts: Bool[Array, "C"]) -> Float[Array, ""]:
    """b = max_c mean_j s_j^c over the controls that count; 1, which nothing passes, where none does.

    Args:
      control: s of the rollouts under each control.
      counts: whether a control says anything about this prompt, such as a shuffle where order matters.
    """
    return masked.maximum(jnp.mean(control, -1), counts, empty=1.0)


def literal(
    own: Float[Array, "G"], best: Float[Array, ""], is_right: Bool[Array, "G"], margin: float
) -> Float[Array, "G"]:
    """1[s̄ > b + δ] · 1[d_i = 0]."""
    return ((jnp.mean(own) > best + margin) & is_right).astype(jnp.float32)


def recommended(
    own: Float[Array, "G"], best: Float[Array, ""], formatted: Bool[Array, "G"], margin: float | Array
) -> Float[Array, "G"]:
    """1[s̄ > b + δ] · 1[formatted_i] · max(0, s_i − b)."""
    return jnp.where((jnp.mean(own) > best + margin) & formatted, jnp.maximum(own - best, 0.0), 0.0)
