"""Checkpoints of random weights in the published layout, and readers, each measured in its own process.

This module imports little, because imports add to the measured memory.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.progress import ProgressCallback
from experiments.engine.processes import in_own_process
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.load import peak_memory
from touchr1_jax.models.qwen.config import RELEASED, QwenConfig, QwenVisionConfig
from touchr1_jax.models.qwen.names import Source, read, sources
from touchr1_jax.models.qwen.safetensors import read_tensor
from touchr1_jax.models.qwen.weights import find_tensors, load_params, save_tensors

TINY = QwenConfig(
    decoder=DecoderConfig(
        vocab_size=256, hidden_size=32, num_layers=4, num_heads=4, num_kv_heads=2, head_dim=8, intermediate_size=64,
        mrope_section=(1, 1, 2), tie_embedding=False,
    ),
    vision=QwenVisionConfig(out_size=32, depth=1, hidden_size=32, num_heads=2, intermediate_size=64, full_layers=(0,)),
    vision_start_id=250, vision_end_id=251, image_id=252, video_id=253,
)  # fmt: skip
"""A model of the same kind that compiles in seconds."""


def _with_released_tower(**changes: Any) -> QwenConfig:
    """The 3B's decoder with changes, and the released vision tower."""
    decoder = dataclasses.replace(RELEASED["3B"].decoder, **changes)
    return QwenConfig(decoder=decoder, vision=QwenVisionConfig(out_size=decoder.hidden_size))


SHAPES: Mapping[str, QwenConfig] = {
    "tiny": TINY,
    "0.5B": _with_released_tower(
        hidden_size=896, num_layers=24, num_heads=14, head_dim=64, intermediate_size=4864, mrope_section=(8, 12, 12)
    ),
    "1.5B": _with_released_tower(hidden_size=1536, num_layers=28, num_heads=12, intermediate_size=8960),
    **RELEASED,
}
"""Size of the decoder → shape; 0.5B and 1.5B are decoders of Qwen2.5 with the tower of Qwen2.5-VL."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadMeasurement:
    """Seconds of one reading, bytes of parameters, largest resident size, and that of the process before it."""

    seconds: float
    nbytes: int
    peak: int
    before: int


Reader = Callable[[Path, QwenConfig, ProgressCallback], list[jax.Array]]
"""(folder, shape, progress callback of bytes) → parameters."""


def streamed(directory: Path, config: QwenConfig, progress: ProgressCallback) -> list[jax.Array]:
    """The library's reader, tensor by tensor."""
    return jax.tree.leaves(load_params(directory, config, jnp.bfloat16, progress=progress))


def whole_first(directory: Path, config: QwenConfig, progress: ProgressCallback) -> list[jax.Array]:
    """Read all tensors into memory, then make the parameters from them."""
    entries = find_tensors(directory)
    done, size, tensors = 0, sum(entry.size for entry in entries.values()), {}
    for key, entry in entries.items():
        tensors[key] = read_tensor(entry)
        done += entry.size
        progress(done, size)
    return [jnp.array(read(jnp.array(tensors[s.key]), s.turned)) for s in sources(config).values()]


OURS, PLAIN = "streamed", "whole first"
READERS: Mapping[str, Reader] = {OURS: streamed, PLAIN: whole_first}


SIGN_AND_FRACTION, SMALL = 0x807F, 0x3C00
"""Random bits of a bfloat16, and its fixed exponent: numbers of a trained weight's size, ±2⁻⁷ … ±2⁻⁶."""


def random_checkpoint(directory: Path, config: QwenConfig, shard_bytes: int, progress: ProgressCallback) -> int:
    """Write weights of a shape in bfloat16 and their index, never more than a tensor in memory; return their bytes."""
    rng = np.random.default_rng(0)

    def draw(s: Source) -> np.ndarray:
        bits = np.frombuffer(rng.bytes(2 * math.prod(s.shape)), np.uint16)
        return ((bits & SIGN_AND_FRACTION) | SMALL).view(jnp.bfloat16).reshape(s.shape)

    return save_tensors(directory, config, draw, jnp.dtype(jnp.bfloat16), progress, shard_bytes)


def measure(reader: Reader, directory: Path, config: QwenConfig, progress: ProgressCallback) -> LoadMeasurement:
    """Read once in a fresh process, whose largest size is then that of the reading.

    Raises:
      RuntimeError: the process ended without an answer, as one that the system stops for its memory does.
    """
    try:
        return in_own_process(_measure_here, reader, directory, config, progress=progress)
    except BrokenProcessPool:
        raise RuntimeError(
            f"reader {reader.__name__!r} of {directory} ended without an answer: probably too little memory; choose "
            "smaller sizes"
        ) from None


def _measure_here(reader: Reader, directory: Path, config: QwenConfig, progress: ProgressCallback) -> LoadMeasurement:
    jax.block_until_ready(jnp.zeros(1))  # the runtime's own memory
    before, began = peak_memory(), time.perf_counter()
    leaves = jax.block_until_ready(reader(directory, config, progress))
    seconds = time.perf_counter() - began
    return LoadMeasurement(seconds=seconds, nbytes=sum(x.nbytes for x in leaves), peak=peak_memory(), before=before)
