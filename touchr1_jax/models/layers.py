"""Layers that the towers share: RMS normalisation, gated MLP, rotary positions, attention over several key blocks."""

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

MASKED = -1e9
"""Score of a forbidden key or token: finite, so that 0 · MASKED is 0 and no NaN arises from differences."""


class RMSNorm(nn.Module):
    """Root-mean-square normalisation, x · g / √(mean x² + ε) (Zhang & Sennrich 2019), computed in float32."""

    epsilon: float = 1e-6

    @nn.compact
    def __call__(self, x: Float[Array, "*n D"]) -> Float[Array, "*n D"]:
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        wide = x.astype(jnp.float32)
        normed = wide * jax.lax.rsqrt(jnp.mean(wide * wide, -1, keepdims=True) + self.epsilon)
        return (normed * scale).astype(x.dtype)


class GatedMLP(nn.Module):
    """SwiGLU, W_d (silu(W_g x) ⊙ W_u x) (Shazeer 2020), without biases."""

    hidden: int

    @nn.compact
    def __call__(self, x: Float[Array, "*n D"]) -> Float[Array, "*n D"]:
        gate = nn.Dense(self.hidden, use_bias=False, name="gate")(x)
        up = nn.Dense(self.hidden, use_bias=False, name="up")(x)
        return nn.Dense(x.shape[-1], use_bias=False, name="down")(nn.silu(gate) * up)


class Rotation(NamedTuple):
    """Cosine and sine of the rotary angles, one row per token."""

    cos: Float[Array, "T half"]
    sin: Float[Array, "T half"]


def mrope(positions: Int[Array, "3 T"], head_dim: int, sections: Sequence[int], theta: float) -> Rotation:
    """Multimodal rotary angles, position[axis(j)] · θ^(−2j/d) for frequency j (Qwen2-VL, arXiv 2409.12191, §2.1).

    Args:
      positions: (time, row, column) ids of each token; a text token carries its index three times.
      head_dim: width d of one attention head.
      sections: how many of the d/2 frequencies follow time, row and column, in this order.
      theta: base of the frequencies.

    Raises:
      ValueError: when the sections do not fill half a head.
    """
    if sum(sections) != head_dim // 2 or len(sections) != 3:
        raise ValueError(f"mrope sections {tuple(sections)} must be three that sum to head_dim/2 = {head_dim // 2}")
    axis = np.repeat(np.arange(3), sections)
    frequency = theta ** (-np.arange(0, head_dim, 2, dtype=np.float64) / head_dim)
    angle = positions.astype(jnp.float32)[axis].T * jnp.asarray(frequency, jnp.float32)
    return Rotation(jnp.cos(angle), jnp.sin(angle))


def rotate(x: Float[Array, "T *heads d"], rotation: Rotation) -> Float[Array, "T *heads d"]:
    """Turn each (first half, second half) pair of a head by its token's angles."""
    shape = (x.shape[0],) + (1,) * (x.ndim - 2) + (x.shape[-1] // 2,)
    cos, sin = rotation.cos.reshape(shape).astype(x.dtype), rotation.sin.reshape(shape).astype(x.dtype)
    first, second = jnp.split(x, 2, -1)
    return jnp.concatenate([first * cos - second * sin, second * cos + first * sin], -1)


class KeySource(NamedTuple):
    """One block of keys that queries may look at; `mask` says which, [Tq, n] or [n]."""

    k: Float[Array, "KV n d"]
    v: Float[Array, "KV n d"]
    mask: Bool[Array, "..."]


def attend(q: Float[Array, "T KV R d"], sources: Sequence[KeySource]) -> Float[Array, "T KV*R*d"]:
    """Grouped-query attention of one sequence over the union of several key blocks, softmax(q kᵀ/√d) v.

    The blocks stay apart, so that keys shared by a group of rollouts are stored and multiplied once under `vmap`.
    The softmax runs in float32.
    """
    scale = q.shape[-1] ** -0.5
    scores = [
        jnp.where(s.mask, jnp.einsum("tkrd,knd->krtn", q, s.k).astype(jnp.float32) * scale, MASKED) for s in sources
    ]
    top = jnp.max(jnp.stack([jnp.max(s, -1) for s in scores]), 0)[..., None]
    weights = [jnp.exp(s - jax.lax.stop_gradient(top)) for s in scores]
    total = sum((jnp.sum(w, -1) for w in weights), start=jnp.zeros(()))  # [KV, R, T]
    mixed = sum(jnp.einsum("krtn,knd->tkrd", w.astype(q.dtype), s.v) for w, s in zip(weights, sources, strict=True))
    normed = mixed / total.transpose(2, 0, 1)[..., None].astype(q.dtype)
    return normed.reshape(q.shape[0], -1)
