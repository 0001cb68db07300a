"""From a conversation with pictures and videos to what `QwenVL` reads."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from touchr1_jax.models.qwen.config import QwenConfig, QwenVisionConfig
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.model import Inputs
from touchr1_jax.models.qwen.pictures import (
    PICTURE_BUDGET,
    VIDEO_BUDGET,
    PixelBudget,
    fitting_size,
    grid_of,
    patchify,
    resize,
)
from touchr1_jax.models.qwen.positions import Seen, picture, position_ids, video
from touchr1_jax.text.chat import ChatMessage, expand, render
from touchr1_jax.text.tokenizer import Tokenizer


class Film(NamedTuple):
    """A video: frames that were sampled at a steady rate, and that rate."""

    frames: UInt8[np.ndarray, "F H W 3"]
    frames_per_second: float


class Shown(NamedTuple):
    """One picture or video ready for the vision tower, and where its tokens lie."""

    patches: Float[Array, "n pixel"]
    grid: Grid
    seen: Seen


def prepare(
    messages: Sequence[ChatMessage],
    tokenizer: Tokenizer,
    config: QwenConfig,
    *,
    pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]] = (),
    videos: Sequence[Film] = (),
    picture_budget: PixelBudget = PICTURE_BUDGET,
    video_budget: PixelBudget = VIDEO_BUDGET,
    reply: bool = True,
) -> tuple[Inputs, tuple[Grid, ...]]:
    """Write a conversation out, make room for what it shows, and place every token.

    Args:
      messages: turns that show pictures and videos.
      tokenizer: that of the checkpoint.
      config: ids and sizes.
      pictures, videos: what is shown, in the order of the conversation, each kind by itself.
      picture_budget, video_budget: pixels of a picture, and of one frame of a video.
      reply: whether the assistant's turn is opened.

    Raises:
      ValueError: more or fewer pictures or videos than the conversation shows, or sizes that cannot be fitted.
    """
    shown = {
        config.image_id: [show_picture(x, config.vision, picture_budget) for x in pictures],
        config.video_id: [show_video(x, config.vision, video_budget) for x in videos],
    }
    text = tokenizer.encode(render(messages, reply=reply))
    ids = np.array(expand(text, {pad: [x.seen.tokens for x in of] for pad, of in shown.items()}))
    in_order, left = [], {pad: iter(of) for pad, of in shown.items()}
    runs: list[int | Seen] = []
    for token in text:
        if token in left:
            in_order.append(next(left[token]))
        runs.append(in_order[-1].seen if token in left else 1)
    patches = [jnp.zeros((0, config.vision.patch_size)), *(x.patches for x in in_order)]
    inputs = Inputs(
        ids=jnp.asarray(ids, jnp.int32),
        positions=jnp.asarray(position_ids(runs), jnp.int32),
        slots=jnp.asarray(np.flatnonzero(np.isin(ids, list(shown))), jnp.int32),
        patches=jnp.concatenate(patches),
    )
    return inputs, tuple(x.grid for x in in_order)


def show_picture(pixels: UInt8[np.ndarray, "H W 3"], config: QwenVisionConfig, budget: PixelBudget) -> Shown:
    """Resize a picture and cut it into patches."""
    frames = _fit(pixels[None], config, budget)
    grid = grid_of(frames.shape, config)
    return Shown(patchify(frames, config), grid, picture(grid, config.merge))


def show_video(film: Film, config: QwenVisionConfig, budget: PixelBudget) -> Shown:
    """Resize a video and cut it into patches of `patch_frames` frames; an odd last frame is shown twice."""
    frames = _fit(film.frames, config, budget)
    grid = grid_of(frames.shape, config)
    seconds = config.patch_frames / film.frames_per_second
    return Shown(patchify(frames, config), grid, video(grid, config.merge, seconds, config.tokens_per_second))


def _fit(
    frames: UInt8[np.ndarray, "F H W 3"], config: QwenVisionConfig, budget: PixelBudget
) -> Float[Array, "F h w 3"]:
    _, height, width, _ = frames.shape
    return resize(frames, *fitting_size(height, width, config.cell_px, budget))
