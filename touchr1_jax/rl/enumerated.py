"""Policy gradient with an enumerated conclusion: traces are sampled, the concluding level is not.

For trace i of a question, p_ik is the policy's probability of stating level k and r_ik the reward of that answer:

    E_i = Σ_k p_ik r_ik,   Ē = mean_i E_i,   J = mean_i E_i / n

The gradient of E_i with respect to p_ik is exact, so that stating a level adds no sampling noise and no group is
degenerate.  The tokens before it get the score-function gradient of A_i = (E_i − mean_{j≠i} E_j) / n.  The norm n is

    NONE 1      STD σ + ε, σ² = mean_i [Σ_k p_ik (r_ik − Ē)² + (1 − Σ_k p_ik) Ē²]      MEAN max(Ē, .02)

so that MEAN follows ∇ log Ē; a σ below 1e-5 is rounding, and n is 1.  Any other word in the place of a level earns
nothing.  A completion without a conclusion keeps its sampled reward as E_i, and all of its tokens are trace.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple, assert_never

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.rl.advantages import SPREAD_FLOOR
from touchr1_jax.rl.config import Norm
from touchr1_jax.rl.scoring import NONFINITE_IN, squares_fit
from touchr1_jax.text.template import LevelTokens
from touchr1_jax.types import Target

MEAN_FLOOR = 0.02
"""Smallest Ē that rewards are divided by."""


class LevelRewards(NamedTuple):
    """Rewards of the completions of P prompts for every level that they could conclude with.

    Attributes:
      ids: token of each level of the asked attribute, −1 past the last one.
      at: place of the level in each completion, T where it states none.
      reward: r, 0 past the last level and in groups that are left out.
      sampled: reward of the completion as it was sampled, 0 in groups that are left out.
    """

    ids: Int[Array, "P K"]
    at: Int[Array, "P G"]
    reward: Float[Array, "P G K"]
    sampled: Float[Array, "P G"]


class ExactTerms(NamedTuple):
    """For every rollout: E_i, the advantage A_i of its trace without gradient, and E_i / n with gradient."""

    expected: Float[Array, "*p G"]
    advantage: Float[Array, "*p G"]
    objective: Float[Array, "*p G"]


def level_rewards(
    reward_of: Callable[[Int[Array, "P G T"], Int[Array, ""]], Float[Array, "P G"]],
    levels: LevelTokens,
    tokens: Int[Array, "P G T"],
    target: Target,
    sampled: Float[Array, "P G"],
    finite: Bool[Array, "P"],
) -> tuple[LevelRewards, Bool[Array, "P"], dict[str, Float[Array, ""]]]:
    """Rewards of all completions with each level in turn as their conclusion; tokens after it stay as sampled.

    A group reward sees the same level in all completions: `diversity` pays only for traces that differ.

    Args:
      reward_of: rewards of groups of completions that conclude with one level, which their tokens contain.
      levels: token of each level, and the one that opens the conclusion.
      tokens: completions.
      target: of the prompts; one that asks for several attributes keeps its sampled rewards.
      sampled: rewards of the completions as they are.
      finite: prompts whose group counts; the rewards of others are 0.

    Returns:
      The rewards; the prompts that count, those of `finite` with a finite reward for every level, also for levels that
      no rollout stated; and `nonfinite_in_levels`, the share of the other prompts.
    """
    length = tokens.shape[-1]
    ids = jnp.asarray(levels.level, jnp.int32)[jnp.argmax(target.asked, -1)]  # P K
    at = conclusion_place(tokens, levels.opens)
    at = jnp.where((jnp.sum(target.asked, -1) == 1)[:, None], at, length)
    here = jnp.arange(length) == at[..., None]

    def with_level(level: tuple[Int[Array, ""], Int[Array, "P"]]) -> Float[Array, "P G"]:
        k, word = level
        reward = reward_of(jnp.where(here, jnp.maximum(word, 0)[:, None, None], tokens), k).astype(jnp.float32)
        return jnp.where((finite & (word >= 0))[:, None], reward, 0.0)

    reward = jnp.moveaxis(jax.lax.map(with_level, (jnp.arange(ids.shape[1]), ids.T)), 0, -1)
    known = finite & squares_fit(reward)
    kept = jnp.where(known[:, None], sampled, 0.0)
    found = LevelRewards(ids=ids, at=at, reward=jnp.where(known[:, None, None], reward, 0.0), sampled=kept)
    return found, known, {f"{NONFINITE_IN}levels": jnp.mean(finite & ~known)}


def conclusion_place(tokens: Int[Array, "*n T"], opens: int) -> Int[Array, "*n"]:
    """Place of the token after the tag that opens the conclusion; T where that tag does not occur exactly once."""
    hit = tokens == opens
    return jnp.where(jnp.sum(hit, -1) == 1, jnp.argmax(hit, -1) + 1, tokens.shape[-1]).astype(jnp.int32)


def exact_terms(
    norm: Norm,
    level_log_prob: Float[Array, "*p G K"],
    reward: Float[Array, "*p G K"],
    states: Bool[Array, "*p G"],
    sampled: Float[Array, "*p G"],
    *,
    epsilon: float = 1e-4,
) -> ExactTerms:
    """Terms of the module's formula for groups of G traces.

    Args:
      norm: n.
      level_log_prob: log p, −∞ for a level that does not exist.
      reward: r.
      states: whether the trace leads to a conclusion.
      sampled: E_i of a trace that does not.
      epsilon: ε.
    """
    p = jnp.exp(level_log_prob)
    expected = jnp.where(states, jnp.sum(p * reward, -1), sampled)
    fixed, group = jax.lax.stop_gradient(expected), expected.shape[-1]
    mean = jnp.mean(fixed, -1, keepdims=True)
    others = (group * mean - fixed) / (group - 1) if group > 1 else fixed
    n = jax.lax.stop_gradient(_norm(norm, p, reward, states, sampled, mean, epsilon))
    return ExactTerms(expected=fixed, advantage=(fixed - others) / n, objective=expected / n)


def _norm(
    norm: Norm, p: Array, reward: Array, states: Array, sampled: Array, mean: Array, epsilon: float
) -> Float[Array, "*p 1"]:
    match norm:
        case Norm.NONE:
            return jnp.ones_like(mean)
        case Norm.STD:
            other_words = (1 - jnp.sum(p, -1)) * mean**2
            spread = jnp.sum(p * (reward - mean[..., None]) ** 2, -1) + jnp.maximum(other_words, 0.0)
            spread = jnp.where(states, spread, (sampled - mean) ** 2)
            sigma = jnp.sqrt(jnp.mean(spread, -1, keepdims=True))
            return jnp.where(sigma < SPREAD_FLOOR, 1.0, sigma + epsilon)  # else rounding alone makes advantages
        case Norm.MEAN:
            return jnp.maximum(mean, MEAN_FLOOR)
        case _:
            assert_never(norm)


def expected_of_kept(parts: Mapping[str, Array], finite: Bool[Array, "P"]) -> dict[str, Array]:
    """Parts of a loss with the mean E_i over the groups that are not left out; E_i of the others is 0."""
    share = jnp.maximum(jnp.mean(finite), 1 / len(finite))
    return {name: x / share if name == "expected_reward" else x for name, x in parts.items()}


def conclude_exactly(
    objective: Float[Array, "*p G T"], concluded: Float[Array, "*p G t"], at: Int[Array, "*p G"]
) -> Float[Array, "*p G T"]:
    """The objective of every token, replaced at the place of the level and 0 after it."""
    place, at = jnp.arange(objective.shape[-1]), at[..., None]
    return jnp.where(place < at, objective, jnp.where(place == at, concluded, 0.0))


def before_level(mask: Bool[Array, "*p G T"], at: Int[Array, "*p G"]) -> Bool[Array, "*p G T"]:
    """The existing tokens that belong to the traces."""
    return mask & (jnp.arange(mask.shape[-1]) < at[..., None])


def all_equal(levels: LevelRewards, floor: float) -> Bool[Array, "P"]:
    """Prompts whose completions earn the same with every level, up to `floor`, so that there is nothing to learn."""
    exists = (levels.ids >= 0)[:, None]
    low = jnp.min(jnp.where(exists, levels.reward, jnp.inf), (-2, -1))
    high = jnp.max(jnp.where(exists, levels.reward, -jnp.inf), (-2, -1))
    return high - low < floor
