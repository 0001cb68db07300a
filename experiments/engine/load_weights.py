"""How much memory does it take to read a released checkpoint?

    python -m experiments load_weights [--scale smoke] [--sizes 3B 7B] [--scratch DIR]

Writes a checkpoint of a released shape with random contents in bfloat16, reads it in a process of its own, and compares
the largest resident size of that process with the size of the weights; for the sizes in `compare` also for a reader
that reads all tensors first.  The 7B shape takes 17 GB of disk and of memory and some minutes; a machine that has less
is refused before the run begins.

Expected: at most 1.2 times the weights from 0.5B to 7B; twice with all tensors first.
"""

import dataclasses
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.charts import bars
from experiments.core.context import Context
from experiments.core.progress import ProgressCallback, in_megabytes
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine.processes import in_own_process
from experiments.engine.scale_compiling import TINY
from touchr1_jax.models.load import peak_memory
from touchr1_jax.models.qwen.config import RELEASED, QwenConfig, QwenVisionConfig, released
from touchr1_jax.models.qwen.model import abstract_params
from touchr1_jax.models.qwen.names import published, read, sources
from touchr1_jax.models.qwen.safetensors import read_tensor, write_file
from touchr1_jax.models.qwen.weights import INDEX, find_tensors, load_params

BOUND = 1.2
"""Most memory of a reading, in weights."""

GB = 1e9


def _with_released_tower(**changes: Any) -> QwenConfig:
    """The 3B's decoder with changes, and the released vision tower."""
    decoder = dataclasses.replace(RELEASED["3B"], **changes)
    return QwenConfig(decoder=decoder, vision=QwenVisionConfig(out_size=decoder.hidden_size))


SHAPES: Mapping[str, QwenConfig] = {
    "tiny": TINY,
    "0.5B": _with_released_tower(
        hidden_size=896, num_layers=24, num_heads=14, head_dim=64, intermediate_size=4864, mrope_section=(8, 12, 12)
    ),
    "1.5B": _with_released_tower(hidden_size=1536, num_layers=28, num_heads=12, intermediate_size=8960),
    "3B": released("3B"),
    "7B": released("7B"),
}
"""Size of the decoder → shape; 0.5B and 1.5B are decoders of Qwen2.5 with the tower of Qwen2.5-VL."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadWeightsConfig:
    """Sizes to read, those to read with all tensors first too, largest shard, and where checkpoints are written.

    Raises:
      ValueError: a size that has no shape, or one that is compared and not read.
    """

    sizes: tuple[str, ...] = ("1.5B", "3B", "7B")
    compare: tuple[str, ...] = ("1.5B",)
    shard_bytes: int = 2_000_000_000
    scratch: Path = Path(tempfile.gettempdir())

    def __post_init__(self) -> None:
        unknown = [size for size in self.sizes if size not in SHAPES]
        if unknown or not set(self.compare) <= set(self.sizes):
            raise ValueError(
                f"sizes are {self.sizes}, compare {self.compare}: must be of {', '.join(SHAPES)}, and compare of sizes"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoadMeasurement:
    """Seconds of one reading, bytes of parameters, largest resident size, and that of the process before it."""

    seconds: float
    held: int
    peak: int
    before: int


Measured = Mapping[str, Mapping[str, LoadMeasurement]]
"""Size → reader → reading."""

Reader = Callable[[Path, QwenConfig, ProgressCallback], list[jax.Array]]
"""(folder, shape, progress callback of bytes) → parameters."""


def streamed(directory: Path, config: QwenConfig, tell: ProgressCallback) -> list[jax.Array]:
    """The library's reader, tensor by tensor."""
    return jax.tree.leaves(load_params(directory, config, jnp.bfloat16, progress=tell))


def whole_first(directory: Path, config: QwenConfig, tell: ProgressCallback) -> list[jax.Array]:
    """Read all tensors into memory, then make the parameters from them."""
    entries = find_tensors(directory)
    done, size, tensors = 0, sum(entry.size for entry in entries.values()), {}
    for key, entry in entries.items():
        tensors[key] = read_tensor(entry)
        done += entry.size
        tell(done, size)
    return [jnp.array(read(jnp.array(tensors[s.key]), s.turned)) for s in sources(config).values()]


OURS, PLAIN = "streamed", "whole first"
READERS: Mapping[str, Reader] = {OURS: streamed, PLAIN: whole_first}


def run(config: LoadWeightsConfig, context: Context) -> Results:
    """Write, read, compare, one size after the other."""
    for size in context.each("looking for room", config.sizes):
        check_room(size, config.scratch, copies=2 if size in config.compare else 1)
    readings = {size: read_size(size, config, context) for size in context.each("sizes", config.sizes, still=True)}
    ratios = {size: {name: r.peak / r.held for name, r in by.items()} for size, by in readings.items()}
    return Results(
        verdict=verdict(readings),
        requirements=tuple(at_most(f"{size}: peak over weights", by[OURS], BOUND) for size, by in ratios.items()),
        tables=(table(readings),),
        pictures=(
            Picture(
                name="memory",
                title="Memory of a reading",
                caption=f"The dotted line is the bound, {BOUND} times the weights in bfloat16.",
                content=bars(
                    {f"{size}, {name}": ratio for size, by in ratios.items() for name, ratio in by.items()},
                    "largest resident size of the process, in weights",
                    written=".2f",
                    bounds=(BOUND,),
                ),
            ),
        ),
        settings={"physical memory": f"{physical_memory() / GB:.0f} GB", "shard": f"{config.shard_bytes / GB:g} GB"},
    )


def read_size(size: str, config: LoadWeightsConfig, context: Context) -> dict[str, LoadMeasurement]:
    """Write one checkpoint, read it by every reader, and remove it."""
    directory = Path(tempfile.mkdtemp(prefix=f"weights-{size}-", dir=config.scratch))
    try:
        context.print(f"{size}: writing {weight_bytes(size) / GB:.1f} GB to {directory}")
        with context.progress_callback(f"writing {size}, MB") as tell:
            random_checkpoint(directory, SHAPES[size], config.shard_bytes, in_megabytes(tell))
        readings = {}
        for name in (OURS, PLAIN) if size in config.compare else (OURS,):
            with context.progress_callback(f"reading {size}, {name}, MB", still=True) as tell:
                in_megabytes(tell)(0, weight_bytes(size))
                readings[name] = measure(READERS[name], directory, SHAPES[size], in_megabytes(tell))
    finally:
        shutil.rmtree(directory)
    for name, r in readings.items():
        context.print(f"{size}, {name}: {r.peak / r.held:.3f} × {r.held / GB:.2f} GB in {r.seconds:.1f} s")
    return readings


def check_room(size: str, scratch: Path, copies: int) -> None:
    """Refuse a size that this machine cannot hold.

    Raises:
      ValueError: too little disk or memory.
    """
    need = weight_bytes(size)
    disk, memory = shutil.disk_usage(scratch).free, physical_memory()
    if need > disk or BOUND * copies * need > memory:
        raise ValueError(
            f"size {size} takes {need / GB:.1f} GB of disk and {BOUND * copies * need / GB:.1f} GB of memory; there "
            f"are {disk / GB:.1f} GB free in {scratch} and {memory / GB:.1f} GB: give --sizes that fit, or --scratch"
        )


def weight_bytes(size: str) -> int:
    """Bytes of a size's weights in bfloat16."""
    return 2 * sum(math.prod(x.shape) for x in jax.tree.leaves(abstract_params(SHAPES[size])))


def physical_memory() -> int:
    """Memory of this machine, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


SIGN_AND_FRACTION, SMALL = 0x807F, 0x3C00
"""Random bits of a bfloat16, and its fixed exponent: numbers of a trained weight's size, ±2⁻⁷ … ±2⁻⁶."""


def random_checkpoint(directory: Path, config: QwenConfig, shard_bytes: int, tell: ProgressCallback) -> int:
    """Write weights of a shape in bfloat16 and their index, never more than a shard in memory; return their bytes.

    Args:
      directory: filled with shards and the index.
      config: shape.
      shard_bytes: a shard is closed before it would exceed this, unless a single tensor does.
      tell: progress callback; drawing and writing a tensor count half of its bytes each.
    """
    rng = np.random.default_rng(0)
    place: dict[str, str] = {}
    cut = list(shards(config, shard_bytes))
    size, every = 0, sum(2 * math.prod(shape) for shapes in cut for shape in shapes.values())
    for i, shapes in enumerate(cut):
        name, tensors, drawn = f"model-{i + 1:05}.safetensors", {}, 0
        for key, shape in shapes.items():
            bits = np.frombuffer(rng.bytes(2 * math.prod(shape)), np.uint16)
            tensors[key] = ((bits & SIGN_AND_FRACTION) | SMALL).view(jnp.bfloat16).reshape(shape)
            drawn += tensors[key].nbytes
            tell(size + drawn // 2, every)
        write_file(directory / name, tensors, _after(size + drawn // 2, every, tell))
        place |= dict.fromkeys(tensors, name)
        size += drawn
    index = {"metadata": {"total_size": size}, "weight_map": place}
    (directory / INDEX).write_text(json.dumps(index), encoding="utf-8")
    return size


def _after(begun: int, every: int, tell: ProgressCallback) -> ProgressCallback:
    return lambda done, _: tell(begun + done // 2, every)


def shards(config: QwenConfig, shard_bytes: int) -> Iterator[dict[str, tuple[int, ...]]]:
    """Published keys and shapes, cut into shards in the order of the parameters."""
    shard: dict[str, tuple[int, ...]] = {}
    filled = 0
    for s in sources(config).values():
        size = 2 * math.prod(s.shape)
        if shard and filled + size > shard_bytes:
            yield shard
            shard, filled = {}, 0
        shard[published(s.key)] = s.shape
        filled += size
    yield shard


def measure(reader: Reader, directory: Path, config: QwenConfig, tell: ProgressCallback) -> LoadMeasurement:
    """Read once in a fresh process, whose largest size is then that of the reading.

    Args:
      reader: a function of a module.
      directory: of the checkpoint.
      config: its shape.
      tell: progress callback of the bytes read.

    Raises:
      RuntimeError: the process ended without an answer, as one that the system stops for its memory does.
    """
    try:
        return in_own_process(_measure_here, reader, directory, config, tell=tell)
    except BrokenProcessPool:
        raise RuntimeError(
            f"reader {reader.__name__!r} of {directory} ended without an answer: probably too little memory; choose "
            "smaller sizes"
        ) from None


def _measure_here(reader: Reader, directory: Path, config: QwenConfig, tell: ProgressCallback) -> LoadMeasurement:
    jax.block_until_ready(jnp.zeros(1))  # the runtime's own memory
    before, began = peak_memory(), time.perf_counter()
    leaves = jax.block_until_ready(reader(directory, config, tell))
    seconds = time.perf_counter() - began
    return LoadMeasurement(seconds=seconds, held=sum(x.nbytes for x in leaves), peak=peak_memory(), before=before)


def verdict(readings: Measured) -> tuple[str, ...]:
    """The answer in sentences."""
    largest, by = max(readings.items(), key=lambda item: item[1][OURS].held)
    ours = by[OURS]
    return (
        f"Reading the {largest} shape, {ours.held / GB:.2f} GB, takes a process of {ours.peak / GB:.2f} GB at most, "
        f"{ours.peak / ours.held:.3f} times the weights, and {ours.seconds:.0f} s.",
        *(
            f"All tensors first, the {size} shape takes {other[PLAIN].peak / other[PLAIN].held:.2f} times."
            for size, other in readings.items()
            if PLAIN in other
        ),
    )


def table(readings: Measured) -> Table:
    """Every reading."""
    return named_table(
        "Readings, each in a process of its own",
        [
            {
                "size and reader": f"{size}, {name}",
                "weights": r.held / GB,
                "peak": r.peak / GB,
                "peak over weights": r.peak / r.held,
                "process before": r.before / GB,
                "time": r.seconds,
            }
            for size, by in readings.items()
            for name, r in by.items()
        ],
        formats={"weights": ".2f", "peak": ".2f", "peak over weights": ".3f", "process before": ".2f", "time": ".1f"},
        units={"weights": "GB", "peak": "GB", "process before": "GB", "time": "s"},
        meanings={
            "peak": "largest resident size of the process",
            "process before": "with the runtime, without weights",
        },
        note="The files were just written: they may come from the page cache, which the peak does not count.",
    )


DEFAULT = LoadWeightsConfig()
SMOKE = LoadWeightsConfig(sizes=("0.5B",), compare=())

EXPERIMENT = Experiment(name="load_weights", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
