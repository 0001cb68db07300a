"""Shapes of Qwen2.5-VL: the published sizes, and any other from a checkpoint's `config.json`."""

import dataclasses
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from touchr1_jax.models.lm import DecoderConfig

CONFIG_FILE = "config.json"
COLOURS = 3
"""Channels of a picture."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class QwenVisionConfig:
    """Shape of the vision tower; the defaults are the published one, which differs between sizes in its exit alone.

    A patch is `patch_px`² pixels of `patch_frames` frames; `merge`² patches become one token of `out_size` channels.
    Layers attend inside windows of `window_px`² pixels, those in `full_layers` inside the whole frame.

    Raises:
      ValueError: heads that do not divide the width or cannot turn in two axes, a window that is no whole number of
        merged patches, or full layers outside the tower.
    """

    out_size: int
    depth: int = 32
    hidden_size: int = 1280
    num_heads: int = 16
    intermediate_size: int = 3420
    patch_px: int = 14
    patch_frames: int = 2
    merge: int = 2
    window_px: int = 112
    full_layers: tuple[int, ...] = (7, 15, 23, 31)

    def __post_init__(self) -> None:
        if self.hidden_size % (4 * self.num_heads):
            raise ValueError(
                f"vision hidden_size {self.hidden_size} must be a multiple of 4 · num_heads = {4 * self.num_heads}: "
                "a head turns by row and by column"
            )
        if self.window_px % self.cell_px:
            raise ValueError(
                f"window_px {self.window_px} must be a multiple of patch_px · merge = {self.cell_px}: a window holds "
                "whole tokens"
            )
        if not all(0 <= layer < self.depth for layer in self.full_layers):
            raise ValueError(f"full layers are {list(self.full_layers)}: must lie in 0..{self.depth - 1}")

    @property
    def cell_px(self) -> int:
        """Side of the square that becomes one token, pixels."""
        return self.patch_px * self.merge

    @property
    def patch_size(self) -> int:
        """Numbers in one patch: channel, frame, row, column."""
        return COLOURS * self.patch_frames * self.patch_px**2


@dataclasses.dataclass(frozen=True, kw_only=True)
class QwenConfig:
    """Both towers, and the ids of the tokens that stand for what is seen.

    Raises:
      ValueError: vision tokens as wide as no token of the decoder, or ids outside the vocabulary or used twice.
    """

    decoder: DecoderConfig
    vision: QwenVisionConfig
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
        ids = (self.vision_start_id, self.vision_end_id, self.image_id, self.video_id)
        if len(set(ids)) < len(ids) or not all(0 <= i < self.decoder.vocab_size for i in ids):
            raise ValueError(
                f"vision_start_id, vision_end_id, image_id, video_id are {ids}: must be four different ids below "
                f"vocab_size {self.decoder.vocab_size}"
            )


RELEASED: Mapping[str, DecoderConfig] = {
    "3B": DecoderConfig(
        vocab_size=151936,
        hidden_size=2048,
        num_layers=36,
        num_heads=16,
        num_kv_heads=2,
        head_dim=128,
        intermediate_size=11008,
        mrope_section=(16, 24, 24),
        rope_theta=1e6,
        tie_embedding=True,
    ),
    "7B": DecoderConfig(
        vocab_size=152064,
        hidden_size=3584,
        num_layers=28,
        num_heads=28,
        num_kv_heads=4,
        head_dim=128,
        intermediate_size=18944,
        mrope_section=(16, 24, 24),
        rope_theta=1e6,
        tie_embedding=False,
    ),
}
"""Decoders of the released checkpoints (arXiv 2502.13923, table 1)."""


def released(size: str) -> QwenConfig:
    """Shape of a released checkpoint, one of `RELEASED`.

    Raises:
      ValueError: another size.
    """
    if size not in RELEASED:
        raise ValueError(f"size is {size!r}: must be one of {', '.join(RELEASED)}; read others with read_config")
    decoder = RELEASED[size]
    return QwenConfig(decoder=decoder, vision=QwenVisionConfig(out_size=decoder.hidden_size))


def read_config(directory: str | Path) -> QwenConfig:
    """Configuration of the checkpoint in a directory.

    Raises:
      FileNotFoundError: there is no `config.json`.
      ValueError: as `parse_config`, or no JSON.
    """
    path = Path(directory) / CONFIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file: must be the config.json of a checkpoint; correct the directory")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON: {error}; fetch it again") from error
    return parse_config(found)


def parse_config(found: Any) -> QwenConfig:
    """Configuration from the contents of a `config.json`, flat as published or nested as newer libraries write it.

    A vision tower whose file states a part of its shape has the published defaults elsewhere (32B, 72B).

    Raises:
      ValueError: a field that is missing, of another type, or that asks for what these modules do not compute.
    """
    root = _Fields(found, "")
    root.require("model_type", "qwen2_5_vl")
    text = root.part("text_config") if "text_config" in root.found else root
    vision = root.part("vision_config")
    tied = any(part.found.get("tie_word_embeddings", False) for part in (root, text))  # absence means no
    return QwenConfig(
        decoder=_decoder(text, tied=tied),
        vision=_vision(vision),
        vision_start_id=root.count("vision_start_token_id"),
        vision_end_id=root.count("vision_end_token_id"),
        image_id=root.count("image_token_id"),
        video_id=root.count("video_token_id"),
    )


class _Fields:
    """A part of a `config.json` whose missing and mistyped fields are named in full."""

    def __init__(self, found: Any, prefix: str) -> None:
        if not isinstance(found, dict):
            raise ValueError(f"{prefix.rstrip('.') or CONFIG_FILE} is {found!r:.60}: must be an object; fetch it again")
        self.found, self.prefix = found, prefix

    def __getitem__(self, name: str) -> Any:
        if name not in self.found:
            raise ValueError(f"config.json lacks {self.prefix}{name}, without which the model has no shape; add it")
        return self.found[name]

    def part(self, name: str) -> "_Fields":
        """A field that must be an object."""
        return _Fields(self[name], f"{self.prefix}{name}.")

    def require(self, name: str, value: Any, *, default: bool = False) -> None:
        """A field that must have a value, which with `default` it has where it is missing."""
        if name not in self.found and not default:
            raise ValueError(f"config.json lacks {self.prefix}{name}: must be {value!r}; add it")
        if self.found.get(name, value) != value:
            raise ValueError(
                f"{self.prefix}{name} is {self.found[name]!r}: must be {value!r}; another architecture cannot be read"
            )

    def count(self, name: str, default: int | None = None) -> int:
        """A field that must be a whole number above 0."""
        value = self[name] if default is None else self.found.get(name, default)
        if type(value) is not int or value < 1:
            raise ValueError(f"{self.prefix}{name} is {value!r}: must be a whole number above 0; correct config.json")
        return value

    def positive(self, name: str) -> float:
        """A field that must be a finite number above 0."""
        value = self[name]
        if type(value) not in (int, float) or not 0 < value <= sys.float_info.max:
            raise ValueError(f"{self.prefix}{name} is {value!r}: must be a number above 0; correct config.json")
        return float(value)

    def counts(self, name: str, default: tuple[int, ...] | None = None) -> tuple[int, ...]:
        """A field that must be a list of whole numbers."""
        value = self[name] if default is None else self.found.get(name, list(default))
        if not isinstance(value, list) or not all(type(x) is int for x in value):
            raise ValueError(f"{self.prefix}{name} is {value!r}: must be a list of whole numbers; correct config.json")
        return tuple(value)


def _decoder(text: _Fields, *, tied: bool) -> DecoderConfig:
    text.require("hidden_act", "silu")
    if text.found.get("use_sliding_window"):
        raise ValueError(f"{text.prefix}use_sliding_window is true: only full attention is computed; set it to false")
    theta, sections = _rope(text)
    hidden, heads = text.count("hidden_size"), text.count("num_attention_heads")
    if hidden % heads:
        raise ValueError(f"{text.prefix}hidden_size {hidden} must be a multiple of num_attention_heads {heads}")
    return DecoderConfig(
        vocab_size=text.count("vocab_size"),
        hidden_size=hidden,
        num_layers=text.count("num_hidden_layers"),
        num_heads=heads,
        num_kv_heads=text.count("num_key_value_heads"),
        head_dim=hidden // heads,
        intermediate_size=text.count("intermediate_size"),
        mrope_section=sections,
        rope_theta=theta,
        norm_epsilon=text.positive("rms_norm_eps"),
        tie_embedding=tied,
    )


def _rope(text: _Fields) -> tuple[float, tuple[int, int, int]]:
    """Base and sections of the rotary positions: `rope_theta` beside `rope_scaling`, or both in `rope_parameters`."""
    rope = text.part("rope_parameters" if "rope_parameters" in text.found else "rope_scaling")
    kinds = [rope.found[k] for k in ("type", "rope_type") if k in rope.found]
    if not all(kind in ("mrope", "default") for kind in kinds):
        raise ValueError(f"{rope.prefix}type is {kinds}: must be 'mrope' or 'default'; nothing else is computed")
    theta = (rope if "rope_theta" in rope.found else text).positive("rope_theta")
    sections = rope.counts("mrope_section")
    if len(sections) != 3:
        raise ValueError(f"{rope.prefix}mrope_section is {list(sections)}: must be three, for time, row and column")
    return theta, sections


def _vision(vision: _Fields) -> QwenVisionConfig:
    vision.require("hidden_act", "silu", default=True)
    for channels in ("in_channels", "in_chans"):
        vision.require(channels, COLOURS, default=True)
    if "tokens_per_second" in vision.found:  # of videos, whose positions are not computed here
        vision.positive("tokens_per_second")
    usual = QwenVisionConfig(out_size=vision.count("out_hidden_size"))
    return dataclasses.replace(
        usual,
        depth=vision.count("depth", usual.depth),
        hidden_size=vision.count("hidden_size"),
        num_heads=vision.count("num_heads", usual.num_heads),
        intermediate_size=vision.count("intermediate_size", usual.intermediate_size),
        patch_px=vision.count("patch_size", usual.patch_px),
        patch_frames=vision.count("temporal_patch_size", usual.patch_frames),
        merge=vision.count("spatial_merge_size", usual.merge),
        window_px=vision.count("window_size", usual.window_px),
        full_layers=vision.counts("fullatt_block_indexes", usual.full_layers),
    )
