"""Group-relative advantages."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

SPREAD_FLOOR = 1e-5
"""Rewards closer than this are equal: 1, 0.4 and −0.1 are not exact in float32, so σ of a constant group is not 0."""


def degenerate(reward: Float[Array, "*p G"]) -> Bool[Array, "*p"]:
    """Groups whose rewards are all equal and teach nothing, max R − min R < `SPREAD_FLOOR`."""
    return jnp.max(reward, -1) - jnp.min(reward, -1) < SPREAD_FLOOR


def group_advantage(
    reward: Float[Array, "*p G"], *, epsilon: float = 1e-4, normalise: bool = True
) -> Float[Array, "*p G"]:
    """Advantage within a group, A_i = (R_i − R̄)/(σ_R + ε), population σ (DeepSeekMath, arXiv 2402.03300, eq. 4).

    A degenerate group gets exactly 0, where rounding noise over a tiny σ would otherwise give thousands.

    Args:
      reward: rewards of the group's rollouts.
      epsilon: added to σ.
      normalise: false leaves σ out (Dr. GRPO, arXiv 2503.20783).
    """
    centred = reward - jnp.mean(reward, -1, keepdims=True)
    if normalise:
        centred = centred / (jnp.std(reward, -1, keepdims=True) + epsilon)
    return jnp.where(degenerate(reward)[..., None], 0.0, centred)


def added_after(bonus: Float[Array, "*p G"], weight: float) -> Float[Array, "*p G"]:
    """α (m_i − m̄): a bonus that joins the advantage after normalisation.

    One that joins the reward before it cancels as soon as every right rollout earns it.
    """
    return weight * (bonus - jnp.mean(bonus, -1, keepdims=True))


def livelier_first(flat: Bool[Array, "D"], keep: int) -> Array:
    """Rows of the first `keep` groups that are not degenerate, filled up with degenerate ones: dynamic sampling."""
    return jnp.argsort(flat, stable=True)[:keep]
