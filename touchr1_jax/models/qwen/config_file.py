"""The shape of a checkpoint from its `config.json`, whose `model_type` says which model it is."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from touchr1_jax.models.decoder_config import DecoderConfig, Qwen3DecoderConfig
from touchr1_jax.models.qwen.config import (
    COLOURS,
    CONFIG_FILE,
    ROPE_THETA,
    Qwen3VisionConfig,
    QwenConfig,
    QwenVisionConfig,
)

MODEL_TYPES = tuple(tower.model_type for tower in (QwenVisionConfig, Qwen3VisionConfig))


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
    """Configuration from the contents of a `config.json`, flat as first published or nested as later ones are.

    Qwen2.5-VL's vision tower has the published defaults where the file states a part of its shape (32B, 72B).

    Raises:
      ValueError: a field that is missing, of another type, or that asks for what these modules do not compute.
    """
    root = _Fields(found, "")
    if (kind := root["model_type"]) not in MODEL_TYPES:
        experts = "; mixtures of experts are not computed, take a dense one" if "moe" in str(kind) else ""
        raise ValueError(
            f"model_type is {kind!r}: must be {' or '.join(map(repr, MODEL_TYPES))}{experts}; another architecture "
            "cannot be read"
        )
    text = root.part("text_config") if "text_config" in root.found else root
    vision = root.part("vision_config")
    tied = any(part.found.get("tie_word_embeddings", False) for part in (root, text))  # absence means no
    qwen3 = kind == Qwen3VisionConfig.model_type
    return QwenConfig(
        decoder=_decoder(text, Qwen3DecoderConfig if qwen3 else DecoderConfig, tied=tied),
        vision=_qwen3_vision(vision) if qwen3 else _vision(vision),
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


def _decoder(text: _Fields, kind: type[DecoderConfig], *, tied: bool) -> DecoderConfig:
    text.require("hidden_act", "silu")
    text.require("attention_bias", kind.qkv_bias, default=True)
    if text.found.get("use_sliding_window"):
        raise ValueError(f"{text.prefix}use_sliding_window is true: only full attention is computed; set it to false")
    hidden, heads = text.count("hidden_size"), text.count("num_attention_heads")
    if kind is not Qwen3DecoderConfig and hidden % heads:
        raise ValueError(f"{text.prefix}hidden_size {hidden} must be a multiple of num_attention_heads {heads}")
    head_dim = text.count("head_dim") if kind is Qwen3DecoderConfig else hidden // heads
    theta, sections = _rope(text, head_dim, kind.interleaved)
    return kind(
        vocab_size=text.count("vocab_size"),
        hidden_size=hidden,
        num_layers=text.count("num_hidden_layers"),
        num_heads=heads,
        num_kv_heads=text.count("num_key_value_heads"),
        head_dim=head_dim,
        intermediate_size=text.count("intermediate_size"),
        mrope_section=sections,
        rope_theta=theta,
        norm_epsilon=text.positive("rms_norm_eps"),
        tie_embedding=tied,
    )


def _rope(text: _Fields, head_dim: int, interleaved: bool) -> tuple[float, tuple[int, int, int]]:
    """Base and sections of the rotary positions: `rope_theta` next to `rope_scaling`, or both in `rope_parameters`."""
    rope = text.part("rope_parameters" if "rope_parameters" in text.found else "rope_scaling")
    kinds = [rope.found[k] for k in ("type", "rope_type") if k in rope.found]
    if not all(kind in ("mrope", "default") for kind in kinds):
        raise ValueError(f"{rope.prefix}type is {kinds}: must be 'mrope' or 'default'; nothing else is computed")
    rope.require("mrope_interleaved", interleaved, default=True)
    theta = (rope if "rope_theta" in rope.found else text).positive("rope_theta")
    sections = rope.counts("mrope_section")
    if len(sections) != 3:
        raise ValueError(f"{rope.prefix}mrope_section is {list(sections)}: must be three, for time, row and column")
    if 2 * sum(sections) != head_dim or min(sections) < 0:
        raise ValueError(
            f"{rope.prefix}mrope_section is {list(sections)}: twice their sum must be head_dim, {head_dim}; correct "
            "config.json"
        )
    return theta, sections


def _qwen3_vision(vision: _Fields) -> Qwen3VisionConfig:
    vision.require("hidden_act", "gelu_pytorch_tanh")
    vision.require("in_channels", COLOURS, default=True)
    if "rope_parameters" in vision.found:  # written by newer libraries alone
        vision.part("rope_parameters").require("rope_theta", ROPE_THETA, default=True)
    return Qwen3VisionConfig(
        out_size=vision.count("out_hidden_size"),
        depth=vision.count("depth"),
        hidden_size=vision.count("hidden_size"),
        num_heads=vision.count("num_heads"),
        intermediate_size=vision.count("intermediate_size"),
        patch_px=vision.count("patch_size"),
        patch_frames=vision.count("temporal_patch_size"),
        merge=vision.count("spatial_merge_size"),
        positions=vision.count("num_position_embeddings"),
        deepstack_layers=vision.counts("deepstack_visual_indexes"),
    )


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
