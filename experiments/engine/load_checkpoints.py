"""Random checkpoints in the published layout, written shard by shard so that no more than one is ever in memory."""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.names import published, sources
from touchr1_jax.models.qwen.safetensors import Tell, write_file
from touchr1_jax.models.qwen.weights import INDEX

SIGN_AND_FRACTION, SMALL = 0x807F, 0x3C00
"""Bits of a bfloat16 that are drawn, and the exponent that is not: ±2⁻⁷ … ±2⁻⁶, of a trained weight's size."""


def random_checkpoint(directory: Path, config: QwenConfig, shard_bytes: int, seed: int, tell: Tell) -> int:
    """Write weights of a shape in bfloat16 and their index; returns their size in bytes.

    Args:
      directory: filled with shards and the index.
      config: shape.
      shard_bytes: a shard is closed before it would exceed this, unless a single tensor does.
      seed: of the contents.
      tell: told of the bytes after each tensor that is drawn or written, each of which counts for half of them.
    """
    rng = np.random.default_rng(seed)
    place: dict[str, str] = {}
    cut = list(shards(config, shard_bytes))
    size, every = 0, sum(2 * math.prod(shape) for shapes in cut for shape in shapes.values())
    for i, shapes in enumerate(cut):
        name, tensors, drawn = f"model-{i + 1:05}.safetensors", {}, 0
        for key, shape in shapes.items():
            tensors[key] = draw(rng, shape)
            drawn += tensors[key].nbytes
            tell(size + drawn // 2, every)
        write_file(directory / name, tensors, _after(size + drawn // 2, every, tell))
        place |= dict.fromkeys(tensors, name)
        size += drawn
    index = {"metadata": {"total_size": size}, "weight_map": place}
    (directory / INDEX).write_text(json.dumps(index), encoding="utf-8")
    return size


def _after(begun: int, every: int, tell: Tell) -> Tell:
    return lambda done, _: tell(begun + done // 2, every)


def shards(config: QwenConfig, shard_bytes: int) -> Iterator[dict[str, tuple[int, ...]]]:
    """Published keys and shapes, cut into shards in the order of the parameters."""
    shard: dict[str, tuple[int, ...]] = {}
    filled = 0
    for s in sources(config).values():
        size = 2 * int(np.prod(s.shape))
        if shard and filled + size > shard_bytes:
            yield shard
            shard, filled = {}, 0
        shard[published(s.key)] = s.shape
        filled += size
    yield shard


def draw(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Random bfloat16 numbers."""
    bits = np.frombuffer(rng.bytes(2 * int(np.prod(shape))), np.uint16)
    return ((bits & SIGN_AND_FRACTION) | SMALL).view(jnp.bfloat16).reshape(shape)
