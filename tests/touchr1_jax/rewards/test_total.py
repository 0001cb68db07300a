import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.rewards.examples import constant, make_parsed, make_target
from touchr1_jax.rewards import Reward, RewardError, check_weights, make_rewards, total_reward

PRIOR = np.array([[1 / 3] * 3 + [0] * 6, [1 / 3] * 3 + [0] * 6, [1 / 9] * 9])
REWARDS = make_rewards(PRIOR)
ALONE = [name for name, reward in REWARDS.items() if isinstance(reward, Reward)]
"""Rewards of one answer by itself; those of groups are tested where they are scored."""
WEIGHTS = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}


def total(weights, parsed, target, rewards=REWARDS):
    value, parts = total_reward(rewards, weights, parsed, target)
    np.testing.assert_allclose(value, sum(parts.values()), rtol=1e-6)
    assert parts.keys() == weights.keys()
    return float(value), {name: float(part) for name, part in parts.items()}


def test_weighted_sum():
    parsed = make_parsed(conclude=(1, 0, 0), compare=(1, 0, 0), perceive=(0, 1, 2), formatted=True)
    value, parts = total(WEIGHTS, parsed, make_target(label=(0, 0, 0)))
    assert parts == pytest.approx({"accuracy": 0.6 * 0.4, "consistency": 0.3 * 2 / 3, "format": 0.1})
    assert value == pytest.approx(0.54)


@pytest.mark.parametrize("target", [make_target(streams=(0, 1, 0)), make_target(asked=(0, 0, 1))])
def test_undefined_term_is_dropped_and_the_others_grow(target):
    value, parts = total(WEIGHTS, constant(0), target)
    assert value == pytest.approx(1)
    assert parts == pytest.approx({"accuracy": 6 / 7, "consistency": 0, "format": 1 / 7})


def test_nothing_applies():
    assert total({"consistency": 1.0}, constant(0), make_target(streams=(1, 0, 0))) == (0, {"consistency": 0})


def test_the_sum_of_the_weights_is_kept():
    check_weights(REWARDS, {"accuracy": 1e-9, "format": 1e9})
    for target in (make_target(), make_target(streams=(1, 0, 0))):
        assert total({name: 3 * w for name, w in WEIGHTS.items()}, constant(0), target)[0] == pytest.approx(3)


@pytest.mark.parametrize("kind", [jnp.float16, jnp.bfloat16, jnp.float32])
def test_a_weight_is_not_rounded_to_the_type_of_a_reward(kind):
    rewards = {"mine": Reward(lambda p, t: jnp.ones((), kind))}
    for weight in (0.3, 1e-9, 1e6):
        assert total({"mine": weight}, constant(0), make_target(), rewards)[1]["mine"] == np.float32(weight)


@pytest.mark.parametrize("name", ALONE)
def test_every_reward_is_a_scalar(name):
    parsed, target = constant(0), make_target()
    assert jax.eval_shape(REWARDS[name].value, parsed, target) == jax.ShapeDtypeStruct((), jnp.float32)
    assert jax.eval_shape(REWARDS[name].applies, target) == jax.ShapeDtypeStruct((), jnp.bool_)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"acuracy": 1.0}, r"no reward is called 'acuracy'; choose from accuracy, accuracy_debiased, accuracy_strict"),
        ({"kl": 1.0}, r"'kl' is the name of a metric of the engine; call the reward otherwise"),
        ({"accuracy": -1.0}, r"weights\[accuracy\] is -1\.0: must be finite and ≥ 0"),
        ({"accuracy": float("nan")}, r"weights\[accuracy\] is nan: must be finite"),
        ({"accuracy": 0.9e-9}, r"weights\[accuracy\] is 9e-10: must be finite and ≥ 0, and 1e-09 … "),
        ({"accuracy": 1.1e9}, r"weights\[accuracy\] is 1100000000\.0: must be finite"),
        ({"accuracy": 0.0}, r"at least one must be above 0"),
        ({}, r"weights is \{\}: at least one"),
    ],
)
def test_bad_weights_are_named(weights, message):
    with pytest.raises(RewardError, match=message):
        total(weights, constant(0), make_target())


def test_a_bare_function_in_the_dictionary_is_named():
    with pytest.raises(RewardError, match=r"rewards\[mine\] is <function .*: must be a Reward; write Reward\("):
        check_weights({"mine": lambda p, t: jnp.ones(())}, {"mine": 1.0})


def test_a_segment_that_there_is_not_is_named():
    with pytest.raises(
        RewardError, match=r"rewards\[mine\].settled is 'concluded': must be one of perceive, compare, con"
    ):
        check_weights({"mine": Reward(lambda p, t: jnp.ones(()), settled="concluded")}, {"mine": 1.0})


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (Reward(lambda p, t: p.conclude * 1.0), r"reward 'mine': value has type float32\[3\], must be float\[\]"),
        (Reward(lambda p, t: p.formatted), r"reward 'mine': value has type bool\[\], must be float\[\]"),
        (Reward(lambda p, t: p.length), r"reward 'mine': value has type int32\[\], must be float\[\]"),
        (
            Reward(lambda p, t: jnp.ones(()), lambda t: t.asked),
            r"reward 'mine': applies has type bool\[3\], must be bool",
        ),
        (
            Reward(lambda p, t: jnp.ones(()), lambda t: 1.0),
            r"reward 'mine': applies has type float32\[\], must be bool",
        ),
        (Reward(lambda p, t: None), r"reward 'mine': value is None, must be float\[\]; return one number"),
        (
            Reward(lambda p, t: 1.0 if p.length > 5 else 0.0),
            r"reward 'mine': value cannot be traced, .*test_total\.py:\d+ needs .*jnp\.where .*HostReward",
        ),
        (Reward(lambda p, t: np.mean(np.asarray(p.conclude))), r"reward 'mine': value cannot be traced, .*jnp instead"),
        (Reward(lambda p, t: [0.1, 0.2, 1.0][p.conclude[0]]), r"reward 'mine': value cannot be traced, .*jnp instead"),
    ],
)
def test_bad_rewards_fail_when_traced(reward, message):
    with pytest.raises(RewardError, match=message):
        jax.eval_shape(lambda p, t: total_reward({"mine": reward}, {"mine": 1.0}, p, t), constant(0), make_target())


def test_an_error_inside_a_reward_says_whose_it_is():
    slip = Reward(lambda p, t: p.lenght)
    with pytest.raises(AttributeError, match=r"has no attribute 'lenght'") as caught:
        total_reward({"mine": slip}, {"mine": 1.0}, constant(0), make_target())
    assert caught.value.__notes__ == ["raised by reward 'mine', its value"]
