"""How much memory does it take to read a released checkpoint?

    python -m experiments load_weights [--scale smoke] [--sizes 3B 7B] [--scratch DIR]

The experiment writes a checkpoint of a released shape with random contents in bfloat16, reads it in a separate process,
and compares the largest resident size of that process with the size of the weights; for the sizes in `compare`, also
with a reader that first loads all tensors.  If the machine has too little disk or memory, the run ends before it
begins to write.

Cost: for the 7B shape, 17 GB of disk, 17 GB of memory and some minutes.

Expected: at most 1.2 times the weights from 0.5B to 7B; twice the weights if all tensors are loaded first.
"""

import dataclasses
import math
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import jax

from experiments.core.charts import bars
from experiments.core.context import Context
from experiments.core.progress import in_megabytes
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine.load_checkpoints import (
    OURS,
    PLAIN,
    READERS,
    SHAPES,
    LoadMeasurement,
    measure,
    random_checkpoint,
)
from touchr1_jax.models.qwen.model import abstract_params

BOUND = 1.2  # most memory of a reading, in weights

GB = 1e9


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


Measured = Mapping[str, Mapping[str, LoadMeasurement]]  # size → reader → reading


def run(config: LoadWeightsConfig, context: Context) -> Results:
    """Write, read, compare, one size after the other."""
    for size in context.each("looking for room", config.sizes):
        check_room(size, config.scratch, copies=2 if size in config.compare else 1)
    readings = {size: read_size(size, config, context) for size in context.each("sizes", config.sizes, still=True)}
    ratios = {size: {name: r.peak / r.nbytes for name, r in by.items()} for size, by in readings.items()}
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
        with context.progress_callback(f"writing {size}, MB") as progress:
            random_checkpoint(directory, SHAPES[size], config.shard_bytes, in_megabytes(progress))
        readings = {}
        for name in (OURS, PLAIN) if size in config.compare else (OURS,):
            with context.progress_callback(f"reading {size}, {name}, MB", still=True) as progress:
                in_megabytes(progress)(0, weight_bytes(size))
                readings[name] = measure(READERS[name], directory, SHAPES[size], in_megabytes(progress))
    finally:
        shutil.rmtree(directory)
    for name, r in readings.items():
        context.print(f"{size}, {name}: {r.peak / r.nbytes:.3f} × {r.nbytes / GB:.2f} GB in {r.seconds:.1f} s")
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


def verdict(readings: Measured) -> tuple[str, ...]:
    """Memory and time to read the largest shape, and memory with all tensors first."""
    largest, by = max(readings.items(), key=lambda item: item[1][OURS].nbytes)
    ours = by[OURS]
    return (
        f"Reading the {largest} shape, {ours.nbytes / GB:.2f} GB, takes a process of {ours.peak / GB:.2f} GB at most, "
        f"{ours.peak / ours.nbytes:.3f} times the weights, and {ours.seconds:.0f} s.",
        *(
            f"All tensors first, the {size} shape takes {other[PLAIN].peak / other[PLAIN].nbytes:.2f} times."
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
                "weights": r.nbytes / GB,
                "peak": r.peak / GB,
                "peak over weights": r.peak / r.nbytes,
                "process before": r.before / GB,
                "time": r.seconds,
            }
            for size, by in readings.items()
            for name, r in by.items()
        ],
        formats={"weights": ".2f", "peak": ".2f", "peak over weights": ".3f", "process before": ".2f", "time": ".1f"},
        units={"weights": "GB", "peak": "GB", "process before": "GB", "time": "s"},
        meanings={"process before": "with the runtime, without weights"},
        note="The files were just written: they may come from the page cache, which the peak does not count.",
    )


SMOKE = LoadWeightsConfig(sizes=("0.5B",), compare=())

EXPERIMENT = Experiment(name="load_weights", config=LoadWeightsConfig(), scales={"smoke": SMOKE}, run=run)
