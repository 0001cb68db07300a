"""Causal attention of prompts two ways: the engine's own, and flash attention through `jax.nn`."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.core.context import Context
from touchr1_jax.models.lm import LayerCache, attend_causally

Flash = Literal["cudnn", "xla"]
"""Who computes `jax.nn.dot_product_attention`: cuDNN's fused kernel, or XLA, which works anywhere."""


class AttentionInputs(NamedTuple):
    """Queries [P, L, H, d], keys and values [P, L, KV, d] of P prompts, and the gradient of what comes out."""

    q: Float[Array, "P L H d"]
    k: Float[Array, "P L KV d"]
    v: Float[Array, "P L KV d"]
    g: Float[Array, "P L H d"]


Attention = Callable[[Array, Array, Array], Array]
"""(q, k, v) → [P, L, H, d]."""


def draw_heads(prompts: int, tokens: int, heads: int, kv_heads: int, head_dim: int) -> AttentionInputs:
    """Normal numbers in bfloat16."""
    keys = jax.random.split(jax.random.key(0), 4)
    shape = lambda count: (prompts, tokens, count, head_dim)
    counts = (heads, kv_heads, kv_heads, heads)
    return AttentionInputs(
        *(jax.random.normal(key, shape(count), jnp.bfloat16) for key, count in zip(keys, counts, strict=True))
    )


def engine_attention(q: Array, k: Array, v: Array) -> Array:
    """The decoder's, in blocks of queries, with its own gradient."""

    def of_prompt(q: Array, k: Array, v: Array) -> Array:
        major = lambda x: jnp.moveaxis(x, 1, 0)
        grouped = q.reshape(q.shape[0], k.shape[1], -1, q.shape[2])
        mixed = attend_causally(grouped, LayerCache(major(k), major(v)), jnp.ones(q.shape[0], bool))
        return mixed.reshape(q.shape)

    return jax.vmap(of_prompt)(q, k, v)


def flash_attention(implementation: Flash) -> Attention:
    """FlashAttention (arXiv 2205.14135) as `jax.nn.dot_product_attention` offers it."""
    return lambda q, k, v: jax.nn.dot_product_attention(q, k, v, is_causal=True, implementation=implementation)


def with_gradient(attention: Attention) -> Callable[[AttentionInputs], tuple[Array, tuple[Array, Array, Array]]]:
    """What comes out, and the gradients of queries, keys and values."""

    def both(h: AttentionInputs) -> tuple[Array, tuple[Array, Array, Array]]:
        out, back = jax.vjp(attention, h.q, h.k, h.v)
        return out, back(h.g)

    return both


def pairs(prompts: int, tokens: int, heads: int) -> float:
    """Pairs of a query and a key that causal attention looks at."""
    return prompts * heads * tokens * (tokens + 1) / 2


def errors(h: AttentionInputs, ways: dict[str, Attention], context: Context) -> dict[str, float]:
    """Largest difference of the first prompt's results and gradients from float32, over the largest number in each.

    Args:
      h: what attends.
      ways: by name.
      context: shows how far it is.
    """
    one = jax.tree.map(lambda x: x[:1], h)
    wide = jax.tree.map(lambda x: x.astype(jnp.float32), one)
    with jax.default_matmul_precision("highest"):
        exact = jax.jit(with_gradient(flash_attention("xla")))(wide)
    found = {}
    for name, way in context.each("comparing attention", ways.items()):
        ours = jax.jit(with_gradient(way))(one)
        found[name] = max(jax.tree.leaves(jax.tree.map(_error, exact, ours)))
    return found


def _error(exact: Array, found: Array) -> float:
    a, b = np.asarray(exact, np.float32), np.asarray(found, np.float32)
    return float(np.abs(a - b).max() / np.abs(a).max())
