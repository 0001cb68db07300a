"""Rewards are tried before a study makes anything."""

import dataclasses

import pytest

from experiments.study.scores import PUBLISHED
from experiments.study.study import check_arms
from sensors_io.schema import SENSORS
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.touch_policy import ModelConfig, check_model
from touchr1_jax.rewards import Reward, RewardError


def test_the_published_rewards_pass():
    check_arms({"published": PUBLISHED})


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (Reward(lambda p, t: p.conclude * 1.0), r"reward 'mine': value has type float32\[4\]"),
        (Reward(lambda p, t: 1.0 / p.length), r"reward 'mine' is inf .*must be finite everywhere"),
    ],
)
def test_a_reward_that_does_not_fit_is_named_with_its_arm(reward, message):
    with pytest.raises(RewardError, match=rf"{message}.* \(in the weights of arm 'good', {{'mine': 0.5}}\)"):
        check_arms({"good": {"mine": 0.5}}, {"mine": reward})


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("decoder", {"head_dim": 34}, r"no model can be built .* must be three that sum to head_dim/2 = 17"),
        ("tactile", {"frames_per_step": 3}, r"no model can be built .*4 per stream must divide into .* steps of 3"),
        ("tactile", {"patches_kept": 99}, r"no model can be built .* patches_kept is 99: must lie in 1\.\.16"),
    ],
)
def test_sizes_that_contradict_each_other_are_named_without_data(part, changes, message):
    model = ModelConfig()
    changed = dataclasses.replace(model, **{part: dataclasses.replace(getattr(model, part), **changes)})
    with pytest.raises(SizeError, match=message):
        check_model(changed, SENSORS)


def test_sizes_that_fit_are_built():
    check_model(dataclasses.replace(ModelConfig(), frames=3), SENSORS)


def test_an_unknown_reward_is_answered_with_the_known_ones():
    with pytest.raises(RewardError, match=r"no reward is called 'brevty'; choose from accuracy.* of arm 'mine'"):
        check_arms({"published": PUBLISHED, "mine": {"brevty": 1.0}})
