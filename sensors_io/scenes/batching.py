"""Many scenes through one compiled program: in chunks of a fixed size, one after another, each stopping by itself."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

CHUNK = 32
"""Scenes a call: dispatching it takes a hundredth of the time of the cheapest."""


def chunks(rows: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Indices in chunks of one size, filled up with the first one, and which of them count.

    A single index comes alone, so there are two sizes and two programs at most, whatever the number of indices.
    """
    size = 1 if len(rows) == 1 else CHUNK
    for start in range(0, len(rows), size):
        chunk = rows[start : start + size]
        yield np.concatenate([chunk, np.repeat(rows[:1], size - len(chunk))]), np.arange(size) < len(chunk)


def map_live(one: Callable[[Any], Any], live: Bool[Array, "R"], given: Any) -> Any:
    """`one` of every live row of `given` in turn; zeros for the others, which take no time."""
    result = jax.eval_shape(one, jax.tree.map(lambda leaf: leaf[0], given))
    empty = lambda _: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), result)
    return jax.lax.map(lambda row: jax.lax.cond(row[0], one, empty, row[1]), (live, given))


def gather(parts: list[Any], count: int) -> Any:
    """The results of all chunks as NumPy arrays, without what filled up the last."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *jax.device_get(parts))
