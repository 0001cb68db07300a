"""Ways to read a checkpoint, each measured in a process of its own."""

import dataclasses
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from touchr1_jax.models.load import peak_memory
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.names import read, sources
from touchr1_jax.models.qwen.safetensors import read_tensor
from touchr1_jax.models.qwen.weights import find_tensors, load_params

Reader = Callable[[Path, QwenConfig], list[jax.Array]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """What one reading took: seconds, bytes of parameters, largest resident size, that of the process before it."""

    seconds: float
    held: int
    peak: int
    before: int


def streamed(directory: Path, config: QwenConfig) -> list[jax.Array]:
    """The package's: tensor by tensor."""
    return jax.tree.leaves(load_params(directory, config, jnp.bfloat16))


def whole_first(directory: Path, config: QwenConfig) -> list[jax.Array]:
    """All tensors into memory, then the parameters from them."""
    tensors = {key: read_tensor(entry) for key, entry in find_tensors(directory).items()}
    return [jnp.array(read(jnp.array(tensors[s.key]), s.turned)) for s in sources(config).values()]


READERS: dict[str, Reader] = {"streamed": streamed, "whole first": whole_first}


def measure(reader: str, directory: Path, config: QwenConfig) -> Reading:
    """Read once in a fresh process, whose largest size is then that of the reading.

    Raises:
      RuntimeError: the process ended without an answer, as one that the system stops for its memory does.
    """
    context = multiprocessing.get_context("spawn")
    answer, question = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(question, reader, directory, config))
    process.start()
    question.close()
    try:
        reading = answer.recv()
    except EOFError:
        process.join()
        raise RuntimeError(
            f"reader {reader!r} of {directory} ended with status {process.exitcode} and no answer: probably too little "
            "memory; choose smaller sizes"
        ) from None
    process.join()
    return reading


def _child(answer, reader: str, directory: Path, config: QwenConfig) -> None:
    jax.block_until_ready(jnp.zeros(1))  # the runtime's own memory
    before, began = peak_memory(), time.perf_counter()
    leaves = jax.block_until_ready(READERS[reader](directory, config))
    seconds = time.perf_counter() - began
    answer.send(Reading(seconds=seconds, held=sum(x.nbytes for x in leaves), peak=peak_memory(), before=before))
