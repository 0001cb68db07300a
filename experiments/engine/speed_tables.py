"""Requirements and tables of the speed of GRPO."""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.results import Cell, Column, Requirement, Table
from experiments.engine.peers import JobSize, PeerTimes
from experiments.engine.speed import LongRun, ProcessTiming

LIMITS_S = {64: 0.55, 512: 1.3}
"""Seconds an iteration may take at a prefix, on two cores of about 240 GFLOP/s."""

PEER_S = {("TRL", 64): 1.36, ("Tunix", 64): 1.77, ("TRL", 512): 13.1, ("Tunix", 512): 24.5}
"""Seconds that peers took on the machine for which the limits were set: what counts elsewhere is the ratio."""

MEMORY_LIMIT_GB, MEMORY_AT = 1.0, 512
"""Memory that a process may take, up to this prefix."""

EARLY = 1000  # steps over which time must stay flat; memory must over all
Peers = Mapping[tuple[str, int], PeerTimes]
"""What peers measured of themselves, by name and prefix."""


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
    rows: list[tuple[Cell, ...]] = []
    for prefix, a in alone.items():
        s, gflop = median(a.seconds), size.gflop(prefix)
        times = (s, min(a.seconds), max(a.seconds))
        memory = (a.first_s, a.peak_gb, first[prefix].first_s, first[prefix].peak_gb)
        rows.append((prefix, *times, *memory, gflop, gflop / s / a.gflops_peak))
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


def peer_table(
    size: JobSize, alone: Mapping[int, ProcessTiming], first: Mapping[int, ProcessTiming], peers: Peers
) -> Table:
    """Every peer at every prefix beside this engine."""
    rows: list[tuple[Cell, ...]] = []
    for (name, prefix), p in peers.items():
        ours, s = alone[prefix], median(p.seconds)
        share = size.gflop(prefix) / s / ours.gflops_peak
        rows.append(
            (
                name,
                prefix,
                s,
                s / median(ours.seconds),
                p.peak_gb,
                p.peak_gb / first[prefix].peak_gb,
                p.first_s,
                share,
                len(p.seconds),
            )
        )
    versions = {name: ", ".join(f"{k} {v}" for k, v in p.versions.items()) for (name, _), p in peers.items()}
    return Table(
        title="Other engines on the same job",
        note="; ".join(f"{name}: {said}" for name, said in versions.items()),
        columns=(
            Column(name="engine"),
            Column(name="prefix", unit="tokens", format="d"),
            Column(name="an iteration", unit="s", meaning="median of the timed ones"),
            Column(name="over this", format=".1f", meaning="its time over that of this engine"),
            Column(name="peak memory", unit="GB", meaning="of its process"),
            Column(name="over this one's", format=".1f", meaning="that of this engine's process, which compiles too"),
            Column(name="first iteration", unit="s"),
            Column(name="share of peak", format=".2f", meaning="the work that this engine needs, over its time"),
            Column(name="timed", format="d"),
        ),
        rows=tuple(rows),
    )


def compare_table(title: str, found: Mapping[int, Mapping[str, float]]) -> Table:
    """Time of every variant over that of the engine, in the same rounds."""
    names = list(dict.fromkeys(name for ratios in found.values() for name in ratios))
    return Table(
        title=title,
        columns=(
            Column(name="variant"),
            *(Column(name=f"prefix {p}", format=".2f", meaning="median ratio within rounds") for p in found),
        ),
        rows=tuple((name, *(ratios.get(name) for ratios in found.values())) for name in names),
    )


def memory_table(title: str, note: str, found: Mapping[str, ProcessTiming]) -> Table:
    """Memory and time of ways to do the same, each in a process that compiles its program."""
    return Table(
        title=title,
        note=note,
        columns=(
            Column(name="way"),
            Column(name="first iteration", unit="s"),
            Column(name="an iteration", unit="s"),
            Column(name="peak memory", unit="GB", meaning="of the process, compilation included"),
        ),
        rows=tuple((name, a.first_s, median(a.seconds), a.peak_gb) for name, a in found.items()),
    )


def median(seconds: Sequence[float]) -> float:
    """Median as a Python float."""
    return float(np.median(seconds))
