"""Which published tensor is which parameter, and how its axes lie there."""

import re
from typing import NamedTuple

import flax.traverse_util
import numpy as np
from jaxtyping import Array

from touchr1_jax.models.qwen.config import COLOURS, QwenConfig
from touchr1_jax.models.qwen.model import abstract_params

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

Path = tuple[str, ...]


class Source(NamedTuple):
    """Where a parameter comes from: key without prefix, shape there, and whether it is turned there, outputs first."""

    key: str
    shape: tuple[int, ...]
    turned: bool


def read(published: Array, turned: bool) -> Array:
    """The parameter from the published tensor."""
    return published.reshape(published.shape[0], -1).T if turned else published


def write(parameter: np.ndarray, source: Source) -> np.ndarray:
    """The published tensor from the parameter."""
    return parameter.T.reshape(source.shape) if source.turned else parameter


def canonical(key: str) -> str:
    """A key of a checkpoint without its prefix, old or new, as text.…, visual.… or lm_head.weight."""
    for old, new in PREFIXES:
        if key.startswith(old):
            return new + key.removeprefix(old)
    return key


def published(key: str) -> str:
    """A key without prefix as released checkpoints have it."""
    return "model." + key.removeprefix("text.") if key.startswith("text.") else key


def sources(config: QwenConfig) -> dict[Path, Source]:
    """Source of every parameter, by its path in the tree."""
    leaves = flax.traverse_util.flatten_dict(abstract_params(config))
    return {path: source(path, leaf.shape, config) for path, leaf in leaves.items()}


def source(path: Path, shape: tuple[int, ...], config: QwenConfig) -> Source:
    """Source of one parameter.

    Dense kernels are published as [out, in], the patch embedding as a convolution [out, colour, frame, row, column].
    """
    *modules, leaf = path
    if path == ("decoder", "head", "kernel"):
        return Source("lm_head.weight", shape[::-1], turned=True)
    if path == ("vision", "patch_embed"):
        v = config.vision
        kernel = (v.hidden_size, COLOURS, v.patch_frames, v.patch_px, v.patch_px)
        return Source("visual.patch_embed.proj.weight", kernel, turned=True)
    key = ".".join(MODULES.get(name, re.sub(r"_(\d+)$", r".\1", name)) for name in modules)
    turned = leaf == "kernel"
    return Source(f"{key}.{'bias' if leaf == 'bias' else 'weight'}", shape[::-1] if turned else shape, turned)
