"""Pixels as the vision tower wants them: sizes in whole tokens, bicubic resizing, normalised patches."""

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real, UInt8

from touchr1_jax.models.qwen.config import CLIP_MEAN, CLIP_STD, COLOURS, ModelType, TowerConfig
from touchr1_jax.models.qwen.geometry import Grid

PREPROCESSOR_FILE, PROCESSOR_FILE = "preprocessor_config.json", "processor_config.json"
"""Settings of pictures as published, and where transformers ≥ 5 writes them, as its part `image_processor`."""

MAX_ASPECT = 200
"""Longest side over shortest, beyond which the released processor refuses a picture."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PixelBudget:
    """Fewest and most pixels that a picture may have after resizing."""

    least: int
    most: int


PICTURE_BUDGET = PixelBudget(least=28 * 28 * 4, most=28 * 28 * 1280)
"""Budget of transformers' processor; a checkpoint may name another."""

RELEASED_BUDGETS: Mapping[ModelType, PixelBudget] = {
    "qwen2_5_vl": PICTURE_BUDGET,
    "qwen3_vl": PixelBudget(least=2**16, most=2**24),
}
"""Type of the model → budget that its released checkpoints name."""


def read_budget(directory: Path, config: TowerConfig) -> PixelBudget:
    """Budget of pictures from a checkpoint's settings of pictures; the rest of them must be what is computed here.

    Args:
      directory: the checkpoint's.
      config: sizes of patches.

    Raises:
      FileNotFoundError: the checkpoint has none.
      ValueError: no JSON, sizes of patches that are not the config's, another normalisation, or no budget.
    """
    path = directory / PREPROCESSOR_FILE
    if not path.is_file() and (directory / PROCESSOR_FILE).is_file():
        path = directory / PROCESSOR_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file: must be the picture settings of a checkpoint; fetch it")
    try:
        written = dict(json.loads(path.read_text(encoding="utf-8")))
        written = dict(written["image_processor"]) if path.name == PROCESSOR_FILE else written
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON object with settings of pictures: {error}; fetch it again") from error
    found = {field: value for field, value in written.items() if value is not None}  # newer files list what is unset
    expected = {
        "patch_size": config.patch_px,
        "temporal_patch_size": config.patch_frames,
        "merge_size": config.merge,
        "image_mean": list(config.pixel_mean),
        "image_std": list(config.pixel_std),
    }
    usual = expected | {"image_mean": list(CLIP_MEAN), "image_std": list(CLIP_STD)}  # of the processor's class
    for field, value in expected.items():
        if (written := found.get(field, usual[field])) != value:
            raise ValueError(f"{path}: {field} is {written}: must be {value}; take all files from one checkpoint")
    size = found.get("size")
    edges = size if isinstance(size, dict) else {}
    least = found.get("min_pixels", edges.get("shortest_edge"))
    most = found.get("max_pixels", edges.get("longest_edge"))
    if least is None or most is None:
        raise ValueError(f"{path} names neither min_pixels and max_pixels nor a size with both edges; add them")
    if not (type(least) is int and type(most) is int and 1 <= least <= most):
        raise ValueError(f"{path}: min_pixels, max_pixels are {least!r}, {most!r}: must be whole, 1 ≤ min ≤ max")
    return PixelBudget(least=least, most=most)


def fitting_size(height: int, width: int, cell_px: int, budget: PixelBudget) -> tuple[int, int]:
    """Height and width in whole tokens within a budget, at nearly the same aspect (`smart_resize` of Qwen2-VL).

    Args:
      height, width: pixels.
      cell_px: side of one token, pixels.
      budget: bounds on height · width.

    Raises:
      ValueError: a picture without pixels, or too long and thin.
    """
    if min(height, width) < 1 or max(height, width) > MAX_ASPECT * min(height, width):
        raise ValueError(f"picture is {height}×{width} px: sides must be ≥ 1 and differ ≤ {MAX_ASPECT}-fold; crop it")
    tokens_high, tokens_wide = round(height / cell_px), round(width / cell_px)
    pixels = tokens_high * tokens_wide * cell_px**2
    if pixels > budget.most:
        shrink = math.sqrt(height * width / budget.most) * cell_px
        tokens_high, tokens_wide = max(1, math.floor(height / shrink)), max(1, math.floor(width / shrink))
    elif pixels < budget.least:
        grow = math.sqrt(budget.least / (height * width)) / cell_px
        tokens_high, tokens_wide = math.ceil(height * grow), math.ceil(width * grow)
    return tokens_high * cell_px, tokens_wide * cell_px


def resize(frames: UInt8[Array | np.ndarray, "*n H W 3"], height: int, width: int) -> Float[Array, "*n h w 3"]:
    """Bicubic resizing with antialiasing, columns first, rounded to whole levels 0..255 after each axis.

    So do the released processor and Pillow, of which new versions take whichever axis is cheaper first.

    Args:
      frames: pictures.
      height, width: wanted, pixels.
    """
    *lead, h, _, c = frames.shape
    x = jnp.asarray(frames).astype(jnp.float32)
    for shape in ((*lead, h, width, c), (*lead, height, width, c)):
        if x.shape != shape:
            x = jnp.clip(jnp.round(jax.image.resize(x, shape, "cubic", antialias=True)), 0, 255)
    return x


def patchify(frames: Real[Array | np.ndarray, "*n F H W 3"], config: TowerConfig) -> Float[Array, "*n patch pixel"]:
    """Cut normalised frames into patches (channel, frame, row, column), merged square by merged square.

    A picture is one frame; a last step that lacks frames repeats the last.

    Args:
      frames: levels 0..255, sides in multiples of `cell_px`.
      config: sizes of patches.

    Raises:
      ValueError: other sides.
    """
    grid = grid_of(frames.shape[-4:], config)
    *lead, f, _, _, _ = frames.shape
    x = jnp.asarray(frames).astype(jnp.float32) / 255.0
    x = (x - np.array(config.pixel_mean, np.float32)) / np.array(config.pixel_std, np.float32)
    missing = grid.steps * config.patch_frames - f
    x = jnp.concatenate([x, jnp.repeat(x[..., -1:, :, :, :], missing, -4)], -4)
    m, p = config.merge, config.patch_px
    x = x.reshape(*lead, grid.steps, config.patch_frames, grid.rows // m, m, p, grid.columns // m, m, p, COLOURS)
    # (step, frame, R, r, y, C, c, x, colour) → (step, R, C, r, c, colour, frame, y, x)
    n = len(lead)
    x = x.transpose(*range(n), *(n + i for i in (0, 2, 5, 3, 6, 8, 1, 4, 7)))
    return x.reshape(*lead, grid.patches, config.patch_size)


def grid_of(shape: tuple[int, ...], config: TowerConfig) -> Grid:
    """Grid of frames of the given (frames, height, width, channels).

    Raises:
      ValueError: no frame, or sides that are no multiples of `cell_px`.
    """
    f, h, w, _ = shape
    if f < 1 or min(h, w) < 1 or h % config.cell_px or w % config.cell_px:
        raise ValueError(
            f"frames are {f} of {h}×{w} px: must be at least one, with sides in multiples of {config.cell_px} px; "
            "resize them to fitting_size"
        )
    return Grid(math.ceil(f / config.patch_frames), h // config.patch_px, w // config.patch_px)
