"""The type of a reward, and the weighted sum of rewards."""

import math
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.errors import ConcretizationTypeError, TracerArrayConversionError
from jaxtyping import Array, Bool, Float

from touchr1_jax.types import Parsed, Target

UNTRACEABLE = (ConcretizationTypeError, TracerArrayConversionError)
"""Errors of JAX where Python or NumPy needs a number that the compiled program will compute."""


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
    """

    value: Callable[[Parsed, Target], Float[Array, ""]]
    applies: Callable[[Target], Bool[Array, ""]] = always


def total_reward(
    rewards: Mapping[str, Reward], weights: Mapping[str, float], parsed: Parsed, target: Target
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Weighted sum of the rewards that apply, R = W Σ_n a_n w_n r_n / Σ_n a_n w_n with W = Σ_n w_n.

    Where a term is undefined it is dropped and the other weights grow to the same sum; 0 where no term applies.

    Args:
      rewards: the choices, by name.
      weights: weight ≥ 0 of each reward that counts.
      parsed: the parsed rollout.
      target: the right answer.

    Returns:
      R, and the part of each weighted reward; the parts sum to R.

    Raises:
      RewardError: an unknown name, a weight that is negative or not finite, or none above 0; a reward that is no
        floating scalar, whose `applies` is no boolean scalar, or that cannot be traced.
      Exception: any other of a reward, with a note of its name.
    """
    check_weights(rewards, weights)
    values = {name: _scalar(name, "value", jnp.floating, rewards[name].value, parsed, target) for name in weights}
    applies = {name: _scalar(name, "applies", jnp.bool_, rewards[name].applies, target) for name in weights}
    share = {name: jnp.where(applies[name], weight, 0.0) for name, weight in weights.items()}
    in_force = sum(share.values())
    scale = jnp.where(in_force > 0, sum(weights.values()) / jnp.where(in_force > 0, in_force, 1.0), 0.0)
    parts = {name: scale * share[name] * values[name] for name in weights}
    return sum(parts.values(), start=jnp.float32(0)), parts


def check_weights(rewards: Mapping[str, Reward], weights: Mapping[str, float]) -> None:
    """Check the names and sizes of weights.

    Raises:
      RewardError: an unknown name, an entry that is no `Reward`, a weight that is negative or not finite, or none above
        0.
    """
    for name, weight in weights.items():
        if name not in rewards:
            raise RewardError(f"weights: no reward is called {name!r}; choose from {', '.join(sorted(rewards))}")
        if not isinstance(rewards[name], Reward):
            raise RewardError(f"rewards[{name}] is {rewards[name]!r}: must be a Reward; write Reward(function)")
        if not (math.isfinite(weight) and weight >= 0):
            raise RewardError(
                f"weights[{name}] is {weight}: must be finite and ≥ 0; let a penalty have a negative value"
            )
    if not any(weights.values()):
        raise RewardError(f"weights is {dict(weights)}: at least one must be above 0; give a reward some weight")


def _scalar(name: str, part: str, kind: type, function: Callable[..., Any], *of: Parsed | Target) -> Any:
    """Value of a part of a reward, checked to be a scalar of that kind."""
    try:
        value = function(*of)
    except UNTRACEABLE as error:
        line = traceback.extract_tb(error.__traceback__)[1]  # below this function stands the reward's
        raise RewardError(
            f"reward {name!r}: {part} cannot be traced, {line.filename}:{line.lineno} needs a number that is "
            "computed later; choose with jnp.where instead of `if`, compute with jnp instead of numpy or float(), or "
            "score on the host with rl.scoring.make_host_score"
        ) from error
    except Exception as error:
        error.add_note(f"raised by reward {name!r}, its {part}")
        raise
    number = isinstance(value, (jnp.ndarray, jnp.generic, bool, int, float))
    shape, dtype = (jnp.shape(value), jnp.result_type(value)) if number else ((), None)
    if shape != () or dtype is None or not jnp.issubdtype(dtype, kind):
        got = f"has type {dtype}{list(shape)}" if number else f"is {value!r}"
        wanted = "bool[]" if kind is jnp.bool_ else "float[]"
        raise RewardError(
            f"reward {name!r}: {part} {got}, must be {wanted}; return one number per rollout, of that type"
        )
    return value
