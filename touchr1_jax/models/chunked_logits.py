"""A function of many rows, some rows at a time, where what it makes of all of them does not fit.

The logits of 2 000 tokens over 152 000 words are 1.2 GB, and a softmax, a reference, a perturbed policy and the
gradient each make as much again.  What is kept of a token is a handful of numbers.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

Rows = dict[str, jax.Array]
"""Arrays with one leading axis."""
RowsOut = TypeVar("RowsOut")
"""Any tree of such arrays."""

MAX_LOGITS = 2**24
"""Logits that may exist at once, 64 MB in float32: up to 110 tokens of a language model's 152 000 words, and all tokens
of a policy that knows a few hundred."""


def by_blocks(f: Callable[[Rows], RowsOut], rows: Rows, *, width: int, most: int = MAX_LOGITS) -> RowsOut:
    """f(rows) for an f that treats every row by itself, in blocks of rows for which it makes at most `most` numbers.

    Blocks are of one size, at least one row each; the gradient computes each of them again.  Rows that make no more
    than `most` numbers in all are given to f as they are, and nothing is computed twice.

    Args:
      f: from arrays [n, …] to arrays [n, …]; what it closes over is shared by all blocks.
      rows: arrays of n rows.
      width: numbers that f makes on the way for each row: the size of the vocabulary.
      most: bound on width times the rows of a block.

    Raises:
      ValueError: a width or bound below 1.
    """
    if width < 1 or most < 1:
        raise ValueError(f"width is {width} and most {most}: must be at least 1; give the vocabulary and a bound")
    n = len(jax.tree.leaves(rows)[0])
    count = -(-n // max(1, most // width))
    if count <= 1:
        return f(rows)
    size = -(-n // count)
    cut = lambda x: _padded(x, count * size).reshape(count, size, *x.shape[1:])
    found = jax.lax.map(jax.checkpoint(f), jax.tree.map(cut, rows))
    return jax.tree.map(lambda x: x.reshape(count * size, *x.shape[2:])[:n], found)


def _padded(x: jax.Array, n: int) -> jax.Array:
    """Zeros after the rows of x, up to n; what f makes of them is dropped."""
    return jnp.pad(x, [(0, n - len(x))] + [(0, 0)] * (x.ndim - 1))
