"""A check before training that rewards are finite for extreme answers and targets."""

import dataclasses
import functools
import itertools
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from touchr1_jax.rewards.base import AnyReward, GroupReward, HostReward, Reward, RewardError
from touchr1_jax.types import Parsed, Target


def prove_rewards(
    rewards: Mapping[str, AnyReward], names: Iterable[str], sensors: int, attributes: int, length: int = 20
) -> None:
    """Evaluate rewards on extreme answers and targets; once for each reward and size.

    Answers: every slot ⊥, lowest or highest, or sensors that disagree; formatted or not, cut off or not, of no, one or
    twenty tokens.  Targets: no attribute asked, one or all; labels unknown, lowest or highest of two, three or nine
    levels; ordinal or not; no sensor, one, two or all.  A host reward is not checked: if it is NaN,
    its group is left out.

    Args:
      rewards: the choices, by name.
      names: those to check.
      sensors, attributes: S and A.
      length: T, tokens of a completion.

    Raises:
      RewardError: NaN or infinity; it names the reward, the answer and the target.
    """
    for name in names:
        if not isinstance(rewards[name], HostReward):
            _prove(name, rewards[name], sensors, attributes, length)


@functools.cache
def _prove(name: str, reward: Reward | GroupReward, sensors: int, attributes: int, length: int) -> None:
    with jax.ensure_compile_time_eval():
        answers, targets = _answers(sensors, attributes), _targets(sensors, attributes)
        values = np.asarray(jax.jit(lambda a, t: _values(reward, a, t, length))(answers, targets))
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        a, t = bad[0]
        plain = lambda tree, i: jax.tree.map(lambda x: np.asarray(x)[i].tolist(), tree)
        raise RewardError(
            f"reward {name!r} is {values[a, t]} for {plain(answers, a)} against {plain(targets, t)}: must be finite "
            "everywhere; choose with jnp.where before you divide or take logarithms"
        )


def _values(reward: Reward | GroupReward, answers: Parsed, targets: Target, length: int) -> Array:
    """Value of every answer against every target, [answers, targets]; of a `GroupReward`, among all and alone."""
    tokens = jnp.tile(jnp.arange(len(answers.length))[:, None], (1, length))

    def of_group(tokens: Array, answers: Parsed, target: Target) -> Array:
        last = target.levels - 1  # no answer names a level that its attribute lacks
        slots = {"perceive": answers.perceive, "compare": answers.compare, "conclude": answers.conclude}
        answers = dataclasses.replace(answers, **{name: jnp.minimum(x, last) for name, x in slots.items()})
        if isinstance(reward, GroupReward):
            return reward.value(tokens, answers, target)
        return jax.vmap(reward.value, in_axes=(0, None))(answers, target)

    over_targets = jax.vmap(of_group, in_axes=(None, None, 0), out_axes=-1)
    one_by_one = jax.tree.map(lambda x: x[:, None], answers)
    alone = jax.vmap(over_targets, in_axes=(0, 0, None))(tokens[:, None], one_by_one, targets)
    return over_targets(tokens, answers, targets) + alone[:, 0]


def _answers(sensors: int, attributes: int) -> Parsed:
    cases = itertools.product((-1, 0, 1, 2), (False, True), (False, True), (0, 1, 20))
    level, formatted, truncated, length = (np.array(x) for x in zip(*cases, strict=True))
    slots = np.tile(level[:, None], attributes)
    disagreeing = np.arange(sensors)[:, None] % 2
    return Parsed(
        perceive=jnp.asarray(np.where(slots[:, None] == 1, disagreeing, slots[:, None])),
        compare=jnp.asarray(slots),
        conclude=jnp.asarray(slots),
        formatted=jnp.asarray(formatted),
        truncated=jnp.asarray(truncated),
        length=jnp.asarray(length),
    )


def _targets(sensors: int, attributes: int) -> Target:
    cases = itertools.product(
        (attributes, 1, 0), (0, -1, 2), (3, 2, 9), (True, False), sorted({sensors, 2, 1, 0}, reverse=True)
    )
    asked, label, levels, ordinal, streams = (np.array(x)[:, None] for x in zip(*cases, strict=True))
    each = lambda x: jnp.asarray(np.tile(x, attributes))
    return Target(
        asked=jnp.asarray(np.arange(attributes) < asked),
        label=each(np.where(label < 2, label, levels - 1)),
        levels=each(levels),
        ordinal=each(ordinal),
        streams=jnp.asarray(np.arange(sensors) < streams),
    )
