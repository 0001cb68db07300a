"""Checks before training that rewards are finite for extreme answers and targets, and pure."""

import dataclasses
import functools
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify
from jaxtyping import Array

from touchr1_jax.rewards.base import AnyReward, GroupReward, HostReward, Reward, RewardError
from touchr1_jax.text.language import SEGMENTS
from touchr1_jax.types import Parsed, Target

_LEVELS = (-1, 0, 1, 2)

IMPURE = (
    "is another function each time: must be pure, because a step traces it once, so that its random numbers, counters "
    "and clocks stand still"
)
"""What is wrong with a function of which `written` is another each time."""


UNSTATED = ("None", "nan", str(np.iinfo(np.int32).min))
"""What JAX writes of an element beyond an array, unless a reward states it by `mode="clip"` or `fill_value`."""


def prove_rewards(
    rewards: Mapping[str, AnyReward],
    names: Iterable[str],
    sensors: int,
    levels: tuple[int, ...],
    length: int = 20,
    ordinal: tuple[bool, ...] | None = None,
) -> None:
    """Evaluate rewards on extreme answers and targets; once for each reward and size.

    They must be finite, the same function each time, without an index beyond its array, and known where they say that
    they are settled.

    Answers: every slot ⊥, lowest or highest, or sensors that disagree; formatted or not, cut off or not, of no, one or
    twenty tokens.  Targets: no attribute asked, one or all; labels unknown, lowest or highest of two, three or nine
    levels; ordinal or not; no sensor, one, two or all.  Indices are those of the lowest and of the highest level that
    each attribute has.  A host reward is not checked: if it is NaN, its group is left out.

    Args:
      rewards: the choices, by name.
      names: those to check.
      sensors: S.
      levels: number of levels of each attribute; 1 where it is unknown.
      length: T, tokens of a completion.
      ordinal: which attributes are; by default all.

    Raises:
      RewardError: NaN or infinity, with the answer and the target; another function each time; an index beyond an
        array; a value that changes after the segment where it is settled; no hash.  It names the reward.
    """
    for name in names:
        if not isinstance(rewards[name], HostReward):
            require_hash(f"reward {name!r}", rewards[name])
            _prove(name, rewards[name], sensors, levels, length, ordinal or (True,) * len(levels))


def require_hash(what: str, reward: object) -> None:
    """Refuse a reward without a hash.

    Raises:
      RewardError: as `what` calls it.
    """
    try:
        hash(reward)
    except TypeError as error:
        needs = "must have a hash, by which it is checked once; write @dataclass(eq=False), or a function"
        raise RewardError(f"{what}: {error}, {needs}") from error


@functools.cache
def _prove(
    name: str,
    reward: Reward | GroupReward,
    sensors: int,
    levels: tuple[int, ...],
    length: int,
    ordinal: tuple[bool, ...],
) -> None:
    with jax.ensure_compile_time_eval():
        answers, targets = _answers(sensors, len(levels)), _targets(sensors, len(levels))
        of_all = jax.jit(lambda answers, targets: _values(reward, answers, targets, length))
        values = np.asarray(of_all(answers, targets))
        _require_finite(name, values, answers, targets)
        cases = _cases(reward, sensors, np.array(levels, np.int32), length, np.array(ordinal))
        require_pure(f"reward {name!r}", reward.value, *cases)
        if isinstance(reward, Reward) and reward.settled != SEGMENTS[-1]:
            changed = np.asarray(of_all(_changed_after(reward.settled, answers), targets))
            if not np.allclose(values, changed, rtol=1e-4, atol=1e-6):  # up to rounding
                raise RewardError(
                    f"reward {name!r} is settled by {reward.settled!r}, but what follows changes it: must be known "
                    f"there, or later tokens get no credit for it; leave settled at {SEGMENTS[-1]!r}"
                )


def _require_finite(name: str, values: np.ndarray, answers: Parsed, targets: Target) -> None:
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        alone, a, t = bad[0]
        plain = lambda tree, i: jax.tree.map(lambda x: np.asarray(x)[i].tolist(), tree)
        raise RewardError(
            f"reward {name!r} is {values[alone, a, t]} for {plain(answers, a)}{' in a group of one' * int(alone)} "
            f"against {plain(targets, t)}: must be finite everywhere; choose with jnp.where before you divide or take "
            "logarithms"
        )


def _cases(
    reward: Reward | GroupReward, sensors: int, levels: Any, length: int, ordinal: np.ndarray
) -> Iterator[tuple[Any, ...]]:
    """Arguments of a reward: all attributes asked, or one, with the lowest or highest levels, no or all tokens."""
    each: Any = itertools.product((0 * levels, levels - 1), (0, length), (levels > 0, *np.eye(len(levels), dtype=bool)))
    array: Any = np.array  # these are no arrays of JAX, to compile nothing
    for level, tokens, asked in each:
        slots, ended, number = array([level] * sensors), array(tokens < length), array(tokens, np.int32)
        answer = Parsed(slots, level, level, formatted=ended, truncated=~ended, length=number)
        target = Target(asked, level, levels, array(ordinal), streams=array([True] * sensors))
        if isinstance(reward, GroupReward):
            yield np.zeros((2, length), np.int32), jax.tree.map(lambda x: np.stack([x, x]), answer), target
        else:
            yield answer, target


def require_pure(what: str, value: Callable[..., Any], *cases: tuple[Any, ...]) -> None:
    """Trace a reward twice; if it looks elements up, check their indices.

    Args:
      what: what an error calls it.
      value: the function.
      cases: its arguments, of equal shapes, each time with a `Target`.

    Raises:
      RewardError: another function each time, or an index beyond an array.
    """
    once, again = written(value, *cases[0]), written(value, *cases[0])
    if once != again:
        raise RewardError(f"{what} {IMPURE}; compute from the arguments alone")
    gathers = re.findall(r"\bgather\[.*?fill_value=(\S+).*?mode=GatherScatterMode\.(\w+)", once[0], re.DOTALL)
    unstated = [mode for fill, mode in gathers if mode != "CLIP" and fill in UNSTATED]
    if not unstated and "dynamic_slice[" not in once[0]:  # a constant index inside its array needs neither
        return
    checked = jax.jit(checkify.checkify(value, errors=checkify.index_checks))
    for of in cases:
        if outside := checked(*of)[0].get():
            target = next(x for x in of if isinstance(x, Target))
            levels = ", ".join(map(str, np.asarray(target.levels).tolist()))
            raise RewardError(
                f"{what}: {outside.splitlines()[0].split(': ', 1)[-1].rstrip('. ')}: must lie inside, or a step reads "
                f"another element; bound it by jnp.clip: there are {len(target.streams)} sensors, and attributes of "
                f"{levels} levels"
            )


def written(value: Callable[..., Any], *of: Any) -> tuple[str, list[bytes]]:
    """The operations and numbers of a function, traced anew, without addresses in memory."""
    program = jax.make_jaxpr(lambda *of: value(*of))(*of)
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return re.sub(r"0x[0-9a-f]+", "", str(program.jaxpr)), [np.asarray(plain(x)).tobytes() for x in program.consts]


def _changed_after(segment: str, answers: Parsed) -> Parsed:
    """The answers with other levels after a segment, and another end."""
    later = SEGMENTS[SEGMENTS.index(segment) + 1 :]
    another = lambda x: jnp.roll(x, len(x) // len(_LEVELS), 0)
    slots = {name: another(getattr(answers, name)) for name in later}
    ends = {"formatted": ~answers.formatted, "truncated": ~answers.truncated, "length": jnp.roll(answers.length, 1)}
    return dataclasses.replace(answers, **slots, **ends)


def _values(reward: Reward | GroupReward, answers: Parsed, targets: Target, length: int) -> Array:
    """Value of every answer against every target, in a group of all answers and alone, [2, answers, targets]."""
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
    return jnp.stack([over_targets(tokens, answers, targets), alone[:, 0]])


def _answers(sensors: int, attributes: int) -> Parsed:
    cases = itertools.product(_LEVELS, (False, True), (False, True), (0, 1, 20))
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
