"""Models of 0.2 million parameters and prompts for them, all by formula: what golden arrays and tests share.

Nothing here imports JAX or PyTorch, so that both sides compute from the same numbers.
"""

import dataclasses
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

GOLDEN = Path(__file__).resolve().parents[3] / "data" / "qwen" / "golden.npz"
VOCAB, VISION_START, VISION_END, IMAGE, VIDEO = 96, 90, 91, 92, 93
MERGE, PATCH_PX, PATCH_FRAMES = 2, 4, 2
PIXELS = 3 * PATCH_FRAMES * PATCH_PX**2


def config_json(*, window_px: int = 16, tied: bool = True) -> dict[str, Any]:
    """A `config.json` in the published layout."""
    return {
        "architectures": ["Qwen2_5_VLForConditionalGeneration"],
        "model_type": "qwen2_5_vl",
        "hidden_act": "silu",
        "hidden_size": 64,
        "intermediate_size": 80,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "max_position_embeddings": 512,
        "rms_norm_eps": 1e-6,
        "rope_theta": 1e6,
        "rope_scaling": {"type": "mrope", "mrope_section": [2, 3, 3]},
        "tie_word_embeddings": tied,
        "use_sliding_window": False,
        "vocab_size": VOCAB,
        "vision_start_token_id": VISION_START,
        "vision_end_token_id": VISION_END,
        "image_token_id": IMAGE,
        "video_token_id": VIDEO,
        "vision_config": {
            "depth": 4,
            "hidden_act": "silu",
            "hidden_size": 32,
            "intermediate_size": 44,
            "num_heads": 2,
            "in_chans": 3,
            "out_hidden_size": 64,
            "patch_size": PATCH_PX,
            "spatial_merge_size": MERGE,
            "temporal_patch_size": PATCH_FRAMES,
            "window_size": window_px,
            "fullatt_block_indexes": [1, 3],
            "tokens_per_second": 2,
        },
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shape:
    """A Qwen3-VL: what differs between the tested ones."""

    hidden: int
    layers: int
    heads: int
    kv_heads: int
    sections: tuple[int, int, int]
    side: int
    deepstack: tuple[int, ...]
    tied: bool


SHAPES = (
    Shape(hidden=64, layers=2, heads=4, kv_heads=2, sections=(4, 2, 2), side=4, deepstack=(1,), tied=True),
    Shape(hidden=48, layers=3, heads=6, kv_heads=3, sections=(4, 3, 3), side=5, deepstack=(0, 2), tied=False),
    Shape(hidden=40, layers=5, heads=5, kv_heads=1, sections=(4, 4, 4), side=7, deepstack=(0, 1, 3), tied=True),
)
STAMP = 3
"""Words before each step of a video in a prompt of Qwen3-VL."""


def qwen3_json(shape: Shape) -> dict[str, Any]:
    """A `config.json` in Qwen3-VL's published layout."""
    rope = {"mrope_interleaved": True, "mrope_section": list(shape.sections), "rope_type": "default"}
    return {
        "architectures": ["Qwen3VLForConditionalGeneration"],
        "model_type": "qwen3_vl",
        "image_token_id": IMAGE,
        "video_token_id": VIDEO,
        "vision_start_token_id": VISION_START,
        "vision_end_token_id": VISION_END,
        "tie_word_embeddings": shape.tied,
        "text_config": {
            "model_type": "qwen3_vl_text",
            "attention_bias": False,
            "head_dim": 2 * sum(shape.sections),
            "hidden_act": "silu",
            "hidden_size": shape.hidden,
            "intermediate_size": 80,
            "max_position_embeddings": 512,
            "num_attention_heads": shape.heads,
            "num_hidden_layers": shape.layers,
            "num_key_value_heads": shape.kv_heads,
            "rms_norm_eps": 1e-6,
            "rope_scaling": rope,
            "rope_theta": 5e6,
            "tie_word_embeddings": shape.tied,
            "vocab_size": VOCAB,
        },
        "vision_config": {
            "model_type": "qwen3_vl",
            "deepstack_visual_indexes": list(shape.deepstack),
            "depth": 4,
            "hidden_act": "gelu_pytorch_tanh",
            "hidden_size": 32,
            "in_channels": 3,
            "intermediate_size": 44,
            "num_heads": 2,
            "num_position_embeddings": shape.side**2,
            "out_hidden_size": shape.hidden,
            "patch_size": PATCH_PX,
            "spatial_merge_size": MERGE,
            "temporal_patch_size": PATCH_FRAMES,
        },
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of so many patches."""

    rows: int
    columns: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Video:
    """A video of so many steps and patches."""

    steps: int
    rows: int
    columns: int
    seconds_per_step: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One prompt for one model; a number among its parts is so many words.

    `ids_as_reference` says that transformers ≥ 5 counts the positions as the released model did, which it does but for
    videos that last longer than they are wide.
    """

    parts: tuple[int | Picture | Video, ...]
    window_px: int = 16
    tied: bool = True
    ids_as_reference: bool = True
    shape: Shape | None = None
    """Of a Qwen3-VL; its `tied` counts."""

    def config(self) -> dict[str, Any]:
        if self.shape is not None:
            return qwen3_json(self.shape)
        return config_json(window_px=self.window_px, tied=self.tied)

    def seen(self) -> list[Picture | Video]:
        return [part for part in self.parts if not isinstance(part, int)]


MIXED = (
    3,
    Picture(rows=4, columns=6),
    2,
    Video(steps=2, rows=6, columns=4, seconds_per_step=1.0),
    1,
    Picture(rows=2, columns=2),
    5,
)

CASES: Mapping[str, Case] = {
    "text": Case(parts=(24,)),
    "text_untied": Case(parts=(24,), tied=False),
    "image": Case(parts=(5, Picture(rows=10, columns=14), 6)),
    "image_window_24": Case(parts=(5, Picture(rows=10, columns=14), 6), window_px=24),
    "image_window_32": Case(parts=(3, Picture(rows=8, columns=16), 4), window_px=32),
    "video": Case(parts=(4, Video(steps=3, rows=8, columns=6, seconds_per_step=0.5), 5)),
    "video_fast": Case(parts=(4, Video(steps=4, rows=4, columns=6, seconds_per_step=0.2), 5), window_px=24),
    "video_long": Case(
        parts=(4, Video(steps=4, rows=4, columns=6, seconds_per_step=1.0), 5), ids_as_reference=False, tied=False
    ),
    "mixed": Case(parts=MIXED),
    **{f"qwen3_text_{i}": Case(parts=(12,), shape=shape) for i, shape in enumerate(SHAPES)},
    **{f"qwen3_mixed_{i}": Case(parts=MIXED, shape=shape) for i, shape in enumerate(SHAPES)},
    "qwen3_image": Case(parts=(5, Picture(rows=10, columns=14), 6), shape=SHAPES[0]),
    "qwen3_video": Case(parts=(4, Video(steps=3, rows=4, columns=6, seconds_per_step=1.0), 5), shape=SHAPES[1]),
    "qwen3_images": Case(
        parts=(2, Picture(rows=6, columns=4), 1, Picture(rows=2, columns=2), Picture(rows=4, columns=8), 3),
        shape=SHAPES[2],
    ),
}


def steps(part: Picture | Video) -> int:
    return part.steps if isinstance(part, Video) else 1


def tokens(part: Picture | Video) -> int:
    return steps(part) * part.rows * part.columns // MERGE**2


def prompt_ids(case: Case) -> np.ndarray:
    """Words by formula; what is seen stands between its two marks."""
    ids: list[int] = []
    words = lambda name, count: [int(w) for w in uniform(f"words {name}", (count,)) * VISION_START]
    for i, part in enumerate(case.parts):
        if isinstance(part, int):
            ids += words(i, part)
        elif isinstance(part, Video) and case.shape is not None:
            for t in range(part.steps):
                pads = [VIDEO] * (tokens(part) // part.steps)
                ids += [*words(f"{i} at {t}", STAMP), VISION_START, *pads, VISION_END]
        else:
            pad = VIDEO if isinstance(part, Video) else IMAGE
            ids += [VISION_START, *[pad] * tokens(part), VISION_END]
    return np.array(ids)


def patches(name: str, part: Picture | Video) -> np.ndarray:
    """Normalised pixels of one picture or video, float32 [n, pixel]."""
    n = steps(part) * part.rows * part.columns
    return (4 * uniform(f"pixels {name}", (n, PIXELS)) - 2).astype(np.float32)


def picture_pixels() -> np.ndarray:
    """A picture of 75 × 60 px with smooth shades, edges and noise, uint8."""
    y, x = np.mgrid[:75, :60]
    shade = np.stack([120 + 100 * np.sin(x / 9), 2.0 * y + x, 255.0 * ((x // 8 + y // 8) % 2)], -1)
    return np.clip(shade + 40 * (uniform("picture", (75, 60, 3)) - 0.5), 0, 255).astype(np.uint8)


SIDE = 16
"""Rows and columns of the frames of `video`, pixels."""


def video(frames: int) -> np.ndarray:
    """Frames of noise, uint8."""
    return (256 * uniform(f"video {frames}", (frames, SIDE, SIDE, 3))).astype(np.uint8)


def tensor(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """A weight by its key without prefix: about the size of a trained one, so that attention is not uniform."""
    x = 2 * uniform(key, shape) - 1
    if len(shape) == 1:
        scale = ("norm" in key or "ln_q" in key) and not key.endswith("bias")
        return (0.3 * x + scale).astype(np.float32)
    fan_in = 1 if "embed_tokens" in key else int(np.prod(shape[1:]))
    return (x * np.sqrt(6 / fan_in)).astype(np.float32)


def uniform(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers in [0, 1) that depend on a name alone; raw bits, the one stream that NumPy promises to keep."""
    raw = np.random.PCG64(zlib.crc32(name.encode())).random_raw(int(np.prod(shape)))
    return (raw >> np.uint64(11)).astype(np.float64).reshape(shape) * 2.0**-53
