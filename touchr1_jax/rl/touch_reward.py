"""The reward of a trajectory: that of its answer minus the price of its time and of its harm."""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from touchr1_jax.rewards.base import RESERVED, RewardError
from touchr1_jax.rewards.exact import exact
from touchr1_jax.rewards.proof import require_hash, require_pure
from touchr1_jax.rl.environment import Outcome
from touchr1_jax.types import Parsed, Target


class Spent(NamedTuple):
    """Totals of one trajectory."""

    seconds: Float[Array, ""]
    harm: Float[Array, ""]
    actions: Int[Array, ""]


class Prices(NamedTuple):
    """Reward that a second and a unit of harm cost; arrays, so that one program serves a sweep."""

    second: Float[Array, ""]
    harm: Float[Array, ""]


TouchReward = Callable[[Parsed, Target, Spent, Prices], dict[str, Float[Array, ""]]]
"""(answer, truth, totals, prices) of one trajectory → named terms; the reward is their sum."""


def priced_answer(parsed: Parsed, target: Target, spent: Spent, prices: Prices) -> dict[str, Float[Array, ""]]:
    """1 for the right answer, 0 for a wrong one, −0.1 for none; less price × seconds and price × harm."""
    return {
        "answer": exact(parsed, target),
        "seconds": -prices.second * spent.seconds,
        "harm": -prices.harm * spent.harm,
    }


def check_touch_reward(reward: TouchReward, prices: Prices, target: Target, outcome: Outcome, budget: int = 1) -> None:
    """Compute the rewards of all constant answers and of no answer: before any action, after each, after slow ones.

    Args:
      reward, prices: those of training.
      target: truth of n prompts.
      outcome: of every action in the n prompts (`environment.check_environment`).
      budget: most actions of a trajectory.

    Raises:
      RewardError: a price below 0 or not finite, a reward that is no dictionary of float scalars, has a term of a
        metric's name, is not finite, is not pure, looks up beyond an array, or has no hash.
    """
    for name, price in prices._asdict().items():
        if not 0 <= float(price) < np.inf:
            raise RewardError(f"prices.{name} is {float(price)}: must be finite and ≥ 0; correct it")
    require_hash("the reward", reward)
    one, nothing = (jax.tree.map(lambda x: np.asarray(x)[0], tree) for tree in (target, _after(outcome, -1)))
    each = ((level, one, nothing, prices) for level in (0 * one.levels, one.levels - 1))
    require_pure("the reward", functools.partial(_terms, reward), *each)
    slowest = _after(outcome, np.argmax(outcome.seconds, -1))
    spent = [_after(outcome, action) for action in range(-1, outcome.seconds.shape[1])]
    spent += [Spent(*(times * total for total in slowest)) for times in range(2, budget + 1)]
    for totals, level in itertools.product(spent, range(-1, int(np.max(target.levels)))):
        _earned(reward, prices, target, np.full(target.label.shape, level, np.int32), totals)


def check_touching_pays(reward: TouchReward, prices: Prices, target: Target, outcome: Outcome) -> None:
    """Compare the right answer after the cheapest action with the best constant answer before any.

    Args:
      reward, prices, target, outcome: as in `check_touch_reward`, with enough prompts to find the best constant.

    Raises:
      RewardError: no question for which the right answer earns more, so that a policy can only learn not to touch.
    """
    observes = np.any(outcome.exists, axis=-1)
    cost = np.where(observes, prices.second * outcome.seconds + prices.harm * outcome.harm, np.inf)
    levels = range(int(np.max(target.levels)))
    constant = lambda k: _earned(reward, prices, target, np.full(target.label.shape, k, np.int32), _after(outcome, -1))
    constants = np.stack([constant(k) for k in levels])
    right = _earned(reward, prices, target, np.asarray(target.label), _after(outcome, cost.argmin(-1)))
    for a in range(target.asked.shape[1]):
        here = np.asarray(target.asked[:, a] & (target.label[:, a] >= 0))
        if here.any() and right[here].mean() > constants[:, here].mean(1).max():
            return
    raise RewardError(
        f"prices are {float(prices.second)} a second and {float(prices.harm)} a unit of harm: the best constant answer "
        "earns at least as much as the right answer after the cheapest touch, so that touching never pays; lower them"
    )


def _after(outcome: Outcome, action: int | np.ndarray) -> Spent:
    """Totals of every prompt after one action, or after none (−1)."""
    action = np.broadcast_to(action, len(outcome.seconds))
    of = lambda x: jnp.where(action < 0, 0.0, np.asarray(x)[np.arange(len(x)), np.maximum(action, 0)])
    return Spent(of(outcome.seconds), of(outcome.harm), jnp.asarray(action >= 0, jnp.int32))


def _earned(reward: TouchReward, prices: Prices, target: Target, level: np.ndarray, spent: Spent) -> np.ndarray:
    """Reward of every prompt for answers [n, A], after a check that it is finite."""
    terms = jax.vmap(lambda k, t, s: _terms(reward, k, t, s, prices))(jnp.asarray(level), target, spent)
    for name, term in terms.items():
        if not np.isfinite(term).all():
            raise RewardError(
                f"term {name!r} of the reward is {np.asarray(term)[~np.isfinite(term)][0]} for some answer: must be "
                "finite everywhere; choose with jnp.where before you divide or take logarithms"
            )
    return np.sum([np.asarray(term) for term in terms.values()], axis=0)


def _terms(reward: TouchReward, level: Array, target: Target, spent: Spent, prices: Prices) -> dict[str, Array]:
    """Terms of an answer, after a check of their types."""
    some = jnp.any(level >= 0)
    parsed = Parsed(
        perceive=level[None], compare=level, conclude=level, formatted=some, truncated=~some, length=jnp.int32(0)
    )
    terms = reward(parsed, target, spent, prices)
    if not isinstance(terms, dict) or not terms:
        raise RewardError(f"the reward returns {terms!r}: must be a dictionary of named float scalars; name its terms")
    for name, term in terms.items():
        if name in RESERVED:
            raise RewardError(f"term {name!r} is the name of a metric of the engine; call the term otherwise")
        if jnp.shape(term) != () or not jnp.issubdtype(jnp.result_type(term), jnp.floating):
            raise RewardError(f"term {name!r} is {term}: must be a float scalar; sum it or convert it")
    return terms
