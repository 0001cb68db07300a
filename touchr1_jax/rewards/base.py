"""The types of rewards, and the weighted sum of rewards."""

import traceback
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.errors import ConcretizationTypeError, TracerArrayConversionError, TracerIntegerConversionError
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.text.language import SEGMENTS
from touchr1_jax.types import Parsed, Target

UNTRACEABLE = (ConcretizationTypeError, TracerArrayConversionError, TracerIntegerConversionError)
"""Errors of JAX where Python or NumPy needs a number that the compiled program will compute."""


Segment = Literal["perceive", "compare", "conclude"]

GROUP = "group"
"""Name of the `vmap` axis over the rollouts of one prompt."""

SMALLEST_WEIGHT, LARGEST_WEIGHT = 1e-9, 1e9
"""Range of a weight above 0: squares of rewards stay within float32."""

RESERVED = ("kl", "levels", "std", "tactile_use", "total")
"""No names of rewards: a step has metrics and terms of its own called so."""


class RewardError(ValueError):
    """A reward or a weight that does not fit; the message names it, its value, the constraint and the fix."""


def always(target: Target) -> Bool[Array, ""]:
    """`applies` of a reward that is defined for every question."""
    del target
    return jnp.array(True)


class Reward(NamedTuple):
    """A reward of one rollout; the engine batches it by `vmap`.

    Attributes:
      value: (parsed, target) → float scalar, finite even where the reward does not apply.
      applies: target → boolean scalar, true if the reward is defined for this question.  It depends on the target
        alone: an answer must not be able to escape a term.
      settled: the segment at whose end the value is known, so that later tokens need no credit for it
        (`rl.advantages.segment_advantages`).
    """

    value: Callable[[Parsed, Target], Float[Array, ""]]
    applies: Callable[[Target], Bool[Array, ""]] = always
    settled: Segment = "conclude"


class GroupReward(NamedTuple):
    """A reward of all rollouts of one prompt together, which sees their tokens and the other rollouts.

    Attributes:
      value: (tokens int32 [G, T], parsed answers [G, …], target) → float [G], finite for any G ≥ 1.
      applies: as in `Reward`.
    """

    value: Callable[[Int[Array, "G T"], Parsed, Target], Float[Array, "G"]]
    applies: Callable[[Target], Bool[Array, ""]] = always


class HostReward(NamedTuple):
    """A reward that Python computes from the text on the host, if it cannot be traced; slower, for the device waits.

    Attributes:
      value: (text, parsed answer, target), all NumPy → one number; pure, because it may be called again.
      applies: as in `Reward`, traced.
    """

    value: Callable[[str, Parsed, Target], float]
    applies: Callable[[Target], Bool[Array, ""]] = always


AnyReward = Reward | GroupReward | HostReward

Decode = Callable[[np.ndarray], str]
"""Tokens [T] → their text."""


def total_reward(
    rewards: Mapping[str, AnyReward],
    weights: Mapping[str, float],
    parsed: Parsed,
    target: Target,
    tokens: Int[Array, "T"] | None = None,
    decode: Decode | None = None,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Weighted sum of the rewards that apply, R = W Σ_n a_n w_n r_n / Σ_n a_n w_n with W = Σ_n w_n.

    An undefined term is dropped, and the other weights are scaled up to the same sum; 0 if no term applies.

    Args:
      rewards: all rewards by name.
      weights: weight ≥ 0 of each reward that is used.
      parsed: the parsed rollout.
      target: the right answer.
      tokens: the rollout, which a `GroupReward` and a `HostReward` see; the first also needs the axis `GROUP`.
      decode: writes the text that a `HostReward` sees.

    Returns:
      R, and the part of each weighted reward; the parts sum to R.

    Raises:
      RewardError: an unknown name, a weight that is negative or not finite, or none above 0; a reward that is no
        floating scalar, whose `applies` is no boolean scalar, or that cannot be traced.
      Exception: any other of a reward, with a note of its name.
    """
    check_weights(rewards, weights)
    found = {name: reward_value(name, rewards[name], parsed, target, tokens, decode) for name in weights}
    wide = lambda x: jnp.asarray(x, jnp.promote_types(jnp.result_type(x), jnp.float32))  # 16 bits would round weights
    values = {name: wide(value) for name, value in found.items()}
    applies = {name: _checked(name, "applies", jnp.bool_, (), rewards[name].applies, target) for name in weights}
    share = {name: jnp.where(applies[name], weight, 0.0) for name, weight in weights.items()}
    in_force = sum(share.values())
    scale = jnp.where(in_force > 0, sum(weights.values()) / jnp.where(in_force > 0, in_force, 1.0), 0.0)
    parts = {name: jnp.where(share[name] > 0, scale * share[name] * values[name], 0.0) for name in weights}
    return sum(parts.values(), start=jnp.float32(0)), parts


def reward_value(
    name: str,
    reward: AnyReward,
    parsed: Parsed,
    target: Target,
    tokens: Int[Array, "T"] | None = None,
    decode: Decode | None = None,
) -> Float[Array, ""]:
    """Value of a reward of any kind for one rollout; arguments and errors as in `total_reward`."""
    if isinstance(reward, Reward):
        return _checked(name, "value", jnp.floating, (), reward.value, parsed, target)
    if tokens is None or (decode is None and isinstance(reward, HostReward)):
        raise RewardError(f"reward {name!r} sees tokens or text: must be given them; pass `tokens` and `decode`")
    if isinstance(reward, HostReward) and decode is not None:
        return _on_host(name, lambda t, p, y: reward.value(decode(t), p, y), tokens, parsed, target)
    try:
        row = jax.lax.axis_index(GROUP)
    except NameError as error:
        raise RewardError(
            f"reward {name!r} compares the rollouts of a group: must be scored along the axis {GROUP!r}; write "
            "jax.vmap(score, in_axes=(0, None), axis_name=GROUP)"
        ) from error
    tokens, parsed = jax.tree.map(lambda x: jax.lax.all_gather(x, GROUP), (tokens, parsed))
    return _checked(name, "value", jnp.floating, tokens.shape[:1], reward.value, tokens, parsed, target)[row]


def _on_host(
    name: str, value: Callable[[np.ndarray, Parsed, Target], float], tokens: Array, parsed: Parsed, target: Target
) -> Float[Array, ""]:
    """Value of one rollout by a Python function on the host, called once a step for all rollouts of the batch."""

    def rows(tokens: np.ndarray, parsed: Parsed, target: Target) -> np.ndarray:
        batch = tokens.shape[:-1]
        row = lambda tree, i: jax.tree.map(lambda x: np.broadcast_to(x, (*batch, *x.shape[len(batch) :]))[i], tree)
        out = np.empty(batch, np.float32)
        for i in np.ndindex(batch):
            out[i] = _one_number(name, value, np.asarray(tokens[i]), row(parsed, i), row(target, i))
        return out

    shape = jax.ShapeDtypeStruct((), jnp.float32)
    return jax.pure_callback(rows, shape, tokens, parsed, target, vmap_method="broadcast_all")


def _one_number(name: str, value: Callable[..., float], *of: Any) -> float:
    try:
        found = value(*of)
    except Exception as error:
        raise RewardError(f"reward {name!r} raised {error!r} on the host; correct its function") from error
    if np.ndim(found) or np.asarray(found).dtype.kind not in "biuf":
        raise RewardError(f"reward {name!r} is {found!r}: must be one number per rollout; return a float")
    return float(found)


def check_weights(rewards: Mapping[str, AnyReward], weights: Mapping[str, float]) -> None:
    """Check the names and sizes of weights.

    Raises:
      RewardError: an unknown or reserved name, an entry that is no `Reward` or has an unknown segment, a weight that is
        negative or beyond float32, or none above 0.
    """
    for name, weight in weights.items():
        if name in RESERVED:
            raise RewardError(f"weights: {name!r} is the name of a metric of the engine; call the reward otherwise")
        if name not in rewards:
            raise RewardError(f"weights: no reward is called {name!r}; choose from {', '.join(sorted(rewards))}")
        if not isinstance(rewards[name], AnyReward):
            raise RewardError(f"rewards[{name}] is {rewards[name]!r}: must be a Reward; write Reward(function)")
        settled = getattr(rewards[name], "settled", SEGMENTS[-1])
        if settled not in SEGMENTS:
            raise RewardError(
                f"rewards[{name}].settled is {settled!r}: must be one of {', '.join(SEGMENTS)}; write one"
            )
        if not (weight == 0 or SMALLEST_WEIGHT <= weight <= LARGEST_WEIGHT):
            raise RewardError(
                f"weights[{name}] is {weight}: must be finite and ≥ 0, and {SMALLEST_WEIGHT} … {LARGEST_WEIGHT} if "
                "not 0; let a penalty have a negative value"
            )
    if not any(weights.values()):
        raise RewardError(f"weights is {dict(weights)}: at least one must be above 0; give a reward some weight")


def _checked(name: str, part: str, kind: type, shape: tuple[int, ...], function: Callable[..., Any], *of: Any) -> Any:
    """Value of a part of a reward, checked to be of that kind and shape."""
    try:
        value = function(*of)
    except UNTRACEABLE as error:
        line = traceback.extract_tb(error.__traceback__)[1]  # below this function stands the reward's
        raise RewardError(
            f"reward {name!r}: {part} cannot be traced, {line.filename}:{line.lineno} needs a number that is "
            "computed later; choose with jnp.where instead of `if`, compute with jnp instead of numpy or float(), or "
            "make it a HostReward"
        ) from error
    except Exception as error:
        error.add_note(f"raised by reward {name!r}, its {part}")
        raise
    number = isinstance(value, (jnp.ndarray, jnp.generic, bool, int, float))
    found, dtype = (jnp.shape(value), jnp.result_type(value)) if number else ((), None)
    if found != shape or dtype is None or not jnp.issubdtype(dtype, kind):
        got = f"has type {dtype}{list(found)}" if number else f"is {value!r}"
        wanted = ("bool" if kind is jnp.bool_ else "float") + str(list(shape))
        raise RewardError(
            f"reward {name!r}: {part} {got}, must be {wanted}; return one number per rollout, of that type"
        )
    return value
