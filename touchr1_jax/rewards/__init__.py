"""The rewards: one file each, and one line each in the dictionary below."""

import numpy as np

from touchr1_jax.rewards.accuracy import accuracy
from touchr1_jax.rewards.accuracy_debiased import accuracy_debiased, uniform_prior
from touchr1_jax.rewards.base import (
    AnyReward,
    GroupReward,
    HostReward,
    Reward,
    RewardError,
    check_weights,
    total_reward,
)
from touchr1_jax.rewards.consistency import consistency, consistency_applies
from touchr1_jax.rewards.consistency_gated import consistency_gated
from touchr1_jax.rewards.exact import exact
from touchr1_jax.rewards.formatted import formatted

__all__ = [
    "AnyReward",
    "GroupReward",
    "HostReward",
    "Reward",
    "RewardError",
    "check_weights",
    "make_rewards",
    "total_reward",
    "uniform_prior",
]


def make_rewards(prior: np.ndarray) -> dict[str, AnyReward]:
    """All rewards by name, for `total_reward` to choose from.

    Args:
      prior: float [A, K], frequency of each level as label in training (see `accuracy_debiased`).
    """
    return {
        "accuracy": Reward(accuracy),
        "exact": Reward(exact),
        "accuracy_debiased": accuracy_debiased(prior),
        "consistency": Reward(consistency, consistency_applies),
        "consistency_gated": Reward(consistency_gated, consistency_applies),
        "format": Reward(formatted),
    }
