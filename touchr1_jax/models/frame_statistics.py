"""Fixed statistics of pictures: how much a patch of a tactile stream changed, and at which scales it has gradients.

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

VIEW_CENTRE = np.repeat(np.array([0.46, -2.8, -2.3], np.float32), 3)
VIEW_SPREAD = np.repeat(np.array([0.12, 0.27, 0.28], np.float32), 3)
"""Mean and spread of the statistics of cells of 32 px of the pictures of generated objects."""


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
    """Statistics of every patch and those of all patches together, on a scale of about unit spread.

    Raises:
      ValueError: as `frame_statistics`.
    """
    means = _patch_means(frames, patch_px)
    local, whole = _statistics(means), _statistics([x.mean(-2, keepdims=True) for x in means])
    joined = jnp.concatenate([local, jnp.broadcast_to(whole, local.shape)], -1)
    return (joined - np.tile(CENTRE, 2)) / np.tile(SPREAD, 2)


def view_statistics(view: Real[Array, "*n H W 3"], cell_px: int) -> Float[Array, "*n cell statistic"]:
    """Statistics of every cell of a picture and those of all cells together, on a scale of about unit spread.

    The mean, and the logarithm of the mean absolute gradient at pixel and at 4-pixel scale, of 3 channels each.

    Args:
      view: pixel values 0..255.
      cell_px: side of a cell, as `patch_px` of `frame_statistics`.

    Raises:
      ValueError: as `frame_statistics`.
    """
    _check_patches(view.shape, cell_px, cell_px)
    x = view.astype(jnp.float32) / 255.0
    means = [_mean(x, cell_px, cell_px), *_gradients(x, cell_px, cell_px)]
    whole = [jnp.broadcast_to(m.mean(-2, keepdims=True), m.shape) for m in means]
    of_colour = lambda colour, *gradients: jnp.concatenate([colour, *(jnp.log(g + TINY) for g in gradients)], -1)
    return jnp.concatenate([(of_colour(*part) - VIEW_CENTRE) / VIEW_SPREAD for part in (means, whole)], -1)


def _check_patches(shape: Sequence[int], rows: int, columns: int) -> None:
    """Refuse frames [*n, H, W, 3] that do not divide into patches of so many pixels."""
    *_, h, w, _ = shape
    if h % rows or w % columns or any(side % COARSE_PX or side < 2 * COARSE_PX for side in (rows, columns)):
        raise ValueError(
            f"frames of {h} × {w} px in patches of {rows} × {columns} px: must divide into patches whose sides are "
            f"multiples of {COARSE_PX} px and at least {2 * COARSE_PX}; resize the frames or change the patch"
        )


def _statistics(means: Sequence[Float[Array, "*n F patch 3"]]) -> Float[Array, "*n F patch statistic"]:
    """The statistics that follow from `_patch_means`."""
    centre, size, square, fine, coarse = means
    spread = jnp.sqrt(jnp.maximum(square - centre**2, 0.0))
    log_size, log_spread, log_fine, log_coarse = (jnp.log(x + TINY) for x in (size, spread, fine, coarse))
    since_first = (x - x[..., :1, :, :] for x in (log_fine, log_coarse))
    return jnp.concatenate([centre, log_size, log_spread, log_fine, log_coarse, *since_first], -1)


def _patch_means(frames: Real[Array, "*n F H W 3"], patch_px: int | None) -> list[Float[Array, "*n F patch 3"]]:
    """Means over the pixels of each patch: of c, |c|, c², and the absolute gradient at both scales."""
    rows, columns = frames.shape[-3:-1] if patch_px is None else (patch_px, patch_px)
    _check_patches(frames.shape, rows, columns)
    x = frames.astype(jnp.float32) / 255.0
    change = x - x[..., :1, :, :, :]
    return [*(_mean(y, rows, columns) for y in (change, jnp.abs(change), change**2)), *_gradients(x, rows, columns)]


def _gradients(x: Float[Array, "*n H W 3"], rows: int, columns: int) -> list[Float[Array, "*n patch 3"]]:
    """Mean absolute gradient of each patch at the scale of a pixel and of the means over `COARSE_PX`."""
    return [_gradient(x, rows, columns), _gradient(_shrunk(x), rows // COARSE_PX, columns // COARSE_PX)]


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
    sideways = jnp.abs(lines[..., c:] - lines[..., :-c]).mean(-2)
    sideways = jnp.pad(sideways, [(0, 0)] * (sideways.ndim - 1) + [(0, c)])
    horizontal = sideways.reshape(*lead, h // rows, w // columns, columns, c)[..., : columns - 1, :]
    return (vertical.mean(-2) + horizontal.mean(-2)).reshape(*lead, -1, c)


def _mean(x: Float[Array, "*n H W 3"], rows: int, columns: int) -> Float[Array, "*n patch 3"]:
    """Mean over the pixels of each patch; rows first, over long lines: three channels alone do not vectorise."""
    *lead, h, w, c = x.shape
    x = x.reshape(*lead, h // rows, rows, w * c).mean(-2)
    return x.reshape(*lead, h // rows, w // columns, columns, c).mean(-2).reshape(*lead, -1, c)
