"""Accuracy with ordinal credit under which every constant answer earns the same."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.rewards.accuracy import credit
from touchr1_jax.rewards.base import Reward
from touchr1_jax.types import Parsed, Target

PRIOR_TOLERANCE = 1e-3
"""Largest error of the sum of an attribute's probabilities."""


def accuracy_debiased(prior: np.ndarray) -> Reward:
    """Make R = R_acc(ŷ, y) − (r̄(ŷ) − mean_k r̄(k)) with r̄(k) = Σ_y p(y) R_acc(k, y).

    Ordinal credit favours the middle level: on uniform labels a constant "middle" earns .60, a constant end .467.  Here
    every constant earns mean_k r̄(k).  Unparsable answers keep their credit.  A departure from the paper.

    Args:
      prior: float [A, K], frequency of each level of an attribute as label in training; 0 past an attribute's levels.

    Raises:
      ValueError: a prior that is not [A, K], negative, or whose rows do not sum to 1.
    """
    prior = checked_prior(prior)

    def value(parsed: Parsed, target: Target) -> Float[Array, ""]:
        answer = parsed.conclude
        expected, exists = constant_earnings(prior, target)
        own = at_level(expected, answer)
        bias = jnp.where((answer < 0) | (target.label < 0), 0.0, own - masked.mean(expected, exists, axis=1))
        earned = credit(answer, target.label, target.levels, target.ordinal)
        return masked.mean(earned - bias, target.asked)

    return Reward(value)


def uniform_prior(levels: Sequence[int]) -> np.ndarray:
    """A prior under which all levels of an attribute are equally likely, float32 [A, K]; `levels` is K of each."""
    return np.array([[1 / k if level < k else 0.0 for level in range(max(levels))] for k in levels], np.float32)


def checked_prior(prior: np.ndarray) -> np.ndarray:
    """The prior as float32.

    Raises:
      ValueError: a prior that is not [A, K], negative, or whose rows do not sum to 1.
    """
    prior = np.asarray(prior, np.float32)
    if prior.ndim != 2:
        raise ValueError(f"prior has shape {prior.shape}: must be [A, K]; give one row per attribute")
    for a, row in enumerate(prior):
        if not (np.all(row >= 0) and abs(row.sum() - 1) <= PRIOR_TOLERANCE):
            raise ValueError(
                f"prior[{a}] is {row.tolist()}: must be ≥ 0 and sum to 1; count the training labels, "
                "and give an attribute without labels a uniform row"
            )
    return prior


def at_level(table: Float[Array, "A K"], level: Int[Array, "A"]) -> Float[Array, "A"]:
    """Entry of each attribute at a level; if the level is ⊥, the entry at level 0."""
    return jnp.take_along_axis(table, jnp.maximum(level, 0)[:, None], axis=1, mode="clip")[:, 0]


def constant_earnings(prior: np.ndarray, target: Target) -> tuple[Float[Array, "A K"], Bool[Array, "A K"]]:
    """Mean credit r̄(k) of the constant answer k, and a mask of the levels of each attribute, both [A, K]."""
    level = jnp.arange(prior.shape[1])
    levels, ordinal = target.levels[:, None, None], target.ordinal[:, None, None]
    table = credit(level[:, None], level, levels, ordinal)  # [A, K answered, K true]
    exists = level < target.levels[:, None]
    return jnp.sum(table * prior[:, None, :], axis=-1), exists
