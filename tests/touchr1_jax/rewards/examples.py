"""Targets and parsed answers by hand: attributes are two ordinal ones of three levels and one categorical of nine."""

import jax.numpy as jnp

from touchr1_jax.types import Parsed, Target

A, S = 3, 3


def make_target(asked=(1, 0, 0), label=(0, 0, 0), levels=(3, 3, 9), ordinal=(1, 1, 0), streams=(1, 1, 1)) -> Target:
    return Target(
        asked=jnp.array(asked, bool),
        label=jnp.array(label),
        levels=jnp.array(levels),
        ordinal=jnp.array(ordinal, bool),
        streams=jnp.array(streams, bool),
    )


def make_parsed(conclude=(-1, -1, -1), compare=(-1, -1, -1), perceive=-1, formatted=True) -> Parsed:
    """`perceive` is one level for all slots or [S] levels of the first attribute."""
    slots = jnp.full((S, A), -1).at[:, 0].set(jnp.array(perceive))
    return Parsed(
        perceive=jnp.full((S, A), perceive) if isinstance(perceive, int) else slots,
        compare=jnp.array(compare),
        conclude=jnp.array(conclude),
        formatted=jnp.array(formatted),
        truncated=jnp.array(False),
        length=jnp.array(17),
    )


def constant(level: int) -> Parsed:
    """Says the same level everywhere."""
    return make_parsed(conclude=(level,) * A, compare=(level,) * A, perceive=level)
