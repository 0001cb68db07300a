"""Debiased accuracy that gives an unreadable answer less than the worst miss."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from touchr1_jax import masked
from touchr1_jax.rewards.accuracy import UNPARSABLE, credit
from touchr1_jax.rewards.accuracy_debiased import at_level, checked_prior, constant_earnings
from touchr1_jax.rewards.base import Reward
from touchr1_jax.types import Parsed, Target


def accuracy_strict(prior: np.ndarray) -> Reward:
    """Make R = R_acc(ŷ, y) − (r̄(ŷ) − mean_k r̄(k)), and −.1 − (max_k r̄(k) − mean_k r̄(k)) for what cannot be read.

    r̄(k) is what the constant answer k earns (see `accuracy_debiased`).  An answer cannot be read if it is not
    formatted or its conclusion is ⊥; it then earns .1 less than the worst miss under any prior.  Under
    `accuracy_debiased`, abstaining earns more than missing a common level.  A departure from the paper.

    Args:
      prior: float [A, K], as for `accuracy_debiased`.

    Raises:
      ValueError: as `accuracy_debiased`.
    """
    prior = checked_prior(prior)

    def value(parsed: Parsed, target: Target) -> Float[Array, ""]:
        expected, exists = constant_earnings(prior, target)
        mean = masked.mean(expected, exists, axis=1)
        lowest = UNPARSABLE - (masked.maximum(expected, exists, axis=1, empty=0.0) - mean)
        right = credit(parsed.conclude, target.label, target.levels, target.ordinal)
        can_be_read = parsed.formatted & (parsed.conclude >= 0)
        earned = jnp.where(can_be_read, right - (at_level(expected, parsed.conclude) - mean), lowest)
        return masked.mean(jnp.where(target.label < 0, 0.0, earned), target.asked)

    return Reward(value)
