"""Shapes of Qwen2.5-VL and of dense Qwen3-VL: the published sizes, and any other from a checkpoint's `config.json`."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from touchr1_jax.models.decoder_config import DecoderConfig, Qwen3DecoderConfig
from touchr1_jax.validation import at_least

CONFIG_FILE = "config.json"
COLOURS = 3
"""Channels of a picture."""

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
"""Mean and spread of pixels in [0, 1] on CLIP's training data (Radford et al. 2021), per channel."""

ROPE_THETA = 1e4
"""Base of the vision towers' rotary angles, the same in every released checkpoint and named in none."""

ModelType = Literal["qwen2_5_vl", "qwen3_vl"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class TowerConfig:
    """Shape that the vision towers share.

    A patch is `patch_px`² pixels of `patch_frames` frames; `merge`² patches become one token of `out_size` channels.

    Raises:
      ValueError: a size below 1, heads that do not divide the width or cannot turn in two axes.
    """

    model_type: ClassVar[ModelType]
    pixel_mean: ClassVar[tuple[float, ...]]
    pixel_std: ClassVar[tuple[float, ...]]
    """Pixels in [0, 1] have this mean subtracted, and are divided by this spread."""

    out_size: int
    depth: int
    hidden_size: int
    num_heads: int = 16
    intermediate_size: int
    patch_px: int
    patch_frames: int = 2
    merge: int = 2

    def __post_init__(self) -> None:
        at_least(self, 1, "hidden_size", "num_heads", "patch_px", "patch_frames", "merge")
        if self.hidden_size % (4 * self.num_heads):
            raise ValueError(
                f"vision hidden_size {self.hidden_size} must be a multiple of 4 · num_heads = {4 * self.num_heads}: "
                "a head turns by row and by column"
            )

    @property
    def levels(self) -> int:
        """K, layers of the tower whose features reach the decoder in addition to those of the last."""
        return 0

    @property
    def cell_px(self) -> int:
        """Side of the square that becomes one token, pixels."""
        return self.patch_px * self.merge

    @property
    def patch_size(self) -> int:
        """Numbers in one patch: channel, frame, row, column."""
        return COLOURS * self.patch_frames * self.patch_px**2


@dataclasses.dataclass(frozen=True, kw_only=True)
class QwenVisionConfig(TowerConfig):
    """Qwen2.5-VL's tower; the defaults are the published one, which differs between sizes in its exit alone.

    Layers attend inside windows of `window_px`² pixels, those in `full_layers` inside the whole frame.

    Raises:
      ValueError: as `TowerConfig`, a window that is no whole number of merged patches, or full layers outside the
        tower.
    """

    model_type = "qwen2_5_vl"
    pixel_mean, pixel_std = CLIP_MEAN, CLIP_STD

    depth: int = 32
    hidden_size: int = 1280
    intermediate_size: int = 3420
    patch_px: int = 14
    window_px: int = 112
    full_layers: tuple[int, ...] = (7, 15, 23, 31)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window_px % self.cell_px:
            raise ValueError(
                f"window_px {self.window_px} must be a multiple of patch_px · merge = {self.cell_px}: a window holds "
                "whole tokens"
            )
        if not all(0 <= layer < self.depth for layer in self.full_layers):
            raise ValueError(f"full layers are {list(self.full_layers)}: must lie in 0..{self.depth - 1}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Qwen3VisionConfig(TowerConfig):
    """Qwen3-VL's tower; the defaults are that of the 2B and the 4B.

    A table of `positions` places, a square grid, is stretched over each frame.  The features of `deepstack_layers` are
    added in the decoder, see `models.deepstack`.

    Raises:
      ValueError: as `TowerConfig`, places that are no square, or layers outside the tower or out of order.
    """

    model_type = "qwen3_vl"
    pixel_mean = pixel_std = (0.5, 0.5, 0.5)

    depth: int = 24
    hidden_size: int = 1024
    intermediate_size: int = 4096
    patch_px: int = 16
    positions: int = 2304
    deepstack_layers: tuple[int, ...] = (5, 11, 17)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.side**2 != self.positions:
            raise ValueError(f"num_position_embeddings is {self.positions}: must be a square, of places on a grid")
        layers = self.deepstack_layers
        if list(layers) != sorted({*layers}) or not all(0 <= layer < self.depth for layer in layers):
            raise ValueError(
                f"deepstack_visual_indexes is {list(layers)}: must rise and lie in 0..{self.depth - 1}, the layers of "
                "the tower; correct config.json"
            )

    @property
    def levels(self) -> int:
        """K, layers of the tower whose features reach the decoder in addition to those of the last."""
        return len(self.deepstack_layers)

    @property
    def side(self) -> int:
        """Places along one side of the table's grid."""
        return math.isqrt(self.positions)


AnyVision = QwenVisionConfig | Qwen3VisionConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class QwenConfig:
    """Both towers, and the ids of the tokens that stand for what is seen.

    Raises:
      ValueError: vision tokens as wide as no token of the decoder, as many levels as the decoder has layers, or ids
        outside the vocabulary or used twice.
    """

    decoder: DecoderConfig
    vision: AnyVision
    vision_start_id: int = 151652
    vision_end_id: int = 151653
    image_id: int = 151655
    video_id: int = 151656

    def __post_init__(self) -> None:
        if self.vision.out_size != self.decoder.hidden_size:
            raise ValueError(
                f"vision out_size {self.vision.out_size} must equal the decoder's hidden_size "
                f"{self.decoder.hidden_size}: vision tokens stand among text tokens"
            )
        if self.vision.levels >= self.decoder.num_layers:
            raise ValueError(
                f"deepstack_visual_indexes names {self.vision.levels} layers: must be fewer than the decoder's "
                f"num_hidden_layers {self.decoder.num_layers}, since one is added after each; correct config.json"
            )
        ids = (self.vision_start_id, self.vision_end_id, self.image_id, self.video_id)
        if len(set(ids)) < len(ids) or not all(0 <= i < self.decoder.vocab_size for i in ids):
            raise ValueError(
                f"vision_start_id, vision_end_id, image_id, video_id are {ids}: must be four different ids below "
                f"vocab_size {self.decoder.vocab_size}"
            )


def _qwen2_5(width: int, num_layers: int, num_heads: int, num_kv_heads: int, mlp: int, **vision: Any) -> QwenConfig:
    decoder = DecoderConfig(
        vocab_size=151936 if width < 3584 else 152064,
        hidden_size=width,
        num_layers=num_layers,
        num_heads=num_heads,
        num_kv_heads=num_kv_heads,
        head_dim=128,
        intermediate_size=mlp,
        mrope_section=(16, 24, 24),
        rope_theta=1e6,
        tie_embedding=width < 3584,
    )
    return QwenConfig(decoder=decoder, vision=QwenVisionConfig(out_size=width, **vision))


def _qwen3(width: int, num_layers: int, num_heads: int, mlp: int, **vision: Any) -> QwenConfig:
    decoder = Qwen3DecoderConfig(
        vocab_size=151936,
        hidden_size=width,
        num_layers=num_layers,
        num_heads=num_heads,
        num_kv_heads=8,
        head_dim=128,
        intermediate_size=mlp,
        mrope_section=(24, 20, 20),
        rope_theta=5e6,
        tie_embedding=width < 4096,
    )
    return QwenConfig(decoder=decoder, vision=Qwen3VisionConfig(out_size=width, **vision))


RELEASED: Mapping[str, QwenConfig] = {
    "3B": _qwen2_5(2048, 36, 16, 2, 11008),
    "7B": _qwen2_5(3584, 28, 28, 4, 18944),
    "32B": _qwen2_5(5120, 64, 40, 8, 27648, intermediate_size=3456),
    "Qwen3-VL-2B": _qwen3(2048, 28, 16, 6144),
    "Qwen3-VL-4B": _qwen3(2560, 36, 32, 9728),
    "Qwen3-VL-8B": _qwen3(
        4096, 36, 32, 12288, depth=27, hidden_size=1152, intermediate_size=4304, deepstack_layers=(8, 16, 24)
    ),
}
"""Shapes of released checkpoints: Qwen2.5-VL (arXiv 2502.13923, table 1, and the later 32B) and the smaller dense
Qwen3-VL (arXiv 2511.21631), as their `config.json` states them.
"""


def released(size: str) -> QwenConfig:
    """Shape of a released checkpoint, one of `RELEASED`.

    Raises:
      ValueError: another size.
    """
    if size not in RELEASED:
        raise ValueError(f"size is {size!r}: must be one of {', '.join(RELEASED)}; read others with read_config")
    return RELEASED[size]
