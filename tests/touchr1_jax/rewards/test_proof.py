"""Rewards at the corners of what can be answered, asked and felt: all finite, or named before training."""

import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.rewards import GroupReward, HostReward, Reward, RewardError, make_rewards, uniform_prior
from touchr1_jax.rewards.proof import prove_rewards

S, A = 4, 4


def spread_of_sensors(parsed, target):
    """Sample variance of the sensors' levels, ÷ (n − 1): undefined for one sensor."""
    n = jnp.sum(target.streams)
    level = jnp.where(target.streams, parsed.perceive[:, 0], 0)
    return jnp.sum(target.streams * (level - jnp.sum(level) / jnp.maximum(n, 1)) ** 2) / (n - 1)


def spread_of_group(tokens, parsed, target):
    """Sample standard deviation of the lengths: undefined for a group of one."""
    return jnp.std(parsed.length * 1.0, ddof=1) + 0.0 * parsed.length


@pytest.mark.long
@pytest.mark.parametrize(("levels", "sensors"), [((3, 3, 3, 9), S), ((2, 2, 2, 2), 1), ((2, 3, 5, 9), 2)])
def test_every_reward_of_the_package_is_finite(levels, sensors):
    rewards = make_rewards(uniform_prior(levels))
    prove_rewards(rewards, rewards, sensors, len(levels))


@pytest.mark.parametrize(
    "reward",
    [
        Reward(lambda p, t: jnp.log(p.length / 20)),
        Reward(lambda p, t: jnp.sum(1.0 * t.label * t.asked) / jnp.sum(t.asked)),
        Reward(spread_of_sensors),
        Reward(lambda p, t: 1.0 / (t.levels[0] - 2)),
        Reward(lambda p, t: jnp.sqrt(t.label[0] * 1.0)),
        Reward(lambda p, t: 1.0 / (2.0 - 1.0 * p.truncated - 1.0 * p.formatted)),
        GroupReward(spread_of_group),
    ],
    ids=["no tokens", "nothing asked", "one sensor", "two levels", "unknown label", "cut off and formatted", "alone"],
)
def test_a_reward_that_is_not_finite_somewhere_is_named(reward):
    with pytest.raises(RewardError, match=r"reward 'mine' is (nan|-?inf) for .*: must be finite everywhere"):
        prove_rewards({"mine": reward}, ["mine"], S, A)


def test_a_reward_on_the_host_is_not_called_before_training():
    prove_rewards({"mine": HostReward(lambda text, parsed, target: np.nan)}, ["mine"], S, A)
