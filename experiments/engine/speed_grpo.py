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
from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import jax

from experiments.core.context import Context
from experiments.core.results import Picture, Results
from experiments.core.runner import Experiment
from experiments.engine.job import config_of
from experiments.engine.peers import BETA, JobSize, PeerFailed, PeerJob, PeerTimes, installed_peers
from experiments.engine.processes import in_own_process
from experiments.engine.speed import (
    LongRun,
    Option,
    ProcessTiming,
    many_steps,
    options,
    parser_seconds,
    repeated,
    side_by_side,
    time_alone,
)
from experiments.engine.speed_report import (
    LIMITS_S,
    Peers,
    alone_table,
    compare_table,
    median,
    memory_table,
    over_prefixes,
    over_steps,
    peer_table,
    requirements,
)
from touchr1_jax.rl.grpo import compiles_leanly

MANY_WORDS = "Two prompts of eight rollouts at the shortest prefix."


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpeedConfig:
    """Prefixes, timed iterations of each, the job, and where the other engines live."""

    prefixes: tuple[int, ...] = (64, 128, 512, 1024)
    rounds: int = 8
    micro_prompts: int = 1
    options: tuple[Option, ...] = get_args(Option)
    """What is changed about the engine, one thing at a time."""
    options_at: int = 64
    """Prefix at which the options are timed."""
    repeated_at: tuple[int, ...] = (64, 512)
    """Prefixes at which the repeated way is timed, and lean compilation at the last; they must be among `prefixes`."""
    buckets: tuple[int, ...] = (16, 32, 48)
    """Lengths that updates from short answers may pay for."""
    words: int = 131_072
    """The large vocabulary; 0 leaves it out."""
    steps: int = 10_000
    """Steps over which time and memory must stay flat."""
    steps_size: JobSize = JobSize(
        prompts=2,
        group=2,
        length=16,
        vocab_size=64,
        hidden_size=32,
        num_layers=1,
        num_heads=2,
        num_kv_heads=1,
        head_dim=16,
        intermediate_size=64,
    )
    trl_python: Path | None = None
    """An interpreter that has TRL; by default this one, where it has."""
    tunix_python: Path | None = None
    """An interpreter that has Tunix; by default this one, where it has."""
    peer_tokens: int = 512
    """Prompt tokens of the timed iterations of a peer: fewer iterations at longer prefixes, at least one."""
    size: JobSize = JobSize()

    def __post_init__(self) -> None:
        missing = sorted({*self.repeated_at} - {*self.prefixes})
        if missing or not self.repeated_at:
            raise ValueError(
                f"repeated_at is {self.repeated_at}: must be some of prefixes {self.prefixes}; add them there"
            )


def run(config: SpeedConfig, context: Context) -> Results:
    """Every prefix alone, the variants side by side, many words, many steps, the peers."""
    lean_at = config.repeated_at[-1]
    with tempfile.TemporaryDirectory() as folder:
        first, alone = every_prefix(config, Path(folder), context)
        step = dataclasses.replace(config_of(config.size, config.micro_prompts), lean_compilation=True)
        lean = {
            prefix: in_own_process(time_alone, config.size, prefix, step, 1, Path(folder))
            for prefix in context.each("lean compilation", (lean_at,) if compiles_leanly() else (), still=True)
        }
        words = many_words(config, Path(folder), context)
    makers = options(config.size, config.options_at, config.micro_prompts, config.buckets, config.options)
    found = side_by_side(makers, config.rounds, "options", context)
    context.print(f"options at prefix {config.options_at}: {said(found)}")
    twice = {}
    for prefix in config.repeated_at:
        makers = repeated(config.size, prefix, config.micro_prompts)
        twice[prefix] = side_by_side(makers, max(2, config.rounds // 2), f"prefix {prefix}", context)
        context.print(f"prefix {prefix}: {said(twice[prefix])}")
    short = min(config.prefixes)
    with context.progress_callback("steps", still=True) as tell:
        tell(0, config.steps)
        course = in_own_process(many_steps, config.steps_size, short, bucket_lengths(config), config.steps, tell=tell)
    peers, failed = measure_peers(config, context)
    return Results(
        verdict=(*verdict(alone, twice, peers), *failed),
        requirements=requirements(alone, first, lean, peers, course, parser_seconds(config.size)),
        pictures=pictures(config.size, alone, first, peers, course),
        tables=(
            alone_table(config.size, alone, first),
            *((peer_table(config.size, alone, first, peers),) if peers else ()),
            compare_table("Options: time over that of the engine as it is", {config.options_at: found}),
            compare_table("Repeating the prefix: time over that of the engine as it is", twice),
            memory_table(
                f"Compiling at prefix {lean_at}",
                "The older code generator needs less memory and makes slower programs.",
                {"as it is": first[lean_at], **({"lean": lean[lean_at]} if lean else {})},
            ),
            *((memory_table(f"A vocabulary of {config.words:,} words", MANY_WORDS, words),) if words else ()),
        ),
        settings={"beta": BETA, "micro_prompts": config.micro_prompts, "devices": str(jax.devices())},
    )


def every_prefix(
    config: SpeedConfig, cache: Path, context: Context
) -> tuple[dict[int, ProcessTiming], dict[int, ProcessTiming]]:
    """Each prefix in a process that compiles, and in one that reads what the first compiled."""
    first, alone = {}, {}
    step = config_of(config.size, config.micro_prompts)
    for prefix in context.each("prefixes", config.prefixes, still=True):
        first[prefix] = in_own_process(time_alone, config.size, prefix, step, 1, cache)
        alone[prefix] = in_own_process(time_alone, config.size, prefix, step, config.rounds, cache)
        a, b = alone[prefix], first[prefix]
        context.print(f"prefix {prefix}: {median(a.seconds):.3f} s, {a.peak_gb:.2f} GB, compiling {b.peak_gb:.2f} GB")
    return first, alone


def many_words(config: SpeedConfig, cache: Path, context: Context) -> dict[str, ProcessTiming]:
    """A large vocabulary, all logits at once and in blocks, each in a process of its own."""
    if not config.words:
        return {}
    size = dataclasses.replace(config.size, prompts=2, vocab_size=config.words)
    blocks = config_of(size)
    whole = dataclasses.replace(blocks, max_logits=size.group * size.length * size.vocab_size)
    found = {}
    ways = {"all at once": whole, f"{blocks.max_logits:,} at a time": blocks}
    for name, step in context.each("many words", ways.items(), still=True):
        found[name] = in_own_process(time_alone, size, min(config.prefixes), step, 2, cache)
        seconds = median(found[name].seconds)
        context.print(f"{config.words} words, {name}: {seconds:.2f} s, {found[name].peak_gb:.2f} GB")
    return found


def bucket_lengths(config: SpeedConfig) -> tuple[int, ...]:
    """The buckets that lie below the length of the many steps."""
    quarter = config.steps_size.length // 4
    return tuple(n for n in (quarter, 2 * quarter, 3 * quarter) if n > 1)


def measure_peers(config: SpeedConfig, context: Context) -> tuple[Peers, tuple[str, ...]]:
    """Every engine that is there at every prefix, one after the other, and in words which failed at a longer one.

    Raises:
      PeerFailed: an engine that fails at the first prefix, for it cannot be measured at all.
    """
    peers = installed_peers(config.trl_python, config.tunix_python)
    absent = {"TRL", "Tunix"} - {peer.name for peer in peers}
    if absent:
        context.print(f"not measured, for want of an interpreter that has them: {', '.join(sorted(absent))}")
    found: dict[tuple[str, int], PeerTimes] = {}
    failed: list[str] = []
    for prefix, peer in context.each("other engines", itertools.product(config.prefixes, peers), still=True):
        job = PeerJob(prefix=prefix, rounds=max(1, config.peer_tokens // prefix), size=config.size)
        try:
            times = found[peer.name, prefix] = peer.measure(job)
        except PeerFailed as failure:
            if prefix == config.prefixes[0]:
                raise
            failed.append(f"{peer.name} has no figure at {prefix}: its process ended with {failure.code}.")
            context.print(str(failure))
        else:
            context.print(f"{peer.name} at prefix {prefix}: {median(times.seconds):.2f} s, {times.peak_gb:.2f} GB")
    return found, tuple(failed)


def pictures(
    size: JobSize, alone: Mapping[int, ProcessTiming], first: Mapping[int, ProcessTiming], peers: Peers, course: LongRun
) -> tuple[Picture, ...]:
    """Engines over prefixes, and one engine over many steps."""
    seconds = {"this": {prefix: median(a.seconds) for prefix, a in alone.items()}}
    memory = {"this": {prefix: a.peak_gb for prefix, a in first.items()}}
    for (name, prefix), p in peers.items():
        seconds.setdefault(name, {})[prefix] = median(p.seconds)
        memory.setdefault(name, {})[prefix] = p.peak_gb
    return (
        Picture(
            name="prefixes",
            title="Time and memory over the length of the prompt",
            caption=f"One iteration of {size.prompts} prompts × {size.group} rollouts × {size.length} new tokens; each "
            "engine in a process of its own that starts with nothing compiled.  The dotted line and the black crosses "
            "are the bounds of this engine.",
            content=over_prefixes(seconds, memory, {p: s for p, s in LIMITS_S.items() if p in alone}),
        ),
        Picture(
            name="steps",
            title="Many steps of a tiny policy",
            caption="Left: median time of every hundred steps, shaded from the 5th to the 95th percentile; completions "
            "end early and late, so every length bucket is used.  Right: memory that the process holds.",
            content=over_steps(course),
        ),
    )


def said(ratios: Mapping[str, float]) -> str:
    """Ratios in one line."""
    return ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())


def verdict(
    alone: Mapping[int, ProcessTiming], twice: Mapping[int, Mapping[str, float]], peers: Peers
) -> tuple[str, ...]:
    """Verdict: time of an iteration, gain of prefixes that are encoded once, comparison with other engines."""
    times = ", ".join(f"{median(a.seconds):.3g} s at {prefix}" for prefix, a in alone.items())
    gains = ", ".join(f"{ratios['repeated prefix']:.1f} × at {prefix}" for prefix, ratios in twice.items())
    spoken = [f"One iteration takes {times}.", f"Repeating the prefix for every rollout takes {gains} as long."]
    for name in dict.fromkeys(name for name, _ in peers):
        ratios = {p: median(t.seconds) / median(alone[p].seconds) for (n, p), t in peers.items() if n == name}
        spoken.append(f"{name} takes " + ", ".join(f"{r:.1f} × at {p}" for p, r in ratios.items()) + " as long.")
    return tuple(spoken)


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
