"""Keys and values of the tokens after a prompt, which a sampler writes in place, token by token."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from touchr1_jax.models.blocked_attention import LayerCache
from touchr1_jax.models.decoder_config import DecoderConfig
from touchr1_jax.models.stacked import UNROLLED


class TokenCache(NamedTuple):
    """Keys and values of one layer, or of a stack of layers.

    Keys are columns: XLA on CPU multiplies them by the query of one token five times as fast as rows.
    """

    k: Float[Array, "*n KV d T"]
    v: Float[Array, "*n KV T d"]


CompletionCaches = tuple[TokenCache, ...]
"""Those of each layer; in a deep decoder those before the last are a stack, [layer, …]."""


def empty_caches(c: DecoderConfig, length: int, dtype: DTypeLike = jnp.float32) -> CompletionCaches:
    """Caches of at most `length` tokens.

    Layers of a small decoder have one each: to attend to one of a stack copies it, for every token.
    """
    before, heads = c.num_layers - 1, c.num_kv_heads
    zeros = lambda *shape: jnp.zeros(shape, dtype)
    empty = lambda *n: TokenCache(zeros(*n, heads, c.head_dim, length), zeros(*n, heads, length, c.head_dim))
    return (empty(),) * c.num_layers if before <= UNROLLED else (empty(before), empty())


def grown(cache: TokenCache, row: LayerCache, i: int | Int[Array, ""] | None, t: Int[Array, ""]) -> TokenCache:
    """The cache, or layer i of a stack, with the keys and values of some tokens from t on."""
    return TokenCache(_write_columns(cache.k, turned(row.k), i, t), write_rows(cache.v, row.v, i, t))


def layer_of(stack: Any, i: int | Int[Array, ""]) -> Any:
    """Layer i of arrays with a first axis for the layer."""
    return jax.tree.map(lambda rows: jax.lax.dynamic_index_in_dim(rows, i, keepdims=False), stack)


def turned(x: Float[Array, "*n a b"]) -> Float[Array, "*n b a"]:
    """Rows as columns."""
    return jnp.swapaxes(x, -1, -2)


def _writer(axis: int) -> Callable[..., Array]:
    """Make the function (cache [*n, KV, …], new [*n, KV, …], i, t) → cache with the new from t on along an axis.

    With i, the cache is a stack [*n, layer, KV, …] whose layer i is written.  It stays a slice update in place under
    `vmap`, where jax's own rule makes a scatter.
    """

    @custom_vmap
    def write(cache: Array, new: Array, i: Array | None, t: Array) -> Array:
        at: list[Any] = [0] * cache.ndim
        at[axis] = t
        if i is not None:
            at[-4], new = i, jnp.expand_dims(new, -4)
        return jax.lax.dynamic_update_slice(cache, new, at)

    @write.def_vmap
    def write_batched(
        size: int, batched: list[bool], cache: Array, new: Array, i: Array | None, t: Array
    ) -> tuple[Array, bool]:
        if batched[2] or batched[3]:
            raise ValueError("all rows of a decoding batch are written at the same index t: do not batch t")
        cache = cache if batched[0] else jnp.broadcast_to(cache, (size, *cache.shape))
        new = new if batched[1] else jnp.broadcast_to(new, (size, *new.shape))
        return write(cache, new, i, t), True

    return write


write_rows, _write_columns = _writer(-2), _writer(-1)
