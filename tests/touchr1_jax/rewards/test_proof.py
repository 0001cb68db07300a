"""Rewards at the corners of what can be answered, asked and perceived: all finite, or named before training."""

import dataclasses
import itertools
import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.rewards import GroupReward, HostReward, Reward, RewardError, make_rewards, proof, uniform_prior
from touchr1_jax.rewards.proof import prove_rewards

S, A = 4, 4
LEVELS = 3, 3, 3, 9


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
    prove_rewards(rewards, rewards, sensors, levels)


@pytest.mark.parametrize(
    "reward",
    [
        Reward(lambda p, t: jnp.log(p.length / 20)),
        Reward(lambda p, t: jnp.sum(1.0 * t.label * t.asked) / jnp.sum(t.asked)),
        Reward(spread_of_sensors),
        Reward(lambda p, t: 1.0 / (2.0 - 1.0 * p.truncated - 1.0 * p.formatted)),
        GroupReward(spread_of_group),
    ],
    ids=["no tokens", "nothing asked", "one sensor", "cut off and formatted", "alone"],
)
def test_a_reward_that_is_not_finite_somewhere_is_named(reward):
    with pytest.raises(RewardError, match=r"reward 'mine' is (nan|-?inf) for .*: must be finite everywhere"):
        prove_rewards({"mine": reward}, ["mine"], S, LEVELS)


def test_corners_are_those_of_the_docstring():
    targets, answers = proof._targets(S, A), proof._answers(S, A)
    sizes = itertools.product((0, 1, A), (2, 3, 9), (False, True), (0, 1, 2, S))
    parts = (targets.asked.sum(-1), targets.label[:, 0], targets.levels[:, 0], targets.ordinal[:, 0])
    found = zip(*(np.asarray(x).tolist() for x in (*parts, targets.streams.sum(-1))), strict=True)
    assert set(found) == {(a, x, k, o, n) for a, k, o, n in sizes for x in (-1, 0, k - 1)}
    perceived = {"⊥": (-1, -1, -1, -1), "lowest": (0, 0, 0, 0), "at odds": (0, 1, 0, 1), "highest": (2, 2, 2, 2)}
    parts = (answers.perceive[:, :, 0], answers.conclude[:, 0], answers.formatted, answers.truncated, answers.length)
    found = zip(*(np.asarray(x).tolist() for x in parts), strict=True)
    bools = (False, True)
    assert {(tuple(x), *rest) for x, *rest in found} == {
        (x, x[1], *rest) for x, *rest in itertools.product(perceived.values(), bools, bools, (0, 1, 20))
    }


def test_a_reward_on_the_host_is_not_called_before_training():
    prove_rewards({"mine": HostReward(lambda text, parsed, target: np.nan)}, ["mine"], S, LEVELS)


CALLS = itertools.count(1)


@pytest.mark.parametrize(
    "reward",
    [
        Reward(lambda p, t: random.random() * p.formatted),
        Reward(lambda p, t: p.length / next(CALLS)),
        GroupReward(lambda tokens, p, t: jnp.asarray(np.random.default_rng().random(len(tokens)), jnp.float32)),
    ],
    ids=["a random number", "a counter", "random numbers of a group"],
)
def test_a_reward_that_is_not_pure_is_named(reward):
    """A step would trace it once: every answer of a whole run would get the same random number."""
    with pytest.raises(RewardError, match="reward 'mine' is another function each time: must be pure"):
        prove_rewards({"mine": reward}, ["mine"], S, LEVELS)


@pytest.mark.parametrize(
    ("reward", "wrong"),
    [
        (
            Reward(lambda p, t: 1.0 * (p.perceive[2, 0] == t.label[0])),
            "index 2 is out of bounds for axis 0 with size 2",
        ),
        (Reward(lambda p, t: 1.0 * t.asked[A]), "index 4 is out of bounds for axis 0 with size 4"),
        (GroupReward(lambda tokens, p, t: 1.0 * p.conclude[:, A]), "index 4 is out of bounds for axis 1 with size 4"),
    ],
    ids=["a sensor", "an attribute", "an attribute of a group"],
)
def test_an_index_beyond_the_end_is_named(reward, wrong):
    """JAX would read the last element."""
    with pytest.raises(RewardError, match=f"reward 'mine': {wrong}: must lie inside.*bound it by jnp.clip"):
        prove_rewards({"mine": reward}, ["mine"], 2, LEVELS)


@pytest.mark.parametrize("kind", [Reward, GroupReward])
def test_levels_may_be_looked_up(kind):
    """A table that lacks the levels of one attribute is refused, where JAX would read the last of those that it has."""
    short, whole = jnp.array([[0.0, 0.5, 1.0]] * A), jnp.zeros((A, 9))
    looked_up = lambda table: kind(lambda *of: table[jnp.argmax(of[-1].asked), of[-2].conclude[..., -1]])
    prove_rewards({"mine": looked_up(whole)}, ["mine"], S, LEVELS)
    prove_rewards({"mine": looked_up(short)}, ["mine"], S, (3,) * A)
    with pytest.raises(RewardError, match=r"index 8 is out of bounds for axis 1 with size 3: .* of 3, 3, 3, 9 levels"):
        prove_rewards({"mine": looked_up(short)}, ["mine"], S, LEVELS)


def test_what_a_reward_states_of_other_elements_is_not_refused():
    """`mode="clip"` states it; material is no ordinal attribute, whose levels alone need the table."""
    price = jnp.array([0.0, 0.5, 1.0])
    ordinal = Reward(lambda p, t: jnp.sum(price[jnp.where(t.ordinal, p.conclude, 0)]))
    clipped = Reward(lambda p, t: jnp.sum(jnp.take(price, p.conclude, mode="clip")))
    prove_rewards({"mine": ordinal}, ["mine"], S, LEVELS, ordinal=(True, True, True, False))
    prove_rewards({"mine": clipped}, ["mine"], S, LEVELS)
    with pytest.raises(RewardError, match="index 8 is out of bounds for axis 0 with size 3"):
        prove_rewards({"mine": ordinal}, ["mine"], S, LEVELS)


def test_an_index_by_the_longest_answer_is_checked():
    price = jnp.array([0.0, -0.5, -1.0])
    by_length = Reward(lambda p, t: price[jnp.searchsorted(jnp.array([5, 10, 15]), p.length)])
    with pytest.raises(RewardError, match="index 3 is out of bounds for axis 0 with size 3"):
        prove_rewards({"mine": by_length}, ["mine"], S, LEVELS)


def test_a_reward_that_fails_in_a_group_of_one_says_so():
    rank = GroupReward(lambda tokens, p, t: jnp.argsort(jnp.argsort(p.length)) / (len(p.length) - 1))
    with pytest.raises(RewardError, match=r"reward 'mine' is nan for .* in a group of one against"):
        prove_rewards({"mine": rank}, ["mine"], S, LEVELS)


@pytest.mark.long
def test_random_numbers_of_a_fixed_key_are_pure():
    """The key is a constant of the program, of a type that NumPy does not have."""
    drawn = Reward(lambda p, t: jax.random.uniform(jax.random.fold_in(jax.random.key(0), p.length)))
    prove_rewards({"mine": drawn}, ["mine"], S, LEVELS)


@pytest.mark.long
@pytest.mark.parametrize(
    ("segment", "value"),
    [
        ("perceive", lambda p, t: 1.0 * (p.compare[0] == 1)),
        ("compare", lambda p, t: 1.0 * (p.conclude[0] == t.label[0])),
        ("compare", lambda p, t: jnp.where(p.truncated, 0.0, 1.0 * p.perceive[0, 0])),
    ],
)
def test_a_reward_is_known_where_it_is_settled(segment, value):
    prove_rewards({"mine": Reward(lambda p, t: 1.0 * p.perceive[0, 0], settled=segment)}, ["mine"], S, LEVELS)
    with pytest.raises(RewardError, match=f"reward 'mine' is settled by '{segment}', but what follows changes it"):
        prove_rewards({"mine": Reward(value, settled=segment)}, ["mine"], S, LEVELS)


@dataclasses.dataclass
class Brevity:
    """A reward with a setting, as people write it: equal ones are equal, so that it has no hash."""

    longest: int = 20

    def __call__(self, parsed, target):
        return 1.0 - parsed.length / self.longest


@dataclasses.dataclass(frozen=True)
class Prices:
    """A reward with an array, which has no hash either."""

    of: np.ndarray

    def __call__(self, parsed, target):
        return jnp.asarray(self.of)[0] * parsed.formatted


@pytest.mark.parametrize(("reward", "has_none"), [(Brevity(), "Brevity"), (Prices(np.ones(1)), "numpy.ndarray")])
def test_a_reward_without_a_hash_is_named(reward, has_none):
    said = rf"reward 'mine': unhashable type: '{has_none}', must have a hash.*write @dataclass\(eq=False\)"
    with pytest.raises(RewardError, match=said):
        prove_rewards({"mine": Reward(reward)}, ["mine"], S, LEVELS)
