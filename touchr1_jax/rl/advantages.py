"""Group-relative advantages, and which groups give a gradient."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from touchr1_jax import masked
from touchr1_jax.rl.config import Algorithm

SPREAD_FLOOR = 1e-5
"""Rewards closer than this are equal: 1, 0.4 and −0.1 are not exact in float32, so σ of a constant group is not 0."""


def zero_variance(reward: Float[Array, "*p G"]) -> Bool[Array, "*p"]:
    """Groups whose rewards are all equal and give no gradient, max R − min R < `SPREAD_FLOOR`."""
    return jnp.max(reward, -1) - jnp.min(reward, -1) < SPREAD_FLOOR


def advantages(algorithm: Algorithm, reward: Float[Array, "P G"]) -> Float[Array, "P G"]:
    """Advantages as the algorithm normalises them."""
    if algorithm.batch_sigma:
        return batch_advantage(reward, epsilon=algorithm.epsilon)
    return group_advantage(reward, epsilon=algorithm.epsilon, normalise=algorithm.normalise)


def group_advantage(
    reward: Float[Array, "*p G"], *, epsilon: float = 1e-4, normalise: bool = True
) -> Float[Array, "*p G"]:
    """Advantage within a group, A_i = (R_i − R̄)/(σ_R + ε), population σ (DeepSeekMath, arXiv 2402.03300, eq. 4).

    A group of equal rewards gets exactly 0, where rounding noise over a tiny σ would otherwise give thousands.

    Args:
      reward: rewards of the group's rollouts.
      epsilon: added to σ.
      normalise: false leaves σ out (Dr. GRPO, arXiv 2503.20783).
    """
    centred = reward - jnp.mean(reward, -1, keepdims=True)
    if normalise:
        centred = centred / (jnp.std(reward, -1, keepdims=True) + epsilon)
    return jnp.where(zero_variance(reward)[..., None], 0.0, centred)


def batch_advantage(reward: Float[Array, "P G"], *, epsilon: float = 1e-4) -> Float[Array, "P G"]:
    """Advantage within a group in units of the whole batch, A_i = (R_i − R̄_group)/(σ_batch + ε).

    σ_batch² is the mean variance of the groups whose rewards differ.  A σ of each group's own weighs questions by how
    alike their rewards are, which biases a reward that is fair between answers: under ordinal credit debiased by the
    prior, a group whose label is the middle one spreads half as wide as others, so that over uniform labels and answers
    "middle" has an advantage of .23 on average and either end one of −.11.  After REINFORCE++ (arXiv 2501.03262), whose
    mean is the batch's too.

    Args:
      reward: rewards of the rollouts of all groups.
      epsilon: added to σ.
    """
    equal = zero_variance(reward)
    sigma = jnp.sqrt(masked.mean(jnp.var(reward, -1), ~equal))
    centred = reward - jnp.mean(reward, -1, keepdims=True)
    return jnp.where(equal[:, None], 0.0, centred / (sigma + epsilon))


def added_after(bonus: Float[Array, "*p G"], weight: float) -> Float[Array, "*p G"]:
    """α (m_i − m̄): a bonus that is added to the advantage, after normalisation.

    If added to the reward before normalisation, the bonus vanishes once every correct rollout earns it.
    """
    return weight * (bonus - jnp.mean(bonus, -1, keepdims=True))


def dynamic_sampling_rows(no_signal: Bool[Array, "D"], keep: int) -> Array:
    """Rows of the first `keep` groups that give a gradient, filled up with groups that give none (DAPO, 2503.14476)."""
    return jnp.argsort(no_signal, stable=True)[:keep]


def prompt_weights(counts: Bool[Array, "P"]) -> Float[Array, "P"]:
    """Weight of each prompt in a mean over the prompts that count; all 0 when none does."""
    return counts / jnp.maximum(jnp.sum(counts), 1)
