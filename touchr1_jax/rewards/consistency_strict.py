"""Cross-sensor agreement, weighted by the correctness of the answer minus its prior probability."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from touchr1_jax import masked
from touchr1_jax.rewards.accuracy_debiased import at_level, checked_prior
from touchr1_jax.rewards.base import Reward
from touchr1_jax.rewards.consistency import agreement, consistency_applies
from touchr1_jax.types import Parsed, Target


def consistency_strict(prior: np.ndarray) -> Reward:
    """Make the mean over asked ordinal attributes of agreement · 1[p_c = ŷ] · (1[ŷ = y] − p(ŷ)).

    p_c is the level in `compare`, ŷ the conclusion, p(k) the share of level k among the training labels.  Slots that
    support another conclusion earn nothing, and a constant answer earns 0 on average: with the gate 1[ŷ = y] it
    earns p(ŷ), more than honest reports of touch that are right in 40 %.  If the conclusion cannot be read, the reward
    is −max_k p(k), the least of all answers.  A departure from the paper; copies of a conclusion that touch supports
    still earn the reward.

    Args:
      prior: float [A, K], as for `accuracy_debiased`.

    Raises:
      ValueError: as `accuracy_debiased`.
    """
    prior = checked_prior(prior)

    def value(parsed: Parsed, target: Target) -> Float[Array, ""]:
        answer = parsed.conclude
        lead = (answer == target.label) - at_level(jnp.asarray(prior), answer)
        supported = agreement(parsed, target) * (parsed.compare == answer)
        earned = jnp.where(parsed.formatted & (answer >= 0), supported * lead, -jnp.max(prior, axis=1))
        return masked.mean(jnp.where(target.label < 0, 0.0, earned), target.asked & target.ordinal)

    return Reward(value, consistency_applies)
