"""Advantages, and which groups give a gradient."""

import math
from collections.abc import Mapping
from typing import assert_never

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.rl.config import Advantage, Algorithm

SPREAD_FLOOR = 1e-5
"""Rewards closer than this are equal: 1, 0.4 and −0.1 are not exact in float32, so σ of a constant group is not 0."""


def zero_variance(reward: Float[Array, "*p G"]) -> Bool[Array, "*p"]:
    """Groups whose rewards are all equal and give no gradient, max R − min R < `SPREAD_FLOOR`."""
    return jnp.max(reward, -1) - jnp.min(reward, -1) < SPREAD_FLOOR


def no_signal(
    algorithm: Algorithm, reward: Float[Array, "P G"], terms: Mapping[str, Float[Array, "P G"]]
) -> Bool[Array, "P"]:
    """Groups in which every advantage is 0 for any σ, because the compared rewards are all equal.

    Under GLOBAL that is so if those of the whole batch are: a group of equal rewards differs from other groups.
    """
    over_batch = lambda x: jnp.broadcast_to(zero_variance(x.reshape(-1)), x.shape[:1])
    equal = over_batch if algorithm.advantage is Advantage.GLOBAL else zero_variance
    if algorithm.segment_credit or algorithm.advantage is Advantage.PER_REWARD:
        # equal totals may be made of different terms, which count by themselves
        if not terms:
            raise ValueError("terms is empty: must name each reward to credit it by itself; score with `make_score`")
        return jnp.all(jnp.stack([equal(term) for term in terms.values()]), axis=0)
    return equal(best_of(reward, algorithm.best_of))


def best_of(reward: Float[Array, "*p G"], k: int) -> Float[Array, "*p G"]:
    """Mean largest reward over all sets of k rollouts that contain a rollout, max@k; pass@k for rewards 0 and 1.

    R̃_i = Σ_{S ∋ i, |S| = k} max_{j∈S} R_j / C(G − 1, k − 1).  The mean over i is the unbiased estimate of max@k (of
    pass@k: 1 − C(wrong, k)/C(G, k)), and R̃_i less it is the advantage of pass@k training up to its σ (arXiv
    2508.10751; for rewards of any size arXiv 2503.19595, 2505.15201).

    Args:
      reward: rewards of groups of G ≥ k rollouts.
      k: size of a set; 1 changes nothing.
    """
    if k == 1:
        return reward
    group = reward.shape[-1]
    below = np.arange(group)
    largest = [math.comb(m - 1, k - 2) for m in range(1, group)]  # sets with i whose largest is the m-th above it
    share = np.triu(np.tile([0, *largest], (group, 1)), 1) + np.diag([math.comb(m, k - 1) for m in below])
    order = jnp.argsort(reward, -1)
    rising = jnp.take_along_axis(reward, order, -1)
    weight = jnp.asarray(share / math.comb(group - 1, k - 1), reward.dtype)
    least = jnp.maximum(rising, rising[..., k - 1 : k])  # of the rewards that count for a rollout
    # sums of differences, since those of large rewards round, so that equal ones would differ
    found = least + ((rising[..., None, :] - least[..., None]) * weight).sum(-1)
    return jnp.take_along_axis(found, jnp.argsort(order, -1), -1)


def neutralised(x: Float[Array, "D G"], finite: Bool[Array, "D"]) -> Float[Array, "D G"]:
    """Numbers of rollouts; those of groups that are not finite are replaced by the mean of all others."""
    return jnp.where(finite[:, None], x, masked.mean(x, jnp.broadcast_to(finite[:, None], x.shape)))


def advantages(
    algorithm: Algorithm,
    reward: Float[Array, "P G"],
    terms: Mapping[str, Float[Array, "P G"]],
    finite: Bool[Array, "P"] | None = None,
) -> Float[Array, "P G"]:
    """Advantages by the algorithm's comparison; R̄ and σ are those of a group unless their name says otherwise.

    GROUP: (R − R̄)/(σ + ε).  BATCH: (R − R̄)/(σ_batch + ε).  NONE: R − R̄ (Dr. GRPO).  LEAVE_ONE_OUT: R_i less the mean
    of the group's others (RLOO, arXiv 2402.14740).  GLOBAL: (R − R̄_batch)/(σ_batch + ε) (REINFORCE++, arXiv
    2501.03262).
    PER_REWARD: the sum over rewards of their GROUP advantages, in units of its σ over the batch; division by σ removes
    the weights, so all rewards count equally (GDPO, arXiv 2601.05242, with equal weights).

    Args:
      algorithm: which comparison, and ε.
      reward: total rewards, compared by the best of `algorithm.best_of`.
      terms: weighted rewards whose sum it is.
      finite: groups that stay, for `of_kept_groups`; all by default.
    """
    epsilon, reward = algorithm.epsilon, best_of(reward, algorithm.best_of)
    of_batch = epsilon if finite is None else epsilon * jnp.sqrt(jnp.mean(finite.astype(jnp.float32)))
    if finite is not None:  # the best of k, and the groups selected of all candidates, have means of their own
        reward = neutralised(reward, finite)
    match algorithm.advantage:
        case Advantage.GROUP:
            return group_advantage(reward, epsilon=epsilon)
        case Advantage.BATCH:
            return batch_advantage(reward, epsilon=epsilon)
        case Advantage.NONE:
            return group_advantage(reward, epsilon=epsilon, normalise=False)
        case Advantage.LEAVE_ONE_OUT:
            others = reward.shape[-1] - 1
            return group_advantage(reward, epsilon=epsilon, normalise=False) * ((others + 1) / others)
        case Advantage.GLOBAL:
            return group_advantage(reward.reshape(-1), epsilon=of_batch).reshape(reward.shape)
        case Advantage.PER_REWARD:
            total = sum(
                (group_advantage(term, epsilon=epsilon) for term in terms.values()), start=jnp.zeros_like(reward)
            )
            sigma = jnp.std(total) + of_batch
            return total / jnp.where(sigma > 0, sigma, 1.0)
        case _:
            assert_never(algorithm.advantage)


def of_kept_groups(
    algorithm: Algorithm, advantage: Float[Array, "P G *t"], finite: Bool[Array, "P"]
) -> Float[Array, "P G *t"]:
    """Advantages as if the excluded groups did not exist; those of excluded groups become 0.

    The reward of an excluded group is the mean of all others (`scoring.left_out_groups`).  It does not change the mean
    of the batch and multiplies σ of the batch, and ε in `advantages`, by the root of the share of groups that stay.
    """
    of_batch = algorithm.advantage in (Advantage.GLOBAL, Advantage.PER_REWARD)
    scale = jnp.sqrt(jnp.mean(finite.astype(jnp.float32))) if of_batch else 1.0
    return jnp.where(finite.reshape(-1, *(1,) * (advantage.ndim - 1)), scale * advantage, 0.0)


def segment_advantages(
    algorithm: Algorithm,
    reward: Float[Array, "P G"],
    terms: Mapping[str, Float[Array, "P G"]],
    settled: Mapping[str, int],
    segment: Int[Array, "P G T"],
    finite: Bool[Array, "P"] | None = None,
) -> Float[Array, "P G T"]:
    """Advantage of each token from the rewards that are not known before its segment: the return from there on.

    A reward that is known before a token does not depend on the token, so leaving it out keeps the policy gradient and
    reduces variance.  The published agreement of the slots is known at the end of `compare`, so the conclusion gets no
    credit for it, nor blame where it repeats a tag, which makes the slots ⊥.  `advantages` compares each segment
    separately.

    Args:
      algorithm, reward, terms, finite: as for `advantages`.
      settled: number of the segment at whose end a term is known; without one, the last.
      segment: number of each token's segment: 0 up to the end of `perceive`, 1 up to that of `compare`, then 2.
    """
    left, rest, each = reward, dict(terms), []
    for s in range(3):
        each.append(advantages(algorithm, left, rest, finite))
        rest = {name: term for name, term in rest.items() if settled.get(name, 2) != s}
        left = sum(rest.values(), start=jnp.zeros_like(reward))  # what is subtracted from a sum leaves its rounding
    return jnp.take_along_axis(jnp.stack(each, -1), segment, -1)


def group_advantage(
    reward: Float[Array, "*p G"], *, epsilon: float | Float[Array, ""] = 1e-4, normalise: bool = True
) -> Float[Array, "*p G"]:
    """Advantage within a group, A_i = (R_i − R̄)/(σ_R + ε), population σ (DeepSeekMath, arXiv 2402.03300, eq. 4).

    A group of equal rewards gets exactly 0; otherwise, rounding noise over a tiny σ would give thousands.

    Args:
      reward: rewards of the group's rollouts.
      epsilon: added to σ.
      normalise: false leaves σ out (Dr. GRPO, arXiv 2503.20783).
    """
    found = centred(reward)
    if normalise:
        found = found / (jnp.std(found, -1, keepdims=True) + epsilon)
    return jnp.where(zero_variance(reward)[..., None], 0.0, found)


def centred(reward: Float[Array, "*p G"]) -> Float[Array, "*p G"]:
    """R_i − R̄, by differences within the group, because the mean of rewards far from 0 rounds as they do."""
    near = reward - reward[..., :1]
    return near - jnp.mean(near, -1, keepdims=True)


def batch_advantage(reward: Float[Array, "P G"], *, epsilon: float = 1e-4) -> Float[Array, "P G"]:
    """Advantage within a group in units of the whole batch, A_i = (R_i − R̄_group)/(σ_batch + ε).

    σ_batch² is the mean variance of the groups whose rewards differ.  With a σ for each group, questions with similar
    rewards weigh more, which biases an unbiased reward: under ordinal credit debiased by the prior, rewards of a group
    with the middle label spread half as wide as those of others, so that over uniform labels and answers, "middle" has
    an advantage of .23 on average and either end one of −.11.  After REINFORCE++ (arXiv 2501.03262), whose
    mean is the batch's too.

    Args:
      reward: rewards of the rollouts of all groups.
      epsilon: added to σ.
    """
    equal = zero_variance(reward)
    sigma = jnp.sqrt(masked.mean(jnp.var(centred(reward), -1), ~equal))
    return jnp.where(equal[:, None], 0.0, centred(reward) / (sigma + epsilon))


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
