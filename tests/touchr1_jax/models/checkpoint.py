"""A whole released model, tiny: config, tokenizer, template, settings of pictures, weights."""

import json
import shutil
from pathlib import Path

from experiments.paper.tiny_checkpoint import TEMPLATE
from tests.touchr1_jax.models.qwen import cases, tiny, words
from touchr1_jax.models.qwen.config_file import parse_config
from touchr1_jax.text.language import TOUCH_LANGUAGE

FIELDS = {
    "vision_start_token_id": "<|vision_start|>",
    "vision_end_token_id": "<|vision_end|>",
    "image_token_id": "<|image_pad|>",
    "video_token_id": "<|video_pad|>",
}

PICTURES = {"min_pixels": 64, "max_pixels": 4096, "patch_size": 4, "temporal_patch_size": 2, "merge_size": 2}


def write_checkpoint(directory: Path) -> None:
    """Its table has more rows than its tokenizer has words, as Qwen's."""
    ids = words.write(directory / "tokenizer.json", TOUCH_LANGUAGE)
    config = cases.config_json() | {"vocab_size": 512} | {field: ids[mark] for field, mark in FIELDS.items()}
    tiny.write_weights(directory, parse_config(config))
    (directory / "config.json").write_text(json.dumps(config))
    (directory / "preprocessor_config.json").write_text(json.dumps(PICTURES))
    shutil.copy(TEMPLATE, directory)
