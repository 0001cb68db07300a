"""How fast is one GRPO iteration, what does it gain from encoding a group's prefix once, and how near is the machine?

    make experiment EXP=speed_grpo [ARGS="--scale smoke"]

One iteration of 8 prompts × 8 rollouts × 64 new tokens on a 1.05-million-parameter decoder with a reference policy, at
prefixes of 64 to 1024 tokens, each in processes of its own for their memory, one that compiles and one that reads the
compiled programs; then interleaved with the same engine that
repeats the prefix for every rollout, and with its options: micro-batches, Gumbel instead of inverse draws, remat,
bfloat16, a host reward.  Matrix products are timed beside them, so that shares of the peak need no data sheet.

Cost: about eight minutes on two cores, `--scale smoke` under one.

Expected: time grows with the prefix as its once-encoded share does, four to eight times slower than the rollouts alone
would suggest; the repeated way falls behind in proportion to the group at long prefixes.  On two cores of about
240 GFLOP/s: at most .55 s at prefix 64 and 1.3 s at 512, under 1 GB.
"""

import concurrent.futures
import dataclasses
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.grpo.job import BETA, Job, Size, config_of
from experiments.reporting.findings import Cell, Column, Findings, Requirement, Table
from experiments.running.context import Context
from experiments.running.runner import Experiment
from experiments.running.timing import interleaved
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.template import prompt_words
from touchr1_jax.text.tokenizer import word_level
from touchr1_jax.training.compilation import keep_compilations

LIMITS_S = {64: 0.55, 512: 1.3}
"""Seconds an iteration may take at a prefix, on two cores of about 240 GFLOP/s."""

MEMORY_LIMIT_GB = 1.0
MATRIX = 1024  # side of the matrices whose product is the yardstick of the machine
GB = 2**30


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpeedConfig:
    """Prefixes, timed iterations of each, and the job."""

    prefixes: tuple[int, ...] = (64, 128, 256, 512, 1024)
    rounds: int = 8
    micro_prompts: int = 1
    compared: tuple[int, ...] = (64, 512)
    """Prefixes at which the repeated way and the options are timed too."""
    flat_steps: int = 1000
    """Steps over which time and memory must stay flat, at the shortest prefix and a quarter of the tokens."""
    size: Size = Size()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Alone:
    """One prefix in a process of its own."""

    seconds: list[float]
    compile_s: float
    peak_gb: float
    programs: int
    gflops_peak: float


def run(config: SpeedConfig, context: Context) -> Findings:
    """Every prefix alone, then the variants side by side, then many steps."""
    alone, first = {}, {}
    with tempfile.TemporaryDirectory() as cache:
        for prefix in config.prefixes:
            first[prefix] = in_own_process(time_alone, dataclasses.replace(config, rounds=1), prefix, Path(cache))
            alone[prefix] = in_own_process(time_alone, config, prefix, Path(cache))
            context.say(f"prefix {prefix}: {np.median(alone[prefix].seconds):.3f} s")
    side_by_side = {prefix: compare(config, prefix) for prefix in config.compared}
    parser_s = parser_seconds(config.size)
    flat = steps_stay_flat(config)
    context.say(f"{config.flat_steps} steps: {flat}")
    return Findings(
        verdict=verdict(alone, side_by_side),
        requirements=requirements(alone, flat, parser_s),
        tables=(alone_table(config, alone, first), compare_table(side_by_side)),
        settings={"beta": BETA, "micro_prompts": config.micro_prompts, "devices": str(jax.devices())},
        data={"flat": flat},
    )


def in_own_process(
    work: Callable[[SpeedConfig, int, Path | None], Alone], config: SpeedConfig, prefix: int, cache: Path
) -> Alone:
    """Run in a fresh interpreter, whose peak memory is the job's; programs are kept in `cache` for the next one."""
    fresh = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=fresh) as pool:
        return pool.submit(work, config, prefix, cache).result()


def time_alone(config: SpeedConfig, prefix: int, cache: Path | None) -> Alone:
    """Seconds of each iteration after the first two, compilation, peak memory of this process, matrix products."""
    if cache is not None:
        keep_compilations(cache)
    began = time.perf_counter()
    job = Job(config.size, prefix, config_of(config.size, config.micro_prompts))
    jax.block_until_ready(job.step())
    compile_s = time.perf_counter() - began
    jax.block_until_ready(job.step())
    seconds = interleaved({"step": job.step}, config.rounds)["step"]
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GB
    return Alone(
        seconds=seconds.tolist(),
        compile_s=compile_s,
        peak_gb=peak_gb,
        programs=job.compilations,
        gflops_peak=matrix_gflops(),
    )


def matrix_gflops(rounds: int = 10) -> float:
    """Speed of large float32 matrix products, 10⁹ multiplications and additions a second, best of some."""
    a = jnp.asarray(np.random.default_rng(0).normal(size=(MATRIX, MATRIX)), jnp.float32)
    product = jax.jit(jnp.matmul)
    jax.block_until_ready(product(a, a))
    return 2 * MATRIX**3 / interleaved({"product": lambda: product(a, a)}, rounds)["product"].min() / 1e9


def compare(config: SpeedConfig, prefix: int) -> dict[str, np.ndarray]:
    """Seconds of the engine, of the repeated prefix and of every option, round by round."""
    plain = config_of(config.size, config.micro_prompts)
    most = config.size.prompts
    variants: Mapping[str, GRPOConfig] = {
        "this": plain,
        "one micro-batch": dataclasses.replace(plain, micro_prompts=most),
        "Gumbel draws": dataclasses.replace(plain, inverse_draws=False),
        "remat": dataclasses.replace(plain, remat=True),
        "bfloat16": dataclasses.replace(plain, bfloat16=True),
    }
    jobs = {name: Job(config.size, prefix, variant) for name, variant in variants.items()}
    jobs["host reward"] = Job(config.size, prefix, plain, host=True)
    jobs["repeated prefix"] = Job(config.size, prefix, plain, repeated=True)
    for job in jobs.values():
        for _ in range(2):
            jax.block_until_ready(job.step())
    return interleaved({name: job.step for name, job in jobs.items()}, max(2, config.rounds // 2))


def parser_seconds(size: Size, rounds: int = 20) -> float:
    """Median time to parse all completions of one iteration, random words of the touch language."""
    tokenizer = word_level(TOUCH_LANGUAGE, prompt_words())
    parse = jax.jit(jax.vmap(jax.vmap(compile_parser(TOUCH_LANGUAGE, tokenizer))))
    shape = (size.prompts, size.group, size.length)
    tokens = jnp.asarray(np.random.default_rng(0).integers(0, tokenizer.vocab_size, shape), jnp.int32)
    jax.block_until_ready(parse(tokens))
    return float(np.median(interleaved({"parse": lambda: parse(tokens)}, rounds)["parse"]))


def steps_stay_flat(config: SpeedConfig) -> dict[str, float]:
    """Time of the last tenth of many steps over the first, growth of memory in MB, programs compiled."""
    size = dataclasses.replace(config.size, prompts=2, group=4, length=16)
    job = Job(size, min(config.prefixes), config_of(size))
    for _ in range(3):
        jax.block_until_ready(job.step())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = interleaved({"step": job.step}, config.flat_steps)["step"]
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    tenth = max(1, len(seconds) // 10)
    drift = float(np.median(seconds[-tenth:]) / np.median(seconds[:tenth]))
    return {"drift": drift, "grown_mb": grown / 1024, "programs": float(job.compilations)}


def requirements(alone: Mapping[int, Alone], flat: Mapping[str, float], parser_s: float) -> tuple[Requirement, ...]:
    """The bounds on time, memory, compilations and drift."""
    bounds = [
        Requirement(
            name=f"iteration at prefix {prefix}",
            measured=float(np.median(alone[prefix].seconds)),
            bound=limit,
            better="lower",
            unit="s",
            note=f"a machine of {alone[prefix].gflops_peak:.0f} GFLOP/s; the bound is for about 240 on two cores",
        )
        for prefix, limit in LIMITS_S.items()
        if prefix in alone
    ]
    peak = max(a.peak_gb for a in alone.values())
    shortest = min(float(np.median(a.seconds)) for a in alone.values())
    programs = max(a.programs for a in alone.values())
    return (
        *bounds,
        Requirement(
            name="peak memory",
            measured=peak,
            bound=MEMORY_LIMIT_GB,
            better="lower",
            unit="GB",
            note="of processes that read their programs from the compilation cache",
        ),
        Requirement(name="parser's share of an iteration", measured=parser_s / shortest, bound=0.02, better="lower"),
        Requirement(name="programs for one shape", measured=programs, bound=1, better="lower"),
        Requirement(name="time of late steps over early ones", measured=flat["drift"], bound=1.1, better="lower"),
        Requirement(name="memory that many steps add", measured=flat["grown_mb"], bound=16, better="lower", unit="MB"),
    )


def alone_table(config: SpeedConfig, alone: Mapping[int, Alone], first: Mapping[int, Alone]) -> Table:
    """Seconds, memory and share of the peak of every prefix."""
    rows: list[tuple[Cell, ...]] = []
    for prefix, a in alone.items():
        s, gflop = float(np.median(a.seconds)), config.size.gflop(prefix)
        low, high = min(a.seconds), max(a.seconds)
        began = first[prefix]
        memory = (a.compile_s, a.peak_gb, began.compile_s, began.peak_gb)
        rows.append((prefix, s, low, high, *memory, gflop, gflop / s / a.gflops_peak))
    return Table(
        title="One iteration",
        columns=(
            Column(name="prefix", unit="tokens", format="d"),
            Column(name="median", unit="s"),
            Column(name="least", unit="s"),
            Column(name="most", unit="s"),
            Column(name="first iteration", unit="s", meaning="programs read from the cache"),
            Column(name="peak memory", unit="GB", meaning="of the process, interpreter included"),
            Column(name="first iteration, compiling", unit="s"),
            Column(name="peak memory, compiling", unit="GB", meaning="of the process that compiles for the cache"),
            Column(name="work", unit="GFLOP", meaning="matrix products, the prefix once a prompt and pass"),
            Column(name="share of peak", format=".2f", meaning="of the speed of large matrix products beside it"),
        ),
        rows=tuple(rows),
    )


def compare_table(found: Mapping[int, Mapping[str, np.ndarray]]) -> Table:
    """Time of every variant over that of the engine, in the same rounds."""
    names = list(next(iter(found.values())))
    rows: list[tuple[Cell, ...]] = [
        (name, *(float(np.median(seconds[name] / seconds["this"])) for seconds in found.values())) for name in names
    ]
    return Table(
        title="Time over that of the engine as it is",
        columns=(
            Column(name="variant"),
            *(Column(name=f"prefix {prefix}", format=".2f", meaning="median ratio within rounds") for prefix in found),
        ),
        rows=tuple(rows),
    )


def verdict(alone: Mapping[int, Alone], found: Mapping[int, Mapping[str, np.ndarray]]) -> tuple[str, ...]:
    """What an iteration takes, and what once-encoded prefixes gain."""
    times = ", ".join(f"{np.median(a.seconds):.2f} s at {prefix}" for prefix, a in alone.items())
    gains = ", ".join(
        f"{np.median(seconds['repeated prefix'] / seconds['this']):.1f} × at {prefix}"
        for prefix, seconds in found.items()
    )
    return (f"One iteration takes {times}.", f"Repeating the prefix for every rollout takes {gains} as long.")


DEFAULT = SpeedConfig()
SMOKE = SpeedConfig(
    prefixes=(16, 32),
    rounds=2,
    compared=(16,),
    flat_steps=30,
    size=Size(
        prompts=2, group=2, length=8, vocab_size=64, hidden_size=32, num_layers=1, head_dim=8, intermediate_size=64
    ),
)

EXPERIMENT = Experiment(name="speed_grpo", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
