"""Which published tensor is which parameter, and the order of its axes."""

import re
from typing import NamedTuple

import flax.traverse_util
import numpy as np
from jaxtyping import Array

from touchr1_jax.models.qwen.config import COLOURS, QwenConfig
from touchr1_jax.models.qwen.model import abstract_params
from touchr1_jax.models.stacked import LAST, STACKED

PREFIXES = (("model.language_model.", "text."), ("model.visual.", "visual."), ("model.", "text."))
"""Beginnings of keys as newer libraries write them, and last the published one, and what both become here."""

MODULES = {
    "decoder": "text",
    "vision": "visual",
    "embedding": "embed_tokens",
    "norm_attention": "input_layernorm",
    "norm_mlp": "post_attention_layernorm",
    "q_proj": "self_attn.q_proj",
    "k_proj": "self_attn.k_proj",
    "v_proj": "self_attn.v_proj",
    "o_proj": "self_attn.o_proj",
    "q_norm": "self_attn.q_norm",
    "k_norm": "self_attn.k_norm",
    "gate": "gate_proj",
    "up": "up_proj",
    "down": "down_proj",
    "qkv": "attn.qkv",
    "proj": "attn.proj",
    "merger_norm": "merger.ln_q",
    "merger_in": "merger.mlp.0",
    "merger_out": "merger.mlp.2",
}
"""Published name of each module whose name differs."""

ALONE = {
    ("decoder", "head", "kernel"): "lm_head.weight",
    ("vision", "patch_embed"): "visual.patch_embed.proj.weight",
    ("vision", "patch_bias"): "visual.patch_embed.proj.bias",
    ("vision", "patch_position"): "visual.pos_embed.weight",
}
"""Key of each parameter that is named as a whole."""

Path = tuple[str, ...]


class Source(NamedTuple):
    """A published tensor: key without prefix, shape, whether it is turned there, outputs first, and its parameter.

    `row` is the layer in a parameter that stacks all layers of a tower.
    """

    key: str
    shape: tuple[int, ...]
    turned: bool
    path: Path
    row: int | None = None


def read(published: Array, turned: bool) -> Array:
    """The parameter from the published tensor."""
    return published.reshape(published.shape[0], -1).T if turned else published


def write(parameter: Array, source: Source) -> np.ndarray:
    """The published tensor from its parameter, or from its row of a stacked one."""
    host = np.asarray(parameter)
    return host.T.reshape(source.shape) if source.turned else host


def canonical(key: str) -> str:
    """A key of a checkpoint without its prefix, old or new, as text.…, visual.… or lm_head.weight."""
    for old, new in PREFIXES:
        if key.startswith(old):
            return new + key.removeprefix(old)
    return key


def published(key: str, config: QwenConfig) -> str:
    """A key without prefix as released checkpoints of a model have it."""
    if config.vision.model_type == "qwen3_vl":
        return nested(key)
    return "model." + key.removeprefix("text.") if key.startswith("text.") else key


def nested(key: str) -> str:
    """A key without prefix as Qwen3-VL's checkpoints have it, and transformers ≥ 4.52 in every model."""
    if key.startswith("text."):
        return f"model.language_model.{key.removeprefix('text.')}"
    return f"model.{key}" if key.startswith("visual.") else key


def sources(config: QwenConfig) -> dict[str, Source]:
    """Source of every parameter, or of each layer's part of it, by its key without prefix."""
    found: dict[str, Source] = {}
    for path, leaf in flax.traverse_util.flatten_dict(abstract_params(config)).items():
        stack = STACKED.intersection(path)
        rows = range(leaf.shape[0]) if stack else (None,)
        for row in rows:
            made = source(path, leaf.shape[1:] if stack else leaf.shape, config, row)
            found[made.key] = made
    return found


def source(path: Path, shape: tuple[int, ...], config: QwenConfig, row: int | None = None) -> Source:
    """Source of one parameter, or of a row of it.

    Dense kernels are published as [out, in], the patch embedding as a convolution [out, colour, frame, row, column].
    """
    *modules, leaf = path
    turned = leaf in ("kernel", "patch_embed")
    shape = shape[::-1] if turned else shape
    if leaf == "patch_embed":
        v = config.vision
        shape = (v.hidden_size, COLOURS, v.patch_frames, v.patch_px, v.patch_px)
    if path in ALONE:
        return Source(ALONE[path], shape, turned, path)
    key = ".".join(module_name(name, row, config) for name in modules)
    return Source(f"{key}.{'bias' if leaf == 'bias' else 'weight'}", shape, turned, path, row)


def module_name(name: str, row: int | None, config: QwenConfig) -> str:
    """Published name of a module, that of a layer or merger with its number."""
    if name == LAST:
        return f"layers.{config.decoder.num_layers - 1}"
    return f"{name}.{row}" if name in STACKED else MODULES.get(name, re.sub(r"_(\d)$", r".\1", name))
