"""Ways to read a checkpoint, each measured in a process of its own."""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import jax
import jax.numpy as jnp

from experiments.engine.processes import in_own_process
from touchr1_jax.models.load import peak_memory
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.names import read, sources
from touchr1_jax.models.qwen.safetensors import Tell, read_tensor
from touchr1_jax.models.qwen.weights import find_tensors, load_params

Reader = Callable[[Path, QwenConfig, Tell], list[jax.Array]]
"""From a folder, a shape and who is told of the bytes to the parameters."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadMeasurement:
    """What one reading took: seconds, bytes of parameters, largest resident size, that of the process before it."""

    seconds: float
    held: int
    peak: int
    before: int


def streamed(directory: Path, config: QwenConfig, tell: Tell) -> list[jax.Array]:
    """The package's: tensor by tensor."""
    return jax.tree.leaves(load_params(directory, config, jnp.bfloat16, progress=tell))


def whole_first(directory: Path, config: QwenConfig, tell: Tell) -> list[jax.Array]:
    """All tensors into memory, then the parameters from them."""
    entries = find_tensors(directory)
    done, size, tensors = 0, sum(entry.size for entry in entries.values()), {}
    for key, entry in entries.items():
        tensors[key] = read_tensor(entry)
        done += entry.size
        tell(done, size)
    return [jnp.array(read(jnp.array(tensors[s.key]), s.turned)) for s in sources(config).values()]


READERS: dict[str, Reader] = {"streamed": streamed, "whole first": whole_first}


def measure(reader: str, directory: Path, config: QwenConfig, tell: Tell) -> LoadMeasurement:
    """Read once in a fresh process, whose largest size is then that of the reading.

    Args:
      reader: of `READERS`.
      directory: of the checkpoint.
      config: its shape.
      tell: told of the bytes that are read.

    Raises:
      RuntimeError: the process ended without an answer, as one that the system stops for its memory does.
    """
    try:
        return in_own_process(_read, READERS[reader], directory, config, tell=tell)
    except BrokenProcessPool:
        raise RuntimeError(
            f"reader {reader!r} of {directory} ended without an answer: probably too little memory; choose smaller "
            "sizes"
        ) from None


def _read(reader: Reader, directory: Path, config: QwenConfig, tell: Tell) -> LoadMeasurement:
    jax.block_until_ready(jnp.zeros(1))  # the runtime's own memory
    before, began = peak_memory(), time.perf_counter()
    leaves = jax.block_until_ready(reader(directory, config, tell))
    seconds = time.perf_counter() - began
    return LoadMeasurement(seconds=seconds, held=sum(x.nbytes for x in leaves), peak=peak_memory(), before=before)
