"""Requirements, tables and charts of the speed of GRPO."""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.results import Cell, Requirement, Table, named_table
from experiments.engine.peers import JobSize, PeerTimes
from experiments.engine.speed import RESIDENT_EVERY, LongRun, ProcessTiming

LIMITS_S = {64: 0.55, 512: 1.3}
"""Seconds an iteration may take at a prefix, on two cores of about 240 GFLOP/s."""

PEER_S = {("TRL", 64): 1.36, ("Tunix", 64): 1.77, ("TRL", 512): 13.1, ("Tunix", 512): 24.5}
"""Seconds of the peers on the machine for which the limits were set; elsewhere the ratio counts."""

MEMORY_LIMIT_GB, MEMORY_AT = 1.0, 512
"""Most memory of a process, up to this prefix."""

EARLY = 1000
"""Steps over which time must stay constant; memory must over all."""

Peers = Mapping[tuple[str, int], PeerTimes]
"""(Peer, prefix) → its times."""


def requirements(
    alone: Mapping[int, ProcessTiming],
    first: Mapping[int, ProcessTiming],
    lean: Mapping[int, ProcessTiming],
    peers: Peers,
    course: LongRun,
    parser_s: float,
) -> tuple[Requirement, ...]:
    """The bounds on time, memory, compilations and drift.

    Args:
      alone: by prefix, in processes that read their programs from the cache.
      first: by prefix, in processes that compile them.
      lean: by prefix, in processes that compile them leanly.
      peers: the other engines.
      course: many steps.
      parser_s: seconds that the parser takes.
    """
    shortest = min(median(a.seconds) for a in alone.values())
    return (
        *_times(alone),
        *_ratios(alone, peers),
        *_memory(alone, "with compiled programs in the cache"),
        *_memory(first, "compiling"),
        *(_memory(lean, "compiling leanly") if lean else ()),
        *_times(lean, ", compiled leanly"),
        Requirement(name="parser's share of an iteration", measured=parser_s / shortest, bound=0.02, better="lower"),
        Requirement(
            name="programs for one shape",
            measured=max(a.programs for a in alone.values()),
            bound=1,
            better="lower",
        ),
        *steadiness(course),
    )


def _times(alone: Mapping[int, ProcessTiming], how: str = "") -> list[Requirement]:
    return [
        Requirement(
            name=f"iteration at prefix {prefix}{how}",
            measured=median(alone[prefix].seconds),
            bound=limit,
            better="lower",
            unit="s",
            note=f"a machine of {alone[prefix].gflops_peak:.0f} GFLOP/s; the bound is for about 240 on two cores",
        )
        for prefix, limit in LIMITS_S.items()
        if prefix in alone
    ]


def _ratios(alone: Mapping[int, ProcessTiming], peers: Peers) -> list[Requirement]:
    return [
        Requirement(
            name=f"{name}'s time over this at prefix {prefix}",
            measured=median(peers[name, prefix].seconds) / median(alone[prefix].seconds),
            bound=seconds / LIMITS_S[prefix],
            better="higher",
            note=f"the bound is {seconds} s over {LIMITS_S[prefix]} s, both of one machine",
        )
        for (name, prefix), seconds in PEER_S.items()
        if (name, prefix) in peers and prefix in alone
    ]


def _memory(alone: Mapping[int, ProcessTiming], how: str) -> list[Requirement]:
    return [
        Requirement(
            name=f"peak memory, {how}",
            measured=max(a.peak_gb for prefix, a in alone.items() if prefix <= MEMORY_AT),
            bound=MEMORY_LIMIT_GB,
            better="lower",
            unit="GB",
            note=f"of the whole process, interpreter included, at prefixes up to {MEMORY_AT}",
        )
    ]


def steadiness(course: LongRun) -> tuple[Requirement, ...]:
    """Time and memory of late steps against early ones, and one program for all lengths."""
    early, n = course.seconds[:EARLY], len(course.seconds)
    tenth = max(1, len(early) // 10)
    grown = float(course.resident_mb[-1] - course.resident_mb[0])
    drift = float(np.median(early[-tenth:]) / np.median(early[:tenth]))
    low, high = course.lengths
    return (
        Requirement(
            name=f"time of late steps over early ones, of {len(early):,}", measured=drift, bound=1.1, better="lower"
        ),
        Requirement(name=f"memory that {n:,} steps add", measured=grown, bound=16, better="lower", unit="MB"),
        Requirement(
            name="programs for all lengths",
            measured=course.programs,
            bound=1,
            better="lower",
            note=f"mean lengths of {low:.1f} to {high:.1f} tokens in {n:,} steps",
        ),
    )


def alone_table(size: JobSize, alone: Mapping[int, ProcessTiming], first: Mapping[int, ProcessTiming]) -> Table:
    """Seconds, memory and share of the peak of every prefix."""
    rows: list[dict[str, Cell]] = [
        {
            "prefix": prefix,
            "median": median(a.seconds),
            "least": min(a.seconds),
            "most": max(a.seconds),
            "first iteration": a.first_s,
            "peak memory": a.peak_gb,
            "first iteration, compiling": first[prefix].first_s,
            "peak memory, compiling": first[prefix].peak_gb,
            "work": size.gflop(prefix),
            "share of peak": size.gflop(prefix) / median(a.seconds) / a.gflops_peak,
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
            "peak memory, compiling": "of the process that compiles for the cache",
            "work": "matrix products, the prefix once a prompt and pass",
            "share of peak": "of the speed of large matrix products beside it",
        },
    )


def peer_table(
    size: JobSize, alone: Mapping[int, ProcessTiming], first: Mapping[int, ProcessTiming], peers: Peers
) -> Table:
    """Every peer at every prefix, compared with this engine."""
    rows: list[dict[str, Cell]] = []
    for (name, prefix), p in peers.items():
        this, s = alone[prefix], median(p.seconds)
        rows.append(
            {
                "engine": name,
                "prefix": prefix,
                "an iteration": s,
                "over this": s / median(this.seconds),
                "peak memory": p.peak_gb,
                "over this one's": p.peak_gb / first[prefix].peak_gb,
                "first iteration": p.first_s,
                "share of peak": size.gflop(prefix) / s / this.gflops_peak,
                "timed": len(p.seconds),
            }
        )
    versions = {name: ", ".join(f"{k} {v}" for k, v in p.versions.items()) for (name, _), p in peers.items()}
    return named_table(
        "Other engines on the same job",
        rows,
        formats={"prefix": "d", "over this": ".1f", "over this one's": ".1f", "share of peak": ".2f", "timed": "d"},
        units={"prefix": "tokens", "an iteration": "s", "peak memory": "GB", "first iteration": "s"},
        meanings={
            "an iteration": "median of the timed ones",
            "over this": "its time over that of this engine",
            "peak memory": "of its process",
            "over this one's": "that of this engine's process, which compiles too",
            "share of peak": "the work that this engine needs, over its time",
        },
        note="; ".join(f"{name}: {text}" for name, text in versions.items()),
    )


def compare_table(title: str, found: Mapping[int, Mapping[str, float]]) -> Table:
    """Time of every variant over that of the engine, in the same rounds."""
    names = dict.fromkeys(name for ratios in found.values() for name in ratios)
    columns = [f"prefix {prefix}" for prefix in found]
    return named_table(
        title,
        [{"variant": name, **{f"prefix {p}": ratios.get(name) for p, ratios in found.items()}} for name in names],
        formats=dict.fromkeys(columns, ".2f"),
        meanings=dict.fromkeys(columns, "median ratio within rounds"),
    )


def memory_table(title: str, note: str, found: Mapping[str, ProcessTiming]) -> Table:
    """Memory and time of variants, each in a process that compiles its program."""
    return named_table(
        title,
        [
            {
                "way": name,
                "first iteration": a.first_s,
                "an iteration": median(a.seconds),
                "peak memory": a.peak_gb,
            }
            for name, a in found.items()
        ],
        units={"first iteration": "s", "an iteration": "s", "peak memory": "GB"},
        meanings={"peak memory": "of the process, compilation included"},
        note=note,
    )


EngineFigures = Mapping[str, Mapping[int, float]]
"""Engine → prefix → figure."""


def over_prefixes(seconds: EngineFigures, memory_gb: EngineFigures, limits_s: Mapping[int, float]) -> bytes:
    """Draw time and peak memory of every engine over the prefix, with the bounds of this engine."""
    prefixes = sorted({prefix for figures in seconds.values() for prefix in figures})
    ticks = {float(prefix): str(prefix) for prefix in prefixes}

    def panel(figures: EngineFigures, bounds: list[Series], label: str, rules: list[Rule]) -> Panel:
        lines = [Series(name, x=list(by), y=list(by.values())) for name, by in figures.items()]
        return Panel(
            [*lines, *bounds],
            x_label="prompt, tokens",
            y_label=label,
            x_scale="log",
            y_scale="log",
            x_ticks=ticks,
            rules=rules,
        )

    bounds = Series(
        "bound of this engine", x=list(limits_s), y=list(limits_s.values()), line="", marker="P", colour="black"
    )
    return draw(
        [
            panel(seconds, [bounds] if limits_s else [], "an iteration, s", []),
            panel(memory_gb, [], "peak memory, GB", [Rule(y=MEMORY_LIMIT_GB)]),
        ],
        size=(8.2, 4.2),
    )


def over_steps(run: LongRun) -> bytes:
    """Draw the time of a step, median and 5th to 95th percentile of every hundred, and the memory held."""
    bins = run.seconds[: len(run.seconds) // RESIDENT_EVERY * RESIDENT_EVERY].reshape(-1, RESIDENT_EVERY)
    low, middle, high = 1e3 * np.percentile(bins, (5, 50, 95), axis=1)
    at = RESIDENT_EVERY * np.arange(1, len(bins) + 1)
    most_ms, most_mb = 1.3 * float(np.percentile(high, 95)), 1.2 * float(run.resident_mb.max())
    return draw(
        [
            Panel(
                [Series(x=at, y=middle, low=low, high=high, band=True, marker="")],
                x_label="step",
                y_label="a step, ms",
                y_limits=(0, most_ms),
            ),
            Panel(
                [Series(x=at, y=run.resident_mb, marker="")],
                x_label="step",
                y_label="memory held, MB",
                y_limits=(0, most_mb),
            ),
        ],
        size=(8.2, 3.0),
    )


def median(seconds: Sequence[float]) -> float:
    """Median as a Python float."""
    return float(np.median(seconds))
