"""Attention of a prompt and of a row of examples, in blocks of queries that skip the keys they cannot see."""

from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.layers import KeySource, attend


class LayerCache(NamedTuple):
    """Keys and values of one layer, head-major: a time-major layout is several times slower to attend to."""

    k: Float[Array, "KV *g T d"]
    v: Float[Array, "KV *g T d"]


@struct.dataclass
class Segments:
    """Which example each token of a row belongs to, −1 for padding; the tokens of an example stand together.

    None has more than `reach` tokens: keys further away are left out before they are masked.
    """

    number: Int[Array, "W"]
    reach: int = struct.field(pytree_node=False)


PREFILL_ROWS = 128
"""Queries that a prompt answers at a time: each block skips the keys after it, and its scores stay in cache."""

PREFILL_BLOCKS = 8
"""Blocks of a prompt at most, for each is compiled by itself; eight compute an eighth more than what counts."""


def attend_causally(q: Float[Array, "n KV R d"], cache: LayerCache, mask: Bool[Array, "L"]) -> Float[Array, "n hd"]:
    """Attention of the last n of L prompt tokens over the tokens up to themselves that exist, in blocks of queries."""
    before, blocks = cache.k.shape[1] - q.shape[0], []
    rows = max(PREFILL_ROWS, -(-q.shape[0] // PREFILL_BLOCKS))
    for begin in range(0, q.shape[0], rows):
        end = min(begin + rows, q.shape[0])
        keys = before + end
        seen = jnp.tri(end - begin, keys, before + begin, dtype=bool) & mask[:keys]
        blocks.append(attend(q[begin:end], [KeySource(cache.k[:, :keys], cache.v[:, :keys], seen)]))
    return jnp.concatenate(blocks)


ROW_QUERIES = 64
"""Queries that a row of examples answers at a time: few, for each block is given all keys within reach."""

ROW_BLOCKS = 16
"""Blocks of a row at most."""


def attend_in_segments(q: Float[Array, "W KV R d"], cache: LayerCache, segments: Segments) -> Float[Array, "W hd"]:
    """Attention of each token over those of its own segment up to itself, in blocks of queries."""
    width, blocks = q.shape[0], []
    rows = max(ROW_QUERIES, -(-width // ROW_BLOCKS))
    for begin in range(0, width, rows):
        end, first = min(begin + rows, width), max(0, begin + 1 - segments.reach)
        causal = jnp.tri(end - begin, end - first, begin - first, dtype=bool)
        seen = causal & (segments.number[begin:end, None] == segments.number[first:end])
        blocks.append(attend(q[begin:end], [KeySource(cache.k[:, first:end], cache.v[:, first:end], seen)]))
    return jnp.concatenate(blocks)
