"""Measurements of one GRPO iteration: in a process of its own, beside its variants, over many steps."""

import dataclasses
import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.progress import ProgressCallback
from experiments.core.timing import interleaved
from experiments.engine.job import Job, config_of
from experiments.engine.peers import JobSize
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import compiles_leanly
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import prompt_words
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.training.compilation import compilations_kept, return_memory

MATRIX = 1024  # side of the matrices whose product is the yardstick of the machine
SHORT = 1 / 8  # share of the words that end a completion where answers are to be short
GIB, KIB, MIB = 2**30, 2**10, 2**20
RESIDENT_EVERY = 100  # steps between two looks at the memory

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
"""What can be changed about the engine."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProcessTiming:
    """One job in a process of its own; `programs` counts those of the step, `first_s` is the first iteration."""

    seconds: tuple[float, ...]
    first_s: float
    peak_gb: float
    programs: int
    gflops_peak: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class LongRun:
    """Many steps of one job in a process of its own.

    Args:
      seconds: of every step, [n].
      resident_mb: memory held after every `RESIDENT_EVERY` steps, [n / RESIDENT_EVERY].
      lengths: mean tokens of a completion, of the steps looked at the least and the most.
      programs: compiled for the step.
    """

    seconds: np.ndarray
    resident_mb: np.ndarray
    lengths: tuple[float, float]
    programs: int


def time_alone(size: JobSize, prefix: int, config: GRPOConfig, rounds: int, cache: Path) -> ProcessTiming:
    """Seconds of each iteration after the first two, of the first, peak memory of this process, matrix products.

    Args:
      size: of the job.
      prefix: prompt tokens.
      config: the step.
      rounds: iterations to time.
      cache: folder of compiled programs.
    """
    began = time.perf_counter()
    with compilations_kept(cache):
        job = Job(size, prefix, config)
        jax.block_until_ready(job.step())
    first_s = time.perf_counter() - began
    return_memory()
    jax.block_until_ready(job.step())
    seconds = interleaved({"step": job.step}, range(rounds))["step"]
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KIB / GIB
    return ProcessTiming(
        seconds=tuple(seconds.tolist()),
        first_s=first_s,
        peak_gb=peak_gb,
        programs=job.compilations,
        gflops_peak=matrix_gflops(),
    )


def matrix_gflops(rounds: int = 10) -> float:
    """Speed of large float32 matrix products, 10⁹ multiplications and additions a second, best of some."""
    a = jnp.asarray(np.random.default_rng(0).normal(size=(MATRIX, MATRIX)), jnp.float32)
    product = jax.jit(jnp.matmul)
    jax.block_until_ready(product(a, a))
    return 2 * MATRIX**3 / interleaved({"product": lambda: product(a, a)}, range(rounds))["product"].min() / 1e9


def options(
    size: JobSize, prefix: int, micro_prompts: int, buckets: tuple[int, ...], names: Sequence[Option]
) -> dict[str, Callable[[], Job]]:
    """Makers of the default engine and of variants with one change; short answers are ones that end early."""
    plain = config_of(size, micro_prompts)
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
    return {"this": lambda: Job(size, prefix, plain)} | {name: makers[name] for name in names if name in makers}


def repeated(size: JobSize, prefix: int, micro_prompts: int) -> dict[str, Callable[[], Job]]:
    """Makers of the default engine and of one that encodes the prefix for every rollout."""
    plain = config_of(size, micro_prompts)
    return {
        "this": lambda: Job(size, prefix, plain),
        "repeated prefix": lambda: Job(size, prefix, plain, repeated=True),
    }


def side_by_side(makers: dict[str, Callable[[], Job]], rounds: int, what: str, context: Context) -> dict[str, float]:
    """Median over rounds of each job's time over that of `this` in the same round.

    Args:
      makers: how to make each job.
      rounds: of timing.
      what: of them differs.
      context: shows how far it is.
    """
    jobs = {}
    for name, make in context.each(f"compiling {what}", makers.items()):
        jobs[name] = make()
        for _ in range(2):
            jax.block_until_ready(jobs[name].step())
    calls = {name: job.step for name, job in jobs.items()}
    seconds = interleaved(calls, context.rounds(f"timing {what}", rounds))
    return {name: float(np.median(s / seconds["this"])) for name, s in seconds.items()}


def parser_seconds(size: JobSize, rounds: int = 20) -> float:
    """Median time to parse all completions of one iteration, random words of the touch language."""
    tokenizer = word_level(TOUCH_LANGUAGE, prompt_words())
    parse = jax.jit(jax.vmap(jax.vmap(compile_parser(TOUCH_LANGUAGE, tokenizer))))
    shape = (size.prompts, size.group, size.length)
    tokens = jnp.asarray(np.random.default_rng(0).integers(0, tokenizer.vocab_size, shape), jnp.int32)
    jax.block_until_ready(parse(tokens))
    return float(np.median(interleaved({"parse": lambda: parse(tokens)}, range(rounds))["parse"]))


def many_steps(size: JobSize, prefix: int, buckets: tuple[int, ...], steps: int, tell: ProgressCallback) -> LongRun:
    """Steps whose answers end early and late, so that every bucket is taken; nothing is learned, so that they go on to.

    Args:
      size: of the job.
      prefix: prompt tokens.
      buckets: lengths that an update may pay for.
      steps: how many.
      tell: told of them whenever the memory is looked at.
    """
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
            resident.append(resident_mb())
            lengths.append(float(metrics["length"]))
            tell(t + 1, steps)
    return LongRun(
        seconds=seconds,
        resident_mb=np.array(resident),
        lengths=(min(lengths), max(lengths)),
        programs=job.compilations,
    )


def resident_mb() -> float:
    """Memory that this process holds now (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / MIB
