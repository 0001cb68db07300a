"""Rewards are tried before a study makes anything."""

import pytest

from experiments.policies import assembly
from experiments.policies.assembly import prove_rewards
from experiments.policies.scores import PUBLISHED
from touchr1_jax.rewards import Reward, RewardError


def test_the_published_rewards_pass():
    prove_rewards({"published": PUBLISHED})


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (Reward(lambda p, t: p.conclude * 1.0), r"reward 'mine': value has type float32\[4\]"),
        (Reward(lambda p, t: 1.0 / p.length), r"reward 'mine' is inf .*must be finite everywhere"),
    ],
)
def test_a_reward_that_does_not_fit_is_named_with_its_arm(monkeypatch, reward, message):
    monkeypatch.setattr(assembly, "make_rewards", lambda prior: {"mine": reward})
    with pytest.raises(RewardError, match=rf"{message}.* \(in the weights of arm 'good', {{'mine': 0.5}}\)"):
        prove_rewards({"good": {"mine": 0.5}})


def test_an_unknown_reward_is_answered_with_the_known_ones():
    with pytest.raises(RewardError, match=r"no reward is called 'brevty'; choose from accuracy.* of arm 'mine'"):
        prove_rewards({"published": PUBLISHED, "mine": {"brevty": 1.0}})
