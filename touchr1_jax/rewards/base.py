"""What a reward is, and how rewards add up."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from touchr1_jax.types import Parsed, Target


def always(target: Target) -> Bool[Array, ""]:
    """`applies` of a reward that is defined for every question."""
    del target
    return jnp.array(True)


class Reward(NamedTuple):
    """A reward of one rollout; the engine batches it by `vmap`.

    Attributes:
      value: (parsed, target) → float scalar, finite even where the reward does not apply.
      applies: target → boolean scalar, whether the reward is defined for this question.  It sees the target alone: an
        answer must not be able to escape a term.
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
      parsed: what the rollout said.
      target: what it is scored against.

    Returns:
      R, and what each weighted reward adds to it: the parts sum to R.

    Raises:
      ValueError: an unknown name, a weight that is negative or not finite, or none above 0.
      TypeError: a reward that is no floating scalar, or whose `applies` is no boolean scalar.
    """
    check_weights(rewards, weights)
    values = {name: _scalar(name, "value", rewards[name].value(parsed, target), jnp.floating) for name in weights}
    applies = {name: _scalar(name, "applies", rewards[name].applies(target), jnp.bool_) for name in weights}
    share = {name: jnp.where(applies[name], weight, 0.0) for name, weight in weights.items()}
    in_force = sum(share.values())
    scale = jnp.where(in_force > 0, sum(weights.values()) / jnp.where(in_force > 0, in_force, 1.0), 0.0)
    parts = {name: scale * share[name] * values[name] for name in weights}
    return sum(parts.values(), start=jnp.float32(0)), parts


def check_weights(rewards: Mapping[str, Reward], weights: Mapping[str, float]) -> None:
    """Hold the names and sizes of weights against the rewards that there are.

    Raises:
      ValueError: an unknown name, a weight that is negative or not finite, or none above 0.
    """
    for name, weight in weights.items():
        if name not in rewards:
            raise ValueError(f"weights: no reward is called {name!r}; choose from {', '.join(sorted(rewards))}")
        if not (math.isfinite(weight) and weight >= 0):
            raise ValueError(
                f"weights[{name}] is {weight}: must be finite and ≥ 0; let a penalty have a negative value"
            )
    if not any(weights.values()):
        raise ValueError(f"weights is {dict(weights)}: at least one must be above 0; give a reward some weight")


def _scalar(name: str, part: str, value: Any, kind: type) -> Any:
    """The value itself, if it is a scalar of that kind."""
    shape, dtype = jnp.shape(value), jnp.result_type(value)
    if shape != () or not jnp.issubdtype(dtype, kind):
        wanted = "bool[]" if kind is jnp.bool_ else "float[]"
        raise TypeError(
            f"reward {name!r}: {part} has type {dtype}{list(shape)}, must be {wanted}; "
            "reduce it to one number per rollout and cast it"
        )
    return value
