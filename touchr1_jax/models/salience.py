"""No more than a scene needs: which frames and which patches of a touch are worth reading, found by what changes.

Everything is measured against the first frame of a stream, which shows the untouched or least pressed gel, on every
`STRIDE_PX`-th pixel of the bytes: the choice costs less than a hundredth of what it saves.
"""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Real

from touchr1_jax import masked
from touchr1_jax.types import TouchBatch

STRIDE_PX = 4
"""A contact is many times wider than this; all pixels would show the same at sixteen times the cost."""

FEW_FRAMES = 12
"""Up to this many frames all choices can be compared: 12 over 6 are 924."""


def patch_change(frames: Real[Array, "*n F H W 3"], cell_px: int) -> Float[Array, "*n F patch"]:
    """Mean |x_t − x_0| of every square patch of `cell_px` pixels, in units of the pixels, row by row of patches.

    Raises:
      ValueError: the frames do not divide into patches.
    """
    *lead, f, h, w, _ = frames.shape
    if h % cell_px or w % cell_px:
        raise ValueError(f"frames of {h}×{w} px must divide into patches of {cell_px} px; resize them")
    stride = math.gcd(STRIDE_PX, cell_px)
    x = frames[..., stride // 2 :: stride, stride // 2 :: stride, :].astype(jnp.float32)
    change = jnp.abs(x - x[..., :1, :, :, :]).mean(-1)
    side = cell_px // stride
    cells = change.reshape(*lead, f, h // cell_px, side, w // cell_px, side)
    return cells.mean((-3, -1)).reshape(*lead, f, -1)


def busiest_patches(
    change: Float[Array, "*n F patch"], frame_mask: Bool[Array, "*n F"], count: int
) -> Int[Array, "*n count"]:
    """The `count` patches whose largest change over the frames that exist is largest, in ascending order.

    Args:
      change: of every patch of every frame.
      frame_mask: which frames exist; patches of a stream without one are its first.
      count: how many.
    """
    most = masked.maximum(change, frame_mask[..., None], -2, empty=0.0)
    return jnp.sort(jax.lax.top_k(most, count)[1], -1)


def rest_mean(x: Float[Array, "*n patch D"], kept: Int[Array, "*m k"]) -> Float[Array, "*n kept D"]:
    """The kept tokens, then the mean of all others: what happens nowhere in particular is said once.

    With k = all tokens there are no others and nothing is added.  Merging by mean instead of by similarity (Bolya et
    al. 2023) needs no matching: what is merged is known to be the gel at rest.

    Args:
      x: tokens.
      kept: their positions, broadcast against the leading axes of x.
    """
    kept = jnp.broadcast_to(kept, (*x.shape[:-2], kept.shape[-1]))
    chosen = jnp.take_along_axis(x, kept[..., None], -2)
    others = x.shape[-2] - kept.shape[-1]
    if not others:
        return chosen
    rest = (x.sum(-2, keepdims=True) - chosen.sum(-2, keepdims=True)) / others
    return jnp.concatenate([chosen, rest], -2)


def salient_frames(change: Float[Array, "*n F"], frame_mask: Bool[Array, "*n F"], count: int) -> Int[Array, "*n count"]:
    """The frames that stand for a stream: their cumulative salience lies nearest to evenly spaced levels.

        argmin Σ_k |s_{n_k} − l_k|  over  n_1 < … < n_count,   s_n = Σ_{m≤n} c_m,   l_k from min s to max s

    so that frames lie denser where more happens.  Frames that do not exist come last: they are chosen only when fewer
    than `count` exist.

    Args:
      change: c, how much each frame differs from the first one, F ≤ `FEW_FRAMES`.
      frame_mask: which frames exist; they come first.
      count: how many to choose, ≤ F.

    Raises:
      ValueError: too many frames to compare all choices, or more asked for than there are.
    """
    frames = change.shape[-1]
    if frames > FEW_FRAMES or not 1 <= count <= frames:
        raise ValueError(
            f"count is {count} of {frames} frames: must lie in 1..{frames}, of {FEW_FRAMES} at most; choose on the host"
        )
    choices = np.array(list(itertools.combinations(range(frames), count)))
    total = jnp.cumsum(jnp.where(frame_mask, change, 0.0), -1)
    low, high = total[..., :1], total[..., -1:]
    level = low + (high - low) * np.linspace(0.0, 1.0, count, dtype=np.float32)
    absent = jnp.where(frame_mask, 0.0, 1.0 + high)  # dearer than any distance between levels
    cost = (jnp.abs(total[..., choices] - level[..., None, :]) + absent[..., choices]).sum(-1)
    return jnp.asarray(choices)[jnp.argmin(cost, -1)]


def fewer_frames(batch: TouchBatch, count: int) -> TouchBatch:
    """The batch with the `count` most telling frames of each stream, see `salient_frames`."""
    h, w = batch.frames.shape[-3:-1]
    change = patch_change(batch.frames, math.gcd(h, w)).mean(-1)
    chosen = salient_frames(change, batch.frame_mask, count)
    at = lambda x: jnp.take_along_axis(x, chosen.reshape(*chosen.shape, *(1,) * (x.ndim - chosen.ndim)), 2)
    return dataclasses.replace(
        batch,
        frames=at(batch.frames),
        force_n=at(batch.force_n),
        frame_index=at(batch.frame_index),
        frame_mask=at(batch.frame_mask),
    )
