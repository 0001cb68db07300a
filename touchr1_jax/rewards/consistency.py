"""Agreement between the levels reported per sensor and the cross-sensor summary."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from touchr1_jax import masked
from touchr1_jax.types import Parsed, Target


def agreement(parsed: Parsed, target: Target) -> Float[Array, "A"]:
    """1 − mean_s w(p_s, p_c) of each attribute, w(u, v) = min(|u − v| / (K − 1), 1).

    p_s is sensor s's level in `perceive`, p_c the level in `compare`; the mean is over the sensors that were present.
    0 where any of these is unparsable.
    """
    summary = parsed.compare
    distance = jnp.abs(parsed.perceive - summary) / jnp.maximum(target.levels - 1, 1)
    streams = target.streams[:, None]
    complete = jnp.all((parsed.perceive >= 0) | ~streams, axis=0) & (summary >= 0)
    return jnp.where(complete, 1.0 - masked.mean(jnp.minimum(distance, 1.0), streams, axis=0), 0.0)


def consistency(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """R_cs: mean `agreement` over the asked ordinal attributes (Touch-R1, arXiv 2605.27154, for any number of sensors).

    R_cs rewards the same level in every slot, right or wrong: a constant answer earns 1.
    """
    return masked.mean(agreement(parsed, target), target.asked & target.ordinal)


def consistency_applies(target: Target) -> Bool[Array, ""]:
    """R_cs is undefined for one sensor, and if all asked attributes are categorical."""
    return (jnp.sum(target.streams) >= 2) & jnp.any(target.asked & target.ordinal)
