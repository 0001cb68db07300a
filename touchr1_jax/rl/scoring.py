"""Reward of one rollout from its tokens: in-graph for traceable rewards, on the host for any other.

Both are a `ScoreFn`, so that the step needs no distinction.
"""

import functools
import itertools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from touchr1_jax.rewards.base import Reward, RewardError, total_reward
from touchr1_jax.types import Parsed, Target

ScoreFn = Callable[[Int[Array, "T"], Target], tuple[Float[Array, ""], dict[str, Array], Parsed]]
"""(tokens, target) → (total reward, its named terms, parsed completion), for one rollout."""

HostReward = Callable[[np.ndarray, Parsed, Target], Mapping[str, float]]
"""(tokens, parsed completion, target) of one rollout, all NumPy → its named terms; the reward is their sum."""


def make_score(
    parser: Callable[[Int[Array, "T"]], Parsed], rewards: Mapping[str, Reward], weights: Mapping[str, float]
) -> ScoreFn:
    """Score by weighted rewards (see `rewards.base.total_reward`), each proved finite when the step is traced.

    Raises (when traced):
      RewardError: a reward that gives NaN or infinity for some answer; it names the reward and the answer.
    """

    def score(tokens: Int[Array, "T"], target: Target) -> tuple[Array, dict[str, Array], Parsed]:
        parsed = parser(tokens)
        reward, terms = total_reward(rewards, weights, parsed, target)
        for name in weights:
            check_finite(name, rewards[name], *parsed.perceive.shape)
        return reward, terms, parsed

    return score


def make_host_score(parser: Callable[[Int[Array, "T"]], Parsed], reward: HostReward, terms: tuple[str, ...]) -> ScoreFn:
    """Score by a Python function on the host, for rewards that cannot be traced: slower, the same interface.

    The device waits while Python runs, once per step for all rollouts of the batch.

    Args:
      parser: in-graph parser.
      reward: the function; it must be pure, for it may be called again with the same arguments.
      terms: names of the terms that it returns.

    Raises (when run):
      ValueError: other terms than announced, or one that is not finite.
    """

    def on_host(tokens: np.ndarray, parsed: Parsed, target: Target) -> np.ndarray:
        batch = tokens.shape[:-1]
        row = lambda tree, i: jax.tree.map(lambda x: np.broadcast_to(x, (*batch, *x.shape[len(batch) :]))[i], tree)
        out = np.empty((*batch, len(terms)), np.float32)
        for i in np.ndindex(batch):
            out[i] = _host_terms(reward(np.asarray(tokens[i]), row(parsed, i), row(target, i)), terms)
        return out

    def score(tokens: Int[Array, "T"], target: Target) -> tuple[Array, dict[str, Array], Parsed]:
        parsed = parser(tokens)
        shape = jax.ShapeDtypeStruct((len(terms),), jnp.float32)
        found = jax.pure_callback(on_host, shape, tokens, parsed, target, vmap_method="broadcast_all")
        return jnp.sum(found), dict(zip(terms, found, strict=True)), parsed

    return score


def _host_terms(found: Mapping[str, float], terms: tuple[str, ...]) -> list[float]:
    if set(found) != set(terms):
        raise ValueError(f"host reward returned terms {sorted(found)}: must be {sorted(terms)}; correct `terms`")
    for name, value in found.items():
        if not np.isfinite(value):
            raise ValueError(f"host reward {name!r} is {value}: must be finite; give an undefined answer a number")
    return [float(found[name]) for name in terms]


@functools.cache
def check_finite(name: str, reward: Reward, sensors: int, attributes: int) -> None:
    """Evaluate a reward on extreme answers and targets; once for each reward and size.

    Raises:
      RewardError: NaN or infinity.
    """
    with jax.ensure_compile_time_eval():
        answers, targets = _corner_answers(sensors, attributes), _corner_targets(sensors, attributes)
        over_targets = jax.vmap(reward.value, in_axes=(None, 0))
        values = np.asarray(jax.jit(jax.vmap(over_targets, in_axes=(0, None)))(answers, targets))
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        a, t = bad[0]
        plain = lambda tree, i: jax.tree.map(lambda x: np.asarray(x)[i].tolist(), tree)
        raise RewardError(
            f"reward {name!r} is {values[a, t]} for {plain(answers, a)} against {plain(targets, t)}: must be finite "
            "everywhere; choose with jnp.where before you divide or take logarithms"
        )


def _corner_answers(sensors: int, attributes: int) -> Parsed:
    """All slots ⊥, the lowest or the highest of three levels; formatted or not; empty or not."""
    rows = [
        Parsed(
            perceive=jnp.full((sensors, attributes), level),
            compare=jnp.full(attributes, level),
            conclude=jnp.full(attributes, level),
            formatted=jnp.array(formatted),
            truncated=jnp.array(not formatted),
            length=jnp.array(length),
        )
        for level, formatted, length in itertools.product((-1, 0, 2), (False, True), (0, 20))
    ]
    return jax.tree.map(lambda *x: jnp.stack(x), *rows)


def _corner_targets(sensors: int, attributes: int) -> Target:
    """No attribute asked or all, labels unknown, lowest or highest, ordinal or not, no sensor present or all."""
    rows = [
        Target(
            asked=jnp.full(attributes, asked),
            label=jnp.full(attributes, label),
            levels=jnp.full(attributes, 3),
            ordinal=jnp.full(attributes, ordinal),
            streams=jnp.full(sensors, streams),
        )
        for asked, label, ordinal, streams in itertools.product((True, False), (0, -1, 2), (True, False), (True, False))
    ]
    return jax.tree.map(lambda *x: jnp.stack(x), *rows)
