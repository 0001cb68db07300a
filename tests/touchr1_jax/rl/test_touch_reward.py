"""The reward of a trajectory by hand, and what is found wrong with a reward before training."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.explored import BANK, POLICY
from touchr1_jax.rewards import RewardError
from touchr1_jax.rl.environment import check_environment
from touchr1_jax.rl.touch_reward import Prices, Spent, check_touch_reward, check_touching_pays, priced_answer
from touchr1_jax.training.exploration import touch_batch_of
from touchr1_jax.types import Parsed

FREE = Prices(jnp.float32(0), jnp.float32(0))
EVERY = touch_batch_of(POLICY, BANK, np.repeat(np.arange(4), 2), np.tile([0, 1], 4))


@pytest.fixture(scope="module")
def outcome():
    return check_environment(BANK, EVERY.case, budget=1)


def parsed(level: int) -> Parsed:
    answer, some = jnp.full(2, level), jnp.array(level >= 0)
    return Parsed(
        perceive=answer[None], compare=answer, conclude=answer, formatted=some, truncated=~some, length=jnp.array(0)
    )


@pytest.mark.parametrize(("level", "answer"), [(2, 1.0), (0, 0.0), (-1, -0.1)])
def test_hand_values(level, answer):
    target = POLICY.target(np.array([1]), np.array([[0, 2]]))
    one = type(target)(**{name: jnp.asarray(x[0]) for name, x in vars(target).items()})
    spent = Spent(jnp.float32(3), jnp.float32(2), jnp.int32(1))
    terms = priced_answer(parsed(level), one, spent, Prices(jnp.float32(0.1), jnp.float32(0.25)))
    assert {name: float(x) for name, x in terms.items()} == pytest.approx(
        {"answer": answer, "seconds": -0.3, "harm": -0.5}
    )


def test_the_published_reward_is_finite_and_pays(outcome):
    check_touch_reward(priced_answer, FREE, EVERY.target, outcome)
    check_touching_pays(priced_answer, FREE, EVERY.target, outcome)


FAULTS = {
    "'bad' of the reward is nan": lambda p, t, s, c: {"bad": jnp.where(p.formatted, 1.0, jnp.nan)},
    "'bad' of the reward is inf": lambda p, t, s, c: {"bad": 1 / (1 - s.actions)},
    "float scalar": lambda p, t, s, c: {"bad": p.conclude},
    "dictionary": lambda p, t, s, c: s.seconds,
    "'std' is the name of a metric": lambda p, t, s, c: {"std": s.seconds},
    "the reward is another function each time": lambda p, t, s, c: {
        "luck": s.seconds * np.random.default_rng().random()
    },
    "the reward: .* 7 .*: must lie inside": lambda p, t, s, c: {"seventh": 1.0 * t.label[s.actions + 7]},
    "the reward: index 2 is .* size 2: must lie inside": lambda p, t, s, c: {"two": jnp.arange(2.0)[p.conclude[0]]},
}


@pytest.mark.parametrize("names", FAULTS)
def test_a_reward_that_is_no_number_is_named(outcome, names):
    with pytest.raises(RewardError, match=names):
        check_touch_reward(FAULTS[names], FREE, EVERY.target, outcome)


def test_a_reward_without_a_hash_is_named(outcome):
    @dataclasses.dataclass
    class Fixed:
        def __call__(self, parsed, target, spent, prices):
            return {"answer": jnp.float32(1)}

    with pytest.raises(RewardError, match="the reward: unhashable type: 'Fixed', must have a hash"):
        check_touch_reward(Fixed(), FREE, EVERY.target, outcome)


def test_a_reward_that_fails_after_the_second_action_is_named(outcome):
    reward = lambda parsed, target, spent, prices: {"bad": 1 / (2.0 - spent.actions)}
    check_touch_reward(reward, FREE, EVERY.target, outcome, budget=1)
    with pytest.raises(RewardError, match="'bad' of the reward is inf"):
        check_touch_reward(reward, FREE, EVERY.target, outcome, budget=2)


@pytest.mark.parametrize("price", [-1.0, jnp.nan, jnp.inf])
@pytest.mark.parametrize("name", Prices._fields)
def test_prices_that_are_no_price_are_named(outcome, name, price):
    with pytest.raises(RewardError, match=f"prices.{name}"):
        check_touch_reward(priced_answer, FREE._replace(**{name: jnp.float32(price)}), EVERY.target, outcome)


@pytest.mark.parametrize(("second", "harm"), [(0.2, 0), (1, 0), (2, 9)])
def test_prices_at_which_touching_never_pays_are_named(outcome, second, harm):
    """An action that observes nothing is no touch, though free; at 0.2 a touch costs half of the answer."""
    prices = Prices(jnp.float32(second), jnp.float32(harm))
    exists, seconds = np.array(outcome.exists), np.array(outcome.seconds)
    exists[:, 0], seconds[:, 0] = False, 0.0
    outcome = outcome._replace(exists=exists, seconds=seconds)
    with pytest.raises(RewardError, match="never pays"):
        check_touching_pays(priced_answer, prices, EVERY.target, outcome)
