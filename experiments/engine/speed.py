"""Timing of GRPO steps and other workloads: alone in a process, alternating with variants, over many steps.

Other modules make the reports, because imports add to the measured memory.
"""

import dataclasses
import resource
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from experiments.core.context import Context
from experiments.core.progress import ProgressCallback
from experiments.core.timing import interleaved
from experiments.engine.job import Job, config_of
from experiments.engine.peers import EngineTimes, JobSize
from experiments.engine.plain_program import PlainProgram
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import compiles_leanly
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import prompt_words
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.training.compilation import compilations_kept, return_memory

MATRIX = 1024  # side of the matrices whose product is the yardstick of a CPU
PLAIN, REPEATED = "plain program", "repeated prefix"  # names in `others`
SHORT = 1 / 8  # share of the words that end a completion where answers are to be short
RESIDENT_EVERY = 100  # steps between two looks at the memory

GIB, KIB, MIB = 2**30, 2**10, 2**20

Option = Literal[
    "one micro-batch",
    "Gumbel draws",
    "remat",
    "bfloat16",
    "lean compilation",
    "importance weights",
    "host reward",
    "short answers",
    "short answers, buckets",
]
"""Changes of the engine."""


class Workload(NamedTuple):
    """A call to time, its operations, the bytes it must read, and the number of units it produces."""

    call: Callable[[], Any]
    flops: float
    read_bytes: float | None
    made: float
    unit: str


class TimedWorkload(NamedTuple):
    """Seconds of a workload in every round, and the workload."""

    seconds: tuple[float, ...]
    workload: Workload

    @property
    def median_s(self) -> float:
        """Median of the rounds."""
        return statistics.median(self.seconds)

    @property
    def flops(self) -> float:
        """Necessary operations a second."""
        return self.workload.flops / self.median_s

    @property
    def read_bytes(self) -> float | None:
        """Necessary bytes read a second, where they are counted."""
        return None if self.workload.read_bytes is None else self.workload.read_bytes / self.median_s

    @property
    def made(self) -> str:
        """Units produced a second, such as `1,200 tokens/s`."""
        return f"{self.workload.made / self.median_s:,.0f} {self.workload.unit}/s"


def measure(
    title: str, makers: Mapping[str, Callable[[], Workload]], rounds: int, context: Context
) -> dict[str, TimedWorkload]:
    """Make each workload, run it twice, time it, and go on to the next."""
    timed = {}
    for name, make in context.each(title, makers.items(), still=True):
        with context.timed(name):
            workload = make()
            _warm(workload.call)
            seconds = interleaved({name: workload.call}, context.rounds(f"timing {name}", rounds))[name]
        timed[name] = one = TimedWorkload(tuple(seconds.tolist()), workload)
        context.print(f"{name}: {1e3 * one.median_s:.4g} ms, {one.flops / 1e12:.3g} TFLOP/s")
    return timed


def matrix_product(side: int, dtype: DTypeLike) -> Workload:
    """A product of two square matrices of normal numbers."""
    a = jax.random.normal(jax.random.key(0), (side, side), dtype)
    multiply = jax.jit(jnp.matmul)
    return Workload(lambda: multiply(a, a), 2 * side**3, None, 1, "products")


def _warm(call: Callable[[], Any]) -> None:
    for _ in range(2):
        jax.block_until_ready(call())


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProcessTiming(EngineTimes):
    """A job in a process of its own: programs compiled for its step, and the best speed of matrix products there."""

    programs: int
    gflops_peak: float


def time_alone(size: JobSize, prefix: int, config: GRPOConfig, rounds: int, cache: Path) -> ProcessTiming:
    """Time the first iteration and those after the second, this process's peak memory, and matrix products."""
    began = time.perf_counter()
    with compilations_kept(cache):
        job = Job(size, prefix, config)
        jax.block_until_ready(job.step())
    first_s = time.perf_counter() - began
    return_memory()
    jax.block_until_ready(job.step())
    seconds = interleaved({"step": job.step}, range(rounds))["step"]
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KIB / GIB
    product = matrix_product(MATRIX, jnp.float32)
    jax.block_until_ready(product.call())
    fastest = interleaved({"product": product.call}, range(10))["product"].min()
    return ProcessTiming(
        seconds=tuple(seconds.tolist()),
        first_s=first_s,
        peak_gb=peak_gb,
        programs=job.compilations,
        gflops_peak=product.flops / fastest / 1e9,
    )


def options(
    size: JobSize, prefix: int, buckets: tuple[int, ...], names: Sequence[Option]
) -> dict[str, Callable[[], Job]]:
    """Makers of the default engine and of variants with one change; short answers are ones that end early."""
    plain = config_of(size)
    change = lambda **changes: lambda: Job(size, prefix, dataclasses.replace(plain, **changes))
    short = lambda config: lambda: Job(size, prefix, config, end_share=SHORT, learning_rate=0.0)
    makers: dict[Option, Callable[[], Job]] = {
        "one micro-batch": change(micro_prompts=size.prompts),
        "Gumbel draws": change(inverse_draws=False),
        "remat": change(remat=True),
        "bfloat16": change(bfloat16=True),
        "lean compilation": change(lean_compilation=True),
        "importance weights": change(algorithm=dataclasses.replace(plain.algorithm, importance_cap=2.0)),
        "host reward": lambda: Job(size, prefix, plain, host=True),
        "short answers": short(plain),
        "short answers, buckets": short(dataclasses.replace(plain, buckets=buckets)),
    }
    if not compiles_leanly():
        del makers["lean compilation"]
    return {"this": change()} | {name: makers[name] for name in names if name in makers}


def others(size: JobSize, prefix: int) -> dict[str, Callable[[], Job | PlainProgram]]:
    """Makers of the default engine, of plain programs, and of an engine that encodes the prefix for every rollout."""
    config = config_of(size)
    return {
        "this": lambda: Job(size, prefix, config),
        PLAIN: lambda: PlainProgram(size, prefix, size.prompts),
        f"{PLAIN}, micro-batches": lambda: PlainProgram(size, prefix, max(1, size.prompts // 4)),
        REPEATED: lambda: Job(size, prefix, config, repeated=True),
    }


def side_by_side(
    makers: Mapping[str, Callable[[], Job | PlainProgram]], rounds: int, what: str, context: Context
) -> dict[str, np.ndarray]:
    """Seconds of each job in every round, [rounds]."""
    calls = {}
    for name, make in context.each(f"compiling {what}", makers.items()):
        calls[name] = make().step
        _warm(calls[name])
    seconds = interleaved(calls, context.rounds(f"timing {what}", rounds))
    shown = (f"{name} {ratio:.2f} ({np.median(seconds[name]):.3f} s)" for name, ratio in over_this(seconds).items())
    context.print(f"{what}: {', '.join(shown)}")
    return seconds


def over_this(seconds: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Median over rounds of each job's time over that of `this` in the same round."""
    return {name: float(np.median(s / seconds["this"])) for name, s in seconds.items()}


def parser_seconds(size: JobSize, rounds: int = 20) -> float:
    """Median time to parse all completions of one iteration, random words of the touch language."""
    tokenizer = word_level(TOUCH_LANGUAGE, prompt_words())
    parse = jax.jit(jax.vmap(jax.vmap(compile_parser(TOUCH_LANGUAGE, tokenizer))))
    shape = (size.prompts, size.group, size.length)
    tokens = jnp.asarray(np.random.default_rng(0).integers(0, tokenizer.vocab_size, shape), jnp.int32)
    jax.block_until_ready(parse(tokens))
    return float(np.median(interleaved({"parse": lambda: parse(tokens)}, range(rounds))["parse"]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class LongRun:
    """Many steps of one job in a process of its own.

    Args:
      seconds: of every step, [n].
      resident_mb: resident memory after every `RESIDENT_EVERY` steps, [n / RESIDENT_EVERY].
      lengths: mean tokens of a completion, of the steps looked at the least and the most.
      programs: compiled for the step.
    """

    seconds: np.ndarray
    resident_mb: np.ndarray
    lengths: tuple[float, float]
    programs: int


def many_steps(size: JobSize, prefix: int, buckets: tuple[int, ...], steps: int, progress: ProgressCallback) -> LongRun:
    """Steps whose answers end early and late, so that every bucket is used; the policy stays as it is."""
    job = Job(size, prefix, dataclasses.replace(config_of(size), buckets=buckets), end_share=SHORT, learning_rate=0.0)
    for _ in range(3):
        jax.block_until_ready(job.step())
    return_memory()
    seconds, resident, lengths = np.empty(steps), [], []
    for t in range(steps):
        began = time.perf_counter()
        metrics = jax.block_until_ready(job.step())
        seconds[t] = time.perf_counter() - began
        if (t + 1) % RESIDENT_EVERY == 0:
            pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
            resident.append(pages * resource.getpagesize() / MIB)
            lengths.append(float(metrics["length"]))
            progress(t + 1, steps)
    return LongRun(
        seconds=seconds,
        resident_mb=np.array(resident),
        lengths=(min(lengths), max(lengths)),
        programs=job.compilations,
    )
