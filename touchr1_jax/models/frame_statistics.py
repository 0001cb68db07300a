"""Fixed statistics of the frames of a tactile stream: how much a patch changed, and at which scales it has gradients.

Pressure and texture act on these by orders of magnitude, so that their logarithms are what a small network can use.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

TINY = 1e-4  # keeps log(energy) of a constant image finite; energies are in units of full scale
COARSE_PX = 4
"""Side of the squares whose means make the coarse picture."""

WIDTH = 2 * 7 * 3
"""Numbers of a patch: seven statistics of three channels, of the patch and of all patches together."""

CENTRE = np.repeat(np.array([0.0, -4.5, -4.5, -3.4, -3.2, 0.3, 0.35], np.float32), 3)
SPREAD = np.repeat(np.array([0.03, 2.8, 2.9, 2.0, 1.2, 0.5, 0.6], np.float32), 3)
"""Mean and spread of the statistics of patches of 28 px in generated scenes."""


def frame_statistics(
    frames: Real[Array, "*n F H W 3"], patch_px: int | None = None
) -> Float[Array, "*n F patch statistic"]:
    """Statistics of every patch of every frame, 7 kinds of 3 channels each.

    With the change c = x − x_first: mean c, log mean |c|, log spread c, the logarithm of the mean absolute gradient at
    pixel and at 4-pixel scale, and the change of both logarithms since the first frame.  Gradients are differences of
    neighbours inside a patch.

    Args:
      frames: pixel values 0..255.
      patch_px: side of a patch, a multiple of `COARSE_PX` and at least twice that; by default the frame is one patch.

    Raises:
      ValueError: frames that do not divide into such patches.
    """
    return _statistics(_patch_means(frames, patch_px))


def scaled_statistics(frames: Real[Array, "*n F H W 3"], patch_px: int) -> Float[Array, "*n F patch statistic"]:
    """Statistics of every patch beside those of all patches together, on a scale of about unit spread.

    Raises:
      ValueError: as `frame_statistics`.
    """
    means = _patch_means(frames, patch_px)
    local, whole = _statistics(means), _statistics([x.mean(-2, keepdims=True) for x in means])
    joined = jnp.concatenate([local, jnp.broadcast_to(whole, local.shape)], -1)
    return (joined - np.tile(CENTRE, 2)) / np.tile(SPREAD, 2)


def _statistics(means: Sequence[Float[Array, "*n F patch 3"]]) -> Float[Array, "*n F patch statistic"]:
    """The statistics that follow from `_patch_means`."""
    centre, size, square, fine, coarse = means
    spread = jnp.sqrt(jnp.maximum(square - centre**2, 0.0))
    log_size, log_spread, log_fine, log_coarse = (jnp.log(x + TINY) for x in (size, spread, fine, coarse))
    since_first = (x - x[..., :1, :, :] for x in (log_fine, log_coarse))
    return jnp.concatenate([centre, log_size, log_spread, log_fine, log_coarse, *since_first], -1)


def _patch_means(frames: Real[Array, "*n F H W 3"], patch_px: int | None) -> list[Float[Array, "*n F patch 3"]]:
    """Means over the pixels of each patch: of c, |c|, c², and the absolute gradient at both scales."""
    *_, h, w, _ = frames.shape
    rows, columns = (h, w) if patch_px is None else (patch_px, patch_px)
    if h % rows or w % columns or any(side % COARSE_PX or side < 2 * COARSE_PX for side in (rows, columns)):
        raise ValueError(
            f"frames of {h} × {w} px in patches of {patch_px} px: must divide into patches whose sides are multiples "
            f"of {COARSE_PX} px and at least {2 * COARSE_PX}; resize the frames or change the patch"
        )
    x = frames.astype(jnp.float32) / 255.0
    change = x - x[..., :1, :, :, :]
    mean = [_mean(y, rows, columns) for y in (change, jnp.abs(change), change**2)]
    coarse = _gradient(_shrunk(x), rows // COARSE_PX, columns // COARSE_PX)
    return [*mean, _gradient(x, rows, columns), coarse]


def _shrunk(x: Float[Array, "*n H W 3"]) -> Float[Array, "*n h w 3"]:
    """Means over squares of `COARSE_PX`."""
    *lead, h, w, c = x.shape
    x = x.reshape(*lead, h // COARSE_PX, COARSE_PX, w * c).mean(-2)
    return x.reshape(*lead, h // COARSE_PX, w // COARSE_PX, COARSE_PX, c).mean(-2)


def _gradient(x: Float[Array, "*n H W 3"], rows: int, columns: int) -> Float[Array, "*n patch 3"]:
    """Mean absolute difference of vertical neighbours inside each patch, plus that of horizontal ones."""
    *lead, h, w, c = x.shape
    lines = x.reshape(*lead, h // rows, rows, w * c)
    vertical = jnp.abs(jnp.diff(lines, axis=-2)).mean(-2).reshape(*lead, h // rows, w // columns, columns, c)
    beside = jnp.abs(lines[..., c:] - lines[..., :-c]).mean(-2)
    beside = jnp.pad(beside, [(0, 0)] * (beside.ndim - 1) + [(0, c)])
    horizontal = beside.reshape(*lead, h // rows, w // columns, columns, c)[..., : columns - 1, :]
    return (vertical.mean(-2) + horizontal.mean(-2)).reshape(*lead, -1, c)


def _mean(x: Float[Array, "*n H W 3"], rows: int, columns: int) -> Float[Array, "*n patch 3"]:
    """Mean over the pixels of each patch; rows first, over long lines: three channels alone do not vectorise."""
    *lead, h, w, c = x.shape
    x = x.reshape(*lead, h // rows, rows, w * c).mean(-2)
    return x.reshape(*lead, h // rows, w // columns, columns, c).mean(-2).reshape(*lead, -1, c)
