"""Random checkpoints in the published layout, written shard by shard so that no more than one is ever in memory."""

import json
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.names import published, sources
from touchr1_jax.models.qwen.safetensors import write_file
from touchr1_jax.models.qwen.weights import INDEX

SIGN_AND_FRACTION, SMALL = 0x807F, 0x3C00
"""Bits of a bfloat16 that are drawn, and the exponent that is not: ±2⁻⁷ … ±2⁻⁶, of a trained weight's size."""


def random_checkpoint(directory: Path, config: QwenConfig, shard_bytes: int, seed: int) -> int:
    """Write weights of a shape in bfloat16 and their index; returns their size in bytes.

    Args:
      directory: filled with shards and the index.
      config: shape.
      shard_bytes: a shard is closed before it would exceed this, unless a single tensor does.
      seed: of the contents.
    """
    rng = np.random.default_rng(seed)
    place: dict[str, str] = {}
    size = 0
    for i, shapes in enumerate(shards(config, shard_bytes)):
        name = f"model-{i + 1:05}.safetensors"
        tensors = {key: draw(rng, shape) for key, shape in shapes.items()}
        write_file(directory / name, tensors)
        place |= dict.fromkeys(tensors, name)
        size += sum(x.nbytes for x in tensors.values())
    index = {"metadata": {"total_size": size}, "weight_map": place}
    (directory / INDEX).write_text(json.dumps(index), encoding="utf-8")
    return size


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
