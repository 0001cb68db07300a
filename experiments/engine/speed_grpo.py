"""How fast is one GRPO iteration, what is gained by encoding a group's prefix once, and what share of the peak is used?

    make experiment EXP=speed_grpo [ARGS="--scale smoke"]
    make experiment EXP=speed_grpo ARGS="--trl-python TRL/bin/python --tunix-python TUNIX/bin/python"

One iteration of 8 prompts × 8 rollouts × 64 new tokens on a 1.05-million-parameter decoder with a reference policy, at
prefixes of 64 to 1024 tokens, each in two processes of its own: one that compiles and one that reads the compiled
programs.  It is compared with the engine's options and with an engine that encodes the prefix for every rollout; with a
vocabulary of a language model's size; over ten thousand steps, whose time and memory must stay constant; and with TRL
and Tunix where they can be imported (`experiments/engine/harness_trl.py` and `harness_tunix.py` explain how).  Matrix
products are timed in the same process, so that shares of the peak need no data sheet.

Cost: about six minutes on two cores, as much again for the two other engines; `--scale smoke` under one.

Expected: time grows with the prefix, which is encoded once, four to eight times more slowly than it would if every
rollout encoded it; repeating the prefix takes longer in proportion to the group at long prefixes, as in the other
engines, which repeat it.  On two cores of about 240 GFLOP/s: at most .55 s at prefix 64 and 1.3 s at 512, under 1 GB.
"""

import dataclasses
import itertools
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import jax

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.results import Cell, Picture, Requirement, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine.job import config_of
from experiments.engine.peers import BETA, JobSize, Peer, PeerFailed, PeerJob, PeerTimes, installed_peers
from experiments.engine.processes import in_own_process
from experiments.engine.speed import (
    LongRun,
    Option,
    ProcessTiming,
    many_steps,
    options,
    over_steps,
    parser_seconds,
    repeated,
    side_by_side,
    steadiness,
    time_alone,
)
from touchr1_jax.rl.grpo import compiles_leanly

LIMITS_S = {64: 0.55, 512: 1.3}
"""Seconds an iteration may take at a prefix, on two cores of about 240 GFLOP/s."""

PEER_S = {("TRL", 64): 1.36, ("Tunix", 64): 1.77, ("TRL", 512): 13.1, ("Tunix", 512): 24.5}
"""Seconds of the peers on the machine for which the limits were set; elsewhere the ratio counts."""

MEMORY_LIMIT_GB, MEMORY_AT = 1.0, 512
"""Most memory of a process, up to this prefix."""

PEER_TOKENS = 512
"""Prompt tokens of the timed iterations of a peer: fewer iterations at longer prefixes, at least one."""

LONG_SIZE = JobSize(
    prompts=2, group=2, length=16, vocab_size=64, hidden_size=32, num_layers=1, num_heads=2, num_kv_heads=1,
    head_dim=16, intermediate_size=64,
)  # fmt: skip
"""The job of the many steps."""

Timings = Mapping[int, ProcessTiming]
"""Prefix → timing."""

Peers = Mapping[tuple[str, int], PeerTimes]
"""(Peer, prefix) → its times."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpeedConfig:
    """Prefixes, timed iterations of each, the job, and where the other engines live."""

    prefixes: tuple[int, ...] = (64, 128, 512, 1024)
    rounds: int = 8
    options: tuple[Option, ...] = get_args(Option)
    """Changes of the engine, one at a time."""
    options_at: int = 64
    """Prefix at which the options are timed."""
    repeated_at: tuple[int, ...] = (64, 512)
    """Prefixes at which repeated prefixes are timed, and lean compilation at the last; they must be in `prefixes`."""
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
        missing = sorted({*self.repeated_at} - {*self.prefixes})
        if missing or not self.repeated_at:
            raise ValueError(f"repeated_at is {self.repeated_at}: must be of prefixes {self.prefixes}; add them there")


def run(config: SpeedConfig, context: Context) -> Results:
    """Every prefix alone, the variants side by side, many words, many steps, the peers."""
    size, lean_at, short = config.size, config.repeated_at[-1], min(config.prefixes)
    with tempfile.TemporaryDirectory() as folder:
        first, alone = every_prefix(config, Path(folder), context)
        step = dataclasses.replace(config_of(size), lean_compilation=True)
        lean = {
            prefix: in_own_process(time_alone, size, prefix, step, 1, Path(folder))
            for prefix in context.each("lean compilation", (lean_at,) if compiles_leanly() else (), still=True)
        }
        words = many_words(config, Path(folder), context) if config.words else {}
    makers = options(size, config.options_at, config.buckets, config.options)
    found = side_by_side(makers, config.rounds, "options", context)
    twice = {
        prefix: side_by_side(repeated(size, prefix), max(2, config.rounds // 2), f"prefix {prefix}", context)
        for prefix in config.repeated_at
    }
    with context.progress_callback("steps", still=True) as tell:
        tell(0, config.steps)
        long = in_own_process(many_steps, LONG_SIZE, short, (4, 8, 12), config.steps, tell=tell)
    peers, failed = measure_peers(config, installed_peers(config.trl_python, config.tunix_python), context)
    compiled = {"as it is": first[lean_at]} | ({"lean": lean[lean_at]} if lean else {})
    return Results(
        verdict=(*verdict(alone, twice, peers), *failed),
        requirements=requirements(alone, first, lean, peers, long, parser_seconds(size)),
        pictures=pictures(size, alone, first, peers, long),
        tables=(
            alone_table(size, alone, first),
            *((peer_table(size, alone, first, peers),) if peers else ()),
            compare_table("Options: time over that of the engine as it is", {config.options_at: found}),
            compare_table("Repeating the prefix: time over that of the engine as it is", twice),
            memory_table(f"Compiling at prefix {lean_at}", compiled),
            *((memory_table(f"A vocabulary of {config.words:,} words", words),) if words else ()),
        ),
        settings={"beta": BETA, "micro_prompts": 1, "devices": str(jax.devices())},
    )


def every_prefix(config: SpeedConfig, cache: Path, context: Context) -> tuple[Timings, Timings]:
    """Each prefix in a process that compiles, and in one that reads what the first compiled."""
    first, alone = {}, {}
    step = config_of(config.size)
    for prefix in context.each("prefixes", config.prefixes, still=True):
        first[prefix] = in_own_process(time_alone, config.size, prefix, step, 1, cache)
        alone[prefix] = in_own_process(time_alone, config.size, prefix, step, config.rounds, cache)
        a, b = alone[prefix], first[prefix]
        context.print(f"prefix {prefix}: {a.median_s:.3f} s, {a.peak_gb:.2f} GB, compiling {b.peak_gb:.2f} GB")
    return first, alone


def many_words(config: SpeedConfig, cache: Path, context: Context) -> dict[str, ProcessTiming]:
    """A large vocabulary, all logits at once and in blocks, each in a process of its own."""
    size = dataclasses.replace(config.size, prompts=2, vocab_size=config.words)
    blocks = config_of(size)
    whole = dataclasses.replace(blocks, max_logits=size.group * size.length * size.vocab_size)
    variants = {"all at once": whole, f"{blocks.max_logits:,} at a time": blocks}
    return {
        name: in_own_process(time_alone, size, min(config.prefixes), step, 2, cache)
        for name, step in context.each("many words", variants.items(), still=True)
    }


def measure_peers(config: SpeedConfig, peers: Sequence[Peer], context: Context) -> tuple[Peers, tuple[str, ...]]:
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


def verdict(alone: Timings, twice: Mapping[int, Mapping[str, float]], peers: Peers) -> tuple[str, ...]:
    """Time of an iteration, gain of prefixes that are encoded once, comparison with other engines."""
    times = ", ".join(f"{a.median_s:.3g} s at {prefix}" for prefix, a in alone.items())
    gains = ", ".join(f"{ratios['repeated prefix']:.1f} × at {prefix}" for prefix, ratios in twice.items())
    others = []
    for name in dict.fromkeys(name for name, _ in peers):
        ratios = {p: t.median_s / alone[p].median_s for (n, p), t in peers.items() if n == name}
        others.append(f"{name} takes " + ", ".join(f"{r:.1f} × at {p}" for p, r in ratios.items()) + " as long.")
    return f"One iteration takes {times}.", f"Repeating the prefix for every rollout takes {gains} as long.", *others


def requirements(
    alone: Timings, first: Timings, lean: Timings, peers: Peers, long: LongRun, parser_s: float
) -> tuple[Requirement, ...]:
    """The bounds on time, memory, compilations and drift.

    Args:
      alone: in processes that read their programs from the cache.
      first: in processes that compile them.
      lean: in processes that compile them leanly.
      peers: the other engines.
      long: many steps.
      parser_s: seconds that the parser takes.
    """
    ratios = [
        at_least(
            f"{name}'s time over this at prefix {prefix}",
            peers[name, prefix].median_s / alone[prefix].median_s,
            seconds / LIMITS_S[prefix],
            note=f"the bound is {seconds} s over {LIMITS_S[prefix]} s, both of one machine",
        )
        for (name, prefix), seconds in PEER_S.items()
        if (name, prefix) in peers and prefix in alone
    ]
    compilation = {"with compiled programs in the cache": alone, "compiling": first, "compiling leanly": lean}
    memory = [
        at_most(
            f"peak memory, {how}",
            max(a.peak_gb for prefix, a in timings.items() if prefix <= MEMORY_AT),
            MEMORY_LIMIT_GB,
            "GB",
            f"of the whole process, interpreter included, at prefixes up to {MEMORY_AT}",
        )
        for how, timings in compilation.items()
        if timings
    ]
    shortest = min(a.median_s for a in alone.values())
    return (
        *_time_limits(alone),
        *ratios,
        *memory,
        *_time_limits(lean, ", compiled leanly"),
        at_most("parser's share of an iteration", parser_s / shortest, 0.02),
        at_most("programs for one shape", max(a.programs for a in alone.values()), 1),
        *steadiness(long),
    )


def _time_limits(timings: Timings, how: str = "") -> list[Requirement]:
    machine = "a machine of {:.0f} GFLOP/s; the bound is for about 240 on two cores"
    return [
        at_most(f"iteration at prefix {prefix}{how}", timing.median_s, limit, "s", machine.format(timing.gflops_peak))
        for prefix, limit in LIMITS_S.items()
        if (timing := timings.get(prefix)) is not None
    ]


def alone_table(size: JobSize, alone: Timings, first: Timings) -> Table:
    """Seconds, memory and share of the peak of every prefix."""
    rows: list[dict[str, Cell]] = [
        {
            "prefix": prefix,
            "median": a.median_s,
            "least": min(a.seconds),
            "most": max(a.seconds),
            "first iteration": a.first_s,
            "peak memory": a.peak_gb,
            "first iteration, compiling": first[prefix].first_s,
            "peak memory, compiling": first[prefix].peak_gb,
            "work": size.gflop(prefix),
            "share of peak": size.gflop(prefix) / a.median_s / a.gflops_peak,
        }
        for prefix, a in alone.items()
    ]
    seconds = ("median", "least", "most", "first iteration", "first iteration, compiling")
    memory = ("peak memory", "peak memory, compiling")
    return named_table(
        "One iteration",
        rows,
        formats={"prefix": "d", "share of peak": ".2f"},
        units={"prefix": "tokens", **dict.fromkeys(seconds, "s"), **dict.fromkeys(memory, "GB"), "work": "GFLOP"},
        meanings={
            "first iteration": "programs read from the cache",
            "peak memory": "of the process, interpreter included",
            "work": "matrix products, the prefix once a prompt and pass",
            "share of peak": "of the speed of large matrix products in the same process",
        },
    )


def peer_table(size: JobSize, alone: Timings, first: Timings, peers: Peers) -> Table:
    """Every peer at every prefix, compared with this engine."""
    rows: list[dict[str, Cell]] = [
        {
            "engine": name,
            "prefix": prefix,
            "an iteration": p.median_s,
            "over this": p.median_s / alone[prefix].median_s,
            "peak memory": p.peak_gb,
            "over this one's": p.peak_gb / first[prefix].peak_gb,
            "first iteration": p.first_s,
            "share of peak": size.gflop(prefix) / p.median_s / alone[prefix].gflops_peak,
            "timed": len(p.seconds),
        }
        for (name, prefix), p in peers.items()
    ]
    versions = {name: ", ".join(f"{k} {v}" for k, v in p.versions.items()) for (name, _), p in peers.items()}
    return named_table(
        "Other engines on the same job",
        rows,
        formats={"prefix": "d", "over this": ".1f", "over this one's": ".1f", "share of peak": ".2f", "timed": "d"},
        units={"prefix": "tokens", "an iteration": "s", "peak memory": "GB", "first iteration": "s"},
        meanings={
            "an iteration": "median of the timed ones",
            "over this": "its time over that of this engine",
            "over this one's": "that of this engine's process, which compiles too",
            "share of peak": "the work that this engine needs, over its time",
        },
        note="; ".join(f"{name}: {text}" for name, text in versions.items()),
    )


def compare_table(title: str, found: Mapping[int, Mapping[str, float]]) -> Table:
    """Time of every variant over that of the engine, in the same rounds."""
    names = dict.fromkeys(name for ratios in found.values() for name in ratios)
    rows = [{"variant": name, **{f"prefix {p}": ratios.get(name) for p, ratios in found.items()}} for name in names]
    columns = [f"prefix {prefix}" for prefix in found]
    meanings = dict.fromkeys(columns, "median ratio within rounds")
    return named_table(title, rows, formats=dict.fromkeys(columns, ".2f"), meanings=meanings)


def memory_table(title: str, found: Mapping[str, ProcessTiming]) -> Table:
    """Memory and time of variants, each in a process that compiles its program."""
    rows = [
        {"way": name, "first iteration": a.first_s, "an iteration": a.median_s, "peak memory": a.peak_gb}
        for name, a in found.items()
    ]
    units = {"first iteration": "s", "an iteration": "s", "peak memory": "GB"}
    return named_table(title, rows, units=units, meanings={"peak memory": "of the process, compilation included"})


def pictures(size: JobSize, alone: Timings, first: Timings, peers: Peers, long: LongRun) -> tuple[Picture, ...]:
    """Engines over prefixes, and one engine over many steps."""
    seconds = {"this": {prefix: a.median_s for prefix, a in alone.items()}}
    memory = {"this": {prefix: a.peak_gb for prefix, a in first.items()}}
    for (name, prefix), p in peers.items():
        seconds.setdefault(name, {})[prefix] = p.median_s
        memory.setdefault(name, {})[prefix] = p.peak_gb
    return (
        Picture(
            name="prefixes",
            title="Time and memory over the length of the prompt",
            caption=f"{size.prompts} prompts × {size.group} rollouts × {size.length} new tokens; each engine in a "
            "process of its own that starts with nothing compiled.  Dotted line and crosses: bounds of this engine.",
            content=over_prefixes(seconds, memory, {p: s for p, s in LIMITS_S.items() if p in alone}),
        ),
        Picture(
            name="steps",
            title="Many steps of a tiny policy",
            caption="Left: median time of every hundred steps, shaded from the 5th to the 95th percentile; completions "
            "end early and late, so every length bucket is used.  Right: memory that the process holds.",
            content=over_steps(long),
        ),
    )


EngineFigures = Mapping[str, Mapping[int, float]]
"""Engine → prefix → figure."""


def over_prefixes(seconds: EngineFigures, memory_gb: EngineFigures, limits_s: Mapping[int, float]) -> bytes:
    """Draw time and peak memory of every engine over the prefix, with the bounds of this engine."""
    ticks = {float(prefix): str(prefix) for figures in seconds.values() for prefix in sorted(figures)}
    line = lambda name, by, **look: Series(name, x=list(by), y=list(by.values()), **look)
    axes: dict[str, Any] = {"x_label": "prompt, tokens", "x_scale": "log", "y_scale": "log", "x_ticks": ticks}
    times, memory = ([line(name, by) for name, by in figures.items()] for figures in (seconds, memory_gb))
    times += [line("bound of this engine", limits_s, line="", marker="P", colour="black")] if limits_s else []
    panels = [
        Panel(times, y_label="an iteration, s", **axes),
        Panel(memory, y_label="peak memory, GB", rules=[Rule(y=MEMORY_LIMIT_GB)], **axes),
    ]
    return draw(panels, size=(8.2, 4.2))


DEFAULT = SpeedConfig()
SMOKE = SpeedConfig(
    prefixes=(16,),
    rounds=2,
    options=("importance weights", "short answers, buckets"),
    options_at=16,
    repeated_at=(16,),
    buckets=(4,),
    words=0,
    steps=300,
    size=JobSize(
        prompts=2, group=2, length=8, vocab_size=64, hidden_size=32, num_layers=1, head_dim=8, intermediate_size=64
    ),
)

EXPERIMENT = Experiment(name="speed_grpo", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
