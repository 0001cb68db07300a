"""How fast is one GRPO iteration, what does encoding a group's prefix once gain, and what share of the peak is used?

    make experiment EXP=speed_grpo [ARGS="--scale smoke"]
    make experiment EXP=speed_grpo ARGS="--trl-python TRL/bin/python --tunix-python TUNIX/bin/python"

One iteration of 8 prompts × 8 rollouts × 64 new tokens on a 1.05-million-parameter decoder with a reference policy, at
prefixes of 64 to 1024 tokens, each in two processes: one compiles and one reads the compiled
programs.  It is compared with the engine's options, with an engine that encodes the prefix for every rollout, with a
plain program that shares the prefix (see `plain_program.py`), and with TRL and Tunix where they can be imported (see
`harness_trl.py` and `harness_tunix.py`).  A large vocabulary and ten thousand steps, whose time and memory must stay
constant, are measured too.  Matrix products are timed in the same process, so that shares of the peak need no data
sheet.  Every shape of product of an iteration is also timed alone; on an idle machine, the sum estimates the lower
bound of an iteration (see `matrix_floor.py`).

Cost: half an hour in the recorded run on two cores, with both other engines; `--scale smoke` under one.

Expected: as the prefix gets longer, time grows four to eight times more slowly than in an engine that encodes the
prefix for every rollout, as the other engines do.  Required on two cores of about 240 GFLOP/s: at most .55 s at prefix
64 and 1.3 s at 512, under 1 GB; the recorded run took .62 and 1.23 s.
"""

import dataclasses
import functools
import itertools
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar, get_args

import jax

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.engine import speed
from experiments.engine import speed_report as report
from experiments.engine.job import Job, config_of
from experiments.engine.matrix_floor import TimedProduct, floor_table, time_products
from experiments.engine.peers import BETA, JobSize, Peer, PeerFailed, PeerJob, PeerTimes, installed_peers
from experiments.engine.processes import in_own_process
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import compiles_leanly
from touchr1_jax.validation import at_least

K = TypeVar("K")
TimedJob = tuple[JobSize, int, GRPOConfig, int]  # size, prefix, step, rounds

PEER_TOKENS = 512  # prompt tokens of the timed iterations of a peer: fewer iterations at longer prefixes, at least one

LONG_SIZE = JobSize(
    prompts=2, group=2, length=16, vocab_size=64, hidden_size=32, num_layers=1, num_heads=2, num_kv_heads=1,
    head_dim=16, intermediate_size=64,
)  # fmt: skip
"""The job of the many steps."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpeedConfig:
    """Prefixes, timed iterations of each, the job, and where the other engines live."""

    prefixes: tuple[int, ...] = (64, 128, 512, 1024)
    rounds: int = 8
    options: tuple[speed.Option, ...] = get_args(speed.Option)
    """Changes of the engine, one at a time."""
    options_at: int = 64
    """Prefix at which the options are timed."""
    repeated_at: tuple[int, ...] = (64, 512)
    """Prefixes at which repeated prefixes, plain programs and single products are timed, and lean compilation at the
    last; they must be in `prefixes`."""
    buckets: tuple[int, ...] = (16, 32, 48)
    """Lengths that updates from short answers may pay for."""
    words: int = 131_072
    """The large vocabulary; 0 leaves it out."""
    steps: int = 10_000
    """Steps over which time and memory must stay flat."""
    trl_python: Path | None = None
    """An interpreter that has TRL; by default this one, where it has."""
    tunix_python: Path | None = None
    """An interpreter that has Tunix; by default this one, where it has."""
    size: JobSize = JobSize()

    def __post_init__(self) -> None:
        at_least(self, 0, "words")
        missing = sorted({*self.repeated_at} - {*self.prefixes})
        if missing or not self.repeated_at:
            raise ValueError(f"repeated_at is {self.repeated_at}: must be of prefixes {self.prefixes}; add them there")
        if self.steps < speed.RESIDENT_EVERY:
            raise ValueError(
                f"steps is {self.steps}: must be at least {speed.RESIDENT_EVERY}, where memory is first read; raise it"
            )


def run(config: SpeedConfig, context: Context) -> Results:
    """Every prefix alone, the variants side by side, many words, many steps, the peers."""
    size, step = config.size, config_of(config.size)
    lean_at, lean_step = config.repeated_at[-1], dataclasses.replace(step, lean_compilation=True)
    with tempfile.TemporaryDirectory() as folder:
        alone_in_processes = functools.partial(time_in_processes, Path(folder), context)
        first = alone_in_processes("prefixes, compiling", {p: (size, p, step, 1) for p in config.prefixes})
        alone = alone_in_processes("prefixes", {p: (size, p, step, config.rounds) for p in config.prefixes})
        leanly = {lean_at: (size, lean_at, lean_step, 1)} if compiles_leanly() else {}
        lean = alone_in_processes("lean compilation", leanly)
        worded = alone_in_processes("many words", many_words(config) if config.words else {})
    makers = speed.options(size, config.options_at, config.buckets, config.options)
    alternating = lambda jobs, what: speed.side_by_side(jobs, config.rounds, what, context)
    options = {config.options_at: alternating(makers, "options")}
    others = {p: alternating(speed.others(size, p), f"prefix {p}") for p in config.repeated_at}
    floors = measure_floors(config, context)
    with context.progress_callback("steps", still=True) as progress:
        progress(0, config.steps)
        long = in_own_process(
            speed.many_steps, LONG_SIZE, min(config.prefixes), (4, 8, 12), config.steps, progress=progress
        )
    peers, failed = measure_peers(config, installed_peers(config.trl_python, config.tunix_python), context)
    compiled = {"as it is": first[lean_at]} | ({"lean": lean[lean_at]} if lean else {})
    return Results(
        verdict=(*report.verdict(alone, others, peers), *failed),
        requirements=(
            *report.requirements(alone, first, lean, peers, long, speed.parser_seconds(size)),
            *report.peak_shares(size, alone, floors),
            *report.plain_ratios(others, floors),
        ),
        pictures=report.pictures(size, alone, first, peers, long),
        tables=(
            report.alone_table(size, alone, first),
            *(floor_table(p, found, min(alone[p].seconds)) for p, found in floors.items()),
            *((report.peer_table(size, alone, first, peers),) if peers else ()),
            report.turns_table("Options, one at a time", options),
            report.turns_table("Plain programs that share the prefix, and the engine with a repeated prefix", others),
            report.memory_table(f"Compiling at prefix {lean_at}", compiled),
            *((report.memory_table(f"A vocabulary of {config.words:,} words", worded),) if worded else ()),
        ),
        settings={"beta": BETA, "micro_prompts": 1, "devices": [device.device_kind for device in jax.devices()]},
    )


def time_in_processes(
    cache: Path, context: Context, title: str, jobs: Mapping[K, TimedJob]
) -> dict[K, speed.ProcessTiming]:
    """Time jobs, each in a process of its own that keeps its programs in the cache."""
    found = {}
    for name, job in context.each(title, jobs.items(), still=True):
        found[name] = t = in_own_process(speed.time_alone, *job, cache)
        context.print(f"{title} {name}: {t.median_s:.3f} s, {t.peak_gb:.2f} GB")
    return found


def measure_floors(config: SpeedConfig, context: Context) -> dict[int, tuple[TimedProduct, ...]]:
    """Every shape of product of an iteration alone."""
    found = {}
    for prefix in context.each("single products", config.repeated_at):
        step = Job(config.size, prefix, config_of(config.size)).traced()
        found[prefix] = timed = time_products(step, config.size.length, config.rounds)
        context.print(f"prefix {prefix}: {len(timed)} shapes of products, {sum(t.seconds for t in timed):.3f} s alone")
    return found


def many_words(config: SpeedConfig) -> dict[str, TimedJob]:
    """Jobs with a large vocabulary, all logits at once and in blocks."""
    size = dataclasses.replace(config.size, prompts=2, vocab_size=config.words)
    blocks = config_of(size)
    whole = dataclasses.replace(blocks, max_logits=size.group * size.length * size.vocab_size)
    steps = {"all at once": whole, f"{blocks.max_logits:,} at a time": blocks}
    return {name: (size, min(config.prefixes), step, 2) for name, step in steps.items()}


def measure_peers(config: SpeedConfig, peers: Sequence[Peer], context: Context) -> tuple[report.Peers, tuple[str, ...]]:
    """Every engine that is installed at every prefix, one after the other, and sentences on failures at a longer one.

    Raises:
      PeerFailed: an engine that fails at the first prefix, for it cannot be measured at all.
    """
    context.print(f"other engines with an interpreter: {', '.join(peer.name for peer in peers) or 'none'}")
    found: dict[tuple[str, int], PeerTimes] = {}
    failed: list[str] = []
    for prefix, peer in context.each("other engines", itertools.product(config.prefixes, peers), still=True):
        job = PeerJob(prefix=prefix, rounds=max(1, PEER_TOKENS // prefix), size=config.size)
        try:
            times = found[peer.name, prefix] = peer.measure(job)
        except PeerFailed as failure:
            if prefix == config.prefixes[0]:
                raise
            failed.append(f"{peer.name} has no figure at {prefix}: its process ended with {failure.code}.")
            context.print(str(failure))
        else:
            context.print(f"{peer.name} at prefix {prefix}: {times.median_s:.2f} s, {times.peak_gb:.2f} GB")
    return found, tuple(failed)


SMOKE = SpeedConfig(
    prefixes=(16,), rounds=2, options=("importance weights", "short answers, buckets"), options_at=16,
    repeated_at=(16,), buckets=(4,), words=0, steps=300,
    size=JobSize(
        prompts=2, group=2, length=8, vocab_size=64, hidden_size=32, num_layers=1, head_dim=8, intermediate_size=64
    ),
)  # fmt: skip

EXPERIMENT = Experiment(name="speed_grpo", config=SpeedConfig(), scales={"smoke": SMOKE}, run=run)
