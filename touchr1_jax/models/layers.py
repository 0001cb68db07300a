"""Layers that the towers share: RMS normalisation, gated MLP, rotary positions, attention over several key blocks."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.vmappable_dense import Dense

MASKED = -1e9
"""Score of a forbidden key or token: finite, so that 0 · MASKED is 0 and no NaN arises from differences."""

TEMPERATURES = 1e-6, 1e6
"""Range of a divisor of logits in which `MASKED` stays finite and out of reach."""

MOST_LAYERS = 1000
"""Ten times as many as large models have; each is traced by itself, so that more would seem to hang."""


MOST_SIZE, MOST_PX = 2**20, 2**14
"""Of a size in general, and of a picture's side; several times those of the largest models."""


class SizeError(ValueError):
    """Sizes of a model that do not fit together; the message names them, the constraint and the fix."""


def check_sizes(config: Any, *fields: str) -> None:
    """Refuse a config with a size below one, or one whose prompt alone would fill the memory of any machine.

    Raises:
      SizeError: naming the field.
    """
    for field in fields:
        most = MOST_PX if field.endswith("_px") else MOST_SIZE
        if not 1 <= getattr(config, field) <= most:
            raise SizeError(f"{field} is {getattr(config, field)}: must be at least 1 and at most {most:,}; change it")


def check_layers(config: Any, least: int) -> None:
    """Refuse a depth below the least, or one that no machine could trace.

    Raises:
      SizeError: naming `num_layers`.
    """
    if not least <= config.num_layers <= MOST_LAYERS:
        raise SizeError(f"num_layers is {config.num_layers}: must lie in {least} … {MOST_LAYERS}; change it")


def check_heads(width: int, heads: int) -> None:
    """Refuse a width that heads cannot share.

    Raises:
      SizeError: naming both.
    """
    if width % heads:
        raise SizeError(f"width {width} must be a multiple of num_heads {heads}; change either")


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
    """SwiGLU, W_d (silu(W_g x) ⊙ W_u x) (Shazeer 2020), with or without biases."""

    hidden: int
    use_bias: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*n D"]) -> Float[Array, "*n D"]:
        gate = Dense(self.hidden, use_bias=self.use_bias, name="gate")(x)
        up = Dense(self.hidden, use_bias=self.use_bias, name="up")(x)
        return Dense(x.shape[-1], use_bias=self.use_bias, name="down")(gated(gate, up))


@jax.custom_vjp
def gated(gate: Float[Array, "*n D"], up: Float[Array, "*n D"]) -> Float[Array, "*n D"]:
    """silu(gate) ⊙ up; the gradient, in reverse mode alone, computes σ(gate) again, which XLA on CPU would store."""
    return nn.silu(gate) * up


def _gated_backward(saved: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    gate, up = saved
    share = nn.sigmoid(gate)
    return g * up * share * (1 + gate * (1 - share)), g * gate * share


gated.defvjp(lambda gate, up: (gated(gate, up), (gate, up)), _gated_backward)


class Rotation(NamedTuple):
    """Cosine and sine of the rotary angles, one row per token."""

    cos: Float[Array, "T half"]
    sin: Float[Array, "T half"]


def mrope(
    positions: Int[Array, "3 T"], head_dim: int, sections: Sequence[int], theta: float, *, interleaved: bool = False
) -> Rotation:
    """Multimodal rotary angles, position[axis(j)] · θ^(−2j/d) for frequency j (Qwen2-VL, arXiv 2409.12191, §2.1).

    Args:
      positions: (time, row, column) ids of each token; a text token carries its index three times.
      head_dim: width d of one attention head.
      sections: how many of the d/2 frequencies follow time, row and column, in this order.
      theta: base of the frequencies.
      interleaved: the axes take turns, time, row, column, time, …, until the shorter sections are used up, and time has
        the rest (Qwen3-VL, arXiv 2511.21631, §2.1).

    Raises:
      ValueError: when the sections do not fill half a head.
    """
    if sum(sections) != head_dim // 2 or len(sections) != 3:
        raise ValueError(f"mrope sections {tuple(sections)} must be three that sum to head_dim/2 = {head_dim // 2}")
    axis = np.repeat(np.arange(3), sections)
    if interleaved:
        axis = np.zeros(head_dim // 2, int)
        for i in (1, 2):
            axis[i : 3 * sections[i] : 3] = i
    frequency = theta ** (-np.arange(0, head_dim, 2, dtype=np.float64) / head_dim)
    angle = positions.astype(jnp.float32)[axis].T * jnp.asarray(frequency, jnp.float32)
    return Rotation(jnp.cos(angle), jnp.sin(angle))


def rotate(x: Float[Array, "*g T H d"], rotation: Rotation) -> Float[Array, "*g T H d"]:
    """Turn each (first half, second half) pair of a head by its token's angles."""
    half = x.shape[-1] // 2
    whole = lambda first, second: jnp.concatenate([first, second], -1)[:, None].astype(x.dtype)
    cos, sin = whole(rotation.cos, rotation.cos), whole(-rotation.sin, rotation.sin)
    exchange = jnp.asarray(np.roll(np.eye(2 * half), half, 0), x.dtype)
    # A product, since XLA on CPU writes a concatenation number by number; exact, for each sum has one term.
    return x * cos + jnp.matmul(x, exchange, precision=jax.lax.Precision.HIGHEST) * sin


class KeySource(NamedTuple):
    """One block of keys that queries may look at, shared by a group of sequences or one for each (*g).

    `mask` says which queries may look at which keys, [Tq, n] or, for all queries, [n].
    """

    k: Float[Array, "KV *g n d"]
    v: Float[Array, "KV *g n d"]
    mask: Bool[Array, "..."]


MOST_SCORES = 2**26
"""Scores of attention that may exist at once, 256 MB in float32.  In a layer of the 7B, eight answers of 512 tokens
after a prompt of 4 480 have eight times as many; the backward pass needs three such arrays."""


def attend(
    q: Float[Array, "*g T KV R d"], sources: Sequence[KeySource], most: int = MOST_SCORES
) -> Float[Array, "*g T KV*R*d"]:
    """Grouped-query attention over the union of several key blocks, softmax(q kᵀ/√d) v, of one sequence or of a group.

    The blocks stay apart, so that keys that a group shares are stored and multiplied once.  The softmax runs in
    float32.  Queries with more than `most` scores take turns.
    """
    *lead, t, kv, r, d = q.shape
    by_head = (q * d**-0.5).reshape(-1, t, kv, r, d).transpose(2, 0, 3, 1, 4)
    rows = by_head.reshape(kv, -1, r * t, d)  # all queries of a key head and a sequence as one matrix
    masks = tuple(jnp.tile(s.mask, (r, 1)) if s.mask.ndim == 2 else s.mask for s in sources)
    whose = lambda x: x.reshape(kv, -1, *x.shape[-2:])
    keys, values = tuple(whose(s.k) for s in sources), tuple(whose(s.v) for s in sources)
    turns = -(-math.prod(rows.shape[:-1]) * sum(k.shape[-2] for k in keys) // most)
    mixed = _mix(rows, keys, values, masks) if turns <= 1 else _mix_in_turns(turns, rows, keys, values, masks)
    return mixed.reshape(kv, -1, r, t, d).transpose(1, 3, 0, 2, 4).reshape(*lead, t, -1)


_Blocks = tuple[Array, ...]


@jax.custom_vjp
def _mix(rows: Array, keys: _Blocks, values: _Blocks, masks: _Blocks) -> Array:
    """softmax(rows · keysᵀ) · values; rows [KV, G, n, d], keys and values [KV, G or 1, m, d] block by block.

    The gradient computes the weights again from the saved normaliser (FlashAttention, arXiv 2205.14135, appendix B.2):
    a third of the memory and half of the time of differentiating through them.
    """
    return _mix_forward(rows, keys, values, masks)[0]


def _mix_forward(rows: Array, keys: _Blocks, values: _Blocks, masks: _Blocks) -> tuple[Array, tuple[Any, ...]]:
    scores = [_scores(rows, k, m) for k, m in zip(keys, masks, strict=True)]
    top = functools.reduce(jnp.maximum, (_by_lanes(jnp.max, s) for s in scores))
    weights = [jnp.exp(s - top) for s in scores]
    total = sum((_by_lanes(jnp.sum, w) for w in weights), start=jnp.zeros(()))
    mixed = sum((_product(w, v) for w, v in zip(weights, values, strict=True)), start=jnp.zeros(()))
    out = (mixed / total).astype(rows.dtype)
    return out, (rows, keys, values, masks, out, top + jnp.log(total))


def _mix_backward(saved: tuple[Any, ...], g: Array) -> tuple[Array, _Blocks, _Blocks, None]:
    rows, keys, values, masks, out, normaliser = saved
    along = jnp.sum(g.astype(jnp.float32) * out, -1, keepdims=True)
    d_rows, d_keys, d_values = jnp.zeros(rows.shape), [], []
    for k, v, m in zip(keys, values, masks, strict=True):
        weight = jnp.exp(_scores(rows, k, m) - normaliser)
        d_score = weight * (_inner(g, v) - along)
        d_rows += _product(d_score, k)
        d_keys.append(_outer(d_score, rows, k))
        d_values.append(_outer(weight, g, v))
    return d_rows.astype(rows.dtype), tuple(d_keys), tuple(d_values), None


_mix.defvjp(_mix_forward, _mix_backward)


def _mix_in_turns(turns: int, rows: Array, keys: _Blocks, values: _Blocks, masks: _Blocks) -> Array:
    """As `_mix`, an equal part of the rows at each turn."""
    n = rows.shape[2]
    size = -(-n // turns)

    def cut(x: Array, axis: int) -> Array:
        """Parts of the rows along a first axis, the last filled up by rows that are dropped."""
        x = jnp.pad(x, [(0, turns * size - n) if i == axis else (0, 0) for i in range(x.ndim)])
        return jnp.moveaxis(x.reshape(*x.shape[:axis], turns, size, *x.shape[axis + 1 :]), axis, 0)

    def turn(part: tuple[Array, tuple[Array | None, ...]]) -> Array:
        own = tuple(whole if m is None else m for whole, m in zip(masks, part[1], strict=True))
        return _mix(part[0], keys, values, own)

    mixed = jax.lax.map(turn, (cut(rows, 2), tuple(cut(m, 0) if m.ndim == 2 else None for m in masks)))
    return jnp.moveaxis(mixed, 0, 2).reshape(*rows.shape[:2], turns * size, -1)[:, :, :n]


def _among(x: Array, block: Array) -> Array:
    """x [KV, G, n, …] as the rows that look at one block of keys: those of all sequences where they share it."""
    return x.reshape(x.shape[0], block.shape[1], -1, x.shape[-1])


def _scores(rows: Array, keys: Array, mask: Array) -> Array:
    return jnp.where(mask, _inner(rows, keys, jnp.float32), MASKED)


def _inner(rows: Array, keys: Array, kind: DTypeLike | None = None) -> Array:
    found = jnp.einsum("kgnd,kgmd->kgnm", _among(rows, keys), keys, preferred_element_type=kind)
    return found.reshape(*rows.shape[:-1], -1)


def _product(weights: Array, values: Array) -> Array:
    weights, shape = weights.astype(values.dtype), (*weights.shape[:-1], values.shape[-1])
    mixed = jnp.einsum("kgnm,kgmd->kgnd", _among(weights, values), values, preferred_element_type=jnp.float32)
    return mixed.reshape(shape)


def _outer(weights: Array, rows: Array, block: Array) -> Array:
    """Σ over the rows that look at a block, weightsᵀ rows.

    Computed as (rowsᵀ weights)ᵀ: XLA's products on CPU read the narrow operand by columns four times as fast.
    """
    found = jnp.einsum("kgnd,kgnm->kgdm", _among(rows, block), _among(weights, block))
    return jnp.swapaxes(found, -1, -2).astype(block.dtype)


_LANES = 16  # float32 numbers of one AVX-512 register


def _by_lanes(reduce: Callable[..., Array], x: Float[Array, "*n m"]) -> Float[Array, "*n 1"]:
    """Reduction of each row, first across registers, then within one: XLA's CPU reductions of rows do not vectorise."""
    *lead, m = x.shape
    whole = m // _LANES * _LANES
    if not whole:
        return reduce(x, -1, keepdims=True)
    folded = reduce(x[..., :whole].reshape(*lead, -1, _LANES), -2)
    return reduce(jnp.concatenate([folded, x[..., whole:]], -1), -1, keepdims=True)
