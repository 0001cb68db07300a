"""The rewards: each has one file and one line in the dictionary below."""

from collections.abc import Mapping

import numpy as np

from touchr1_jax.rewards.accuracy import accuracy
from touchr1_jax.rewards.accuracy_debiased import accuracy_debiased, uniform_prior
from touchr1_jax.rewards.accuracy_strict import accuracy_strict
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
from touchr1_jax.rewards.consistency_strict import consistency_strict
from touchr1_jax.rewards.diversity import diversity
from touchr1_jax.rewards.exact import exact
from touchr1_jax.rewards.format_strict import format_strict
from touchr1_jax.rewards.formatted import formatted
from touchr1_jax.rewards.overlong import overlong

__all__ = [
    "AnyReward",
    "GroupReward",
    "HostReward",
    "Reward",
    "RewardError",
    "check_weights",
    "make_rewards",
    "stable_weights",
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
        "accuracy_strict": accuracy_strict(prior),
        "consistency": Reward(consistency, consistency_applies, settled="compare"),
        "consistency_gated": Reward(consistency_gated, consistency_applies),
        "consistency_strict": consistency_strict(prior),
        "format": Reward(formatted),
        "format_strict": Reward(format_strict),
        "overlong": GroupReward(overlong),
        "diversity": GroupReward(diversity),
    }


STABLE: Mapping[str, str] = {
    "accuracy": "accuracy_strict",
    "accuracy_debiased": "accuracy_strict",
    "consistency": "consistency_strict",
    "consistency_gated": "consistency_strict",
    "format": "format_strict",
}
"""Reward → the one that takes its place under the `stable` algorithm; all others stay."""


def stable_weights(weights: Mapping[str, float]) -> dict[str, float]:
    """Weights of an arm under the `stable` algorithm: each reward is replaced according to `STABLE`."""
    found: dict[str, float] = {}
    for name, weight in weights.items():
        found[STABLE.get(name, name)] = found.get(STABLE.get(name, name), 0.0) + weight
    return found
