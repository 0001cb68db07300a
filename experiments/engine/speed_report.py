"""Requirements, tables and charts of the speed of GRPO."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.results import Cell, Picture, Requirement, Table, at_least, at_most, named_table
from experiments.engine.matrix_floor import TimedProduct
from experiments.engine.peers import JobSize, PeerTimes
from experiments.engine.speed import PLAIN, REPEATED, RESIDENT_EVERY, LongRun, ProcessTiming, over_this

LIMITS_S = {64: 0.55, 512: 1.3}  # seconds an iteration may take at a prefix, on two cores of about 240 GFLOP/s

PEER_S = {("TRL", 64): 1.36, ("Tunix", 64): 1.77, ("TRL", 512): 13.1, ("Tunix", 512): 24.5}
"""Seconds of the peers on the machine for which the limits were set; elsewhere the ratio counts."""

PLAIN_RATIOS = {64: 1.47, 512: 2.15}  # least time of a plain program with a shared prefix over that of the engine

MEMORY_LIMIT_GB, MEMORY_AT = 1.0, 512  # most memory of a process, up to this prefix
PEAK_SHARE = 0.55  # least share of the speed of large products that an iteration should reach
EARLY = 1000  # steps over which time must stay constant; memory must over all
Timings = Mapping[int, ProcessTiming]  # prefix → timing
Others = Mapping[int, Mapping[str, np.ndarray]]  # prefix → program → seconds of alternating rounds
Peers = Mapping[tuple[str, int], PeerTimes]  # (Peer, prefix) → its times


def verdict(alone: Timings, others: Others, peers: Peers) -> tuple[str, ...]:
    """Time of an iteration, gain of prefixes that are encoded once, comparison with other engines."""
    times = ", ".join(f"{a.median_s:.3g} s at {prefix} tokens" for prefix, a in alone.items())
    ratios: dict[str, dict[int, float]] = {
        "A plain program that encodes it once": {p: over_this(s)[PLAIN] for p, s in others.items()},
        "Encoding the prefix again for every rollout": {p: over_this(s)[REPEATED] for p, s in others.items()},
    }
    for (name, prefix), t in peers.items():
        ratios.setdefault(name, {})[prefix] = t.median_s / alone[prefix].median_s
    factors = {name: ", ".join(f"{r:.3g} at {prefix}" for prefix, r in by.items()) for name, by in ratios.items()}
    return (
        f"One iteration, by the length of the prefix: {times}.",
        *(f"{name} takes longer by a factor of {factor}." for name, factor in factors.items()),
    )


def requirements(
    alone: Timings, first: Timings, lean: Timings, peers: Peers, long: LongRun, parser_s: float
) -> tuple[Requirement, ...]:
    """The bounds on time, memory, compilations and drift.

    `alone` read their programs from the cache, `first` compile them, `lean` compile them leanly.
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


def peak_shares(size: JobSize, alone: Timings, floors: Mapping[int, Sequence[TimedProduct]]) -> list[Requirement]:
    """Share of the speed of large products, and that of the products of these shapes alone."""
    share = lambda prefix, seconds: size.gflop(prefix) / seconds / alone[prefix].gflops_peak
    note = "{:.2f} if nothing but the products of these shapes, each timed alone, took time"
    return [
        at_least(
            f"share of the peak at prefix {prefix}",
            share(prefix, alone[prefix].median_s),
            PEAK_SHARE,
            note=note.format(share(prefix, sum(t.seconds for t in found))),
        )
        for prefix, found in floors.items()
        if prefix in LIMITS_S
    ]


def plain_ratios(others: Others, floors: Mapping[int, Sequence[TimedProduct]]) -> list[Requirement]:
    """Time of plain programs over this engine's, and over that of this engine's matrix products alone."""
    note = "{:.2f} if nothing but this engine's matrix products, each timed alone, took time"
    return [
        at_least(
            f"{name}'s time over this at prefix {prefix}",
            ratio,
            bound,
            note=note.format(np.median(others[prefix][name]) / sum(t.seconds for t in floors[prefix])),
        )
        for prefix, bound in PLAIN_RATIOS.items()
        for name, ratio in over_this(others.get(prefix, {})).items()
        if name.startswith(PLAIN)
    ]


def _time_limits(timings: Timings, how: str = "") -> list[Requirement]:
    machine = "a machine of {:.0f} GFLOP/s; the bound is for about 240 on two cores"
    return [
        at_most(f"iteration at prefix {prefix}{how}", timing.median_s, limit, "s", machine.format(timing.gflops_peak))
        for prefix, limit in LIMITS_S.items()
        if (timing := timings.get(prefix)) is not None
    ]


def steadiness(long: LongRun) -> tuple[Requirement, ...]:
    """Time and memory of late steps against early ones, and one program for all lengths."""
    early, n = long.seconds[:EARLY], len(long.seconds)
    tenth = max(1, len(early) // 10)
    drift = np.median(early[-tenth:]) / np.median(early[:tenth])
    lengths = "mean lengths of {:.1f} to {:.1f} tokens in {:,} steps".format(*long.lengths, n)
    return (
        at_most(f"time of late steps over early ones, of {len(early):,}", drift, 1.1),
        at_most(f"memory that {n:,} steps add", long.resident_mb[-1] - long.resident_mb[0], 16, "MB"),
        at_most("programs for all lengths", long.programs, 1, note=lengths),
    )


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
        formats={"share of peak": ".2f"},
        units={"prefix": "tokens", **dict.fromkeys(seconds, "s"), **dict.fromkeys(memory, "GB"), "work": "GFLOP"},
        meanings={
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
        formats={"over this": ".1f", "over this one's": ".1f", "share of peak": ".2f"},
        units={"prefix": "tokens", "an iteration": "s", "peak memory": "GB", "first iteration": "s"},
        meanings={
            "an iteration": "median",
            "over this": "its time over that of this engine",
            "over this one's": "its memory over that of this engine, which compiles too",
            "share of peak": "by the work of this engine, of the speed of large matrix products",
            "timed": "iterations",
        },
        note="; ".join(f"{name}: {text}" for name, text in versions.items()),
    )


def turns_table(title: str, others: Others) -> Table:
    """Programs that took turns with the engine, compared with it."""
    rows = [
        {"program": name, "prefix": prefix, "an iteration": float(np.median(seconds[name])), "over this": ratio}
        for prefix, seconds in others.items()
        for name, ratio in over_this(seconds).items()
    ]
    units = {"prefix": "tokens", "an iteration": "s"}
    meanings = {"an iteration": "median", "over this": "median ratio within rounds to the engine as it is"}
    return named_table(title, rows, formats={"over this": ".2f"}, units=units, meanings=meanings)


def memory_table(title: str, found: Mapping[str, ProcessTiming]) -> Table:
    """Memory and time of variants, each in a process that compiles its program."""
    rows = [
        {"variant": name, "first iteration": a.first_s, "an iteration": a.median_s, "peak memory": a.peak_gb}
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


EngineFigures = Mapping[str, Mapping[int, float]]  # engine → prefix → figure


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


def over_steps(run: LongRun) -> bytes:
    """Draw the time of a step, median and 5th to 95th percentile of every hundred, and the resident memory."""
    bins = run.seconds[: len(run.seconds) // RESIDENT_EVERY * RESIDENT_EVERY].reshape(-1, RESIDENT_EVERY)
    low, middle, high = 1e3 * np.percentile(bins, (5, 50, 95), axis=1)
    at = RESIDENT_EVERY * np.arange(1, len(bins) + 1)
    most_ms, most_mb = 1.3 * float(np.percentile(high, 95)), 1.2 * float(run.resident_mb.max())
    times = Series(x=at, y=middle, low=low, high=high, band=True, marker="")
    memory = Series(x=at, y=run.resident_mb, marker="")
    panels = [
        Panel([times], x_label="step", y_label="a step, ms", y_limits=(0, most_ms)),
        Panel([memory], x_label="step", y_label="resident memory, MB", y_limits=(0, most_mb)),
    ]
    return draw(panels, size=(8.2, 3.0))
