"""A camera replayed in compressed time: the reader's counts compared with the faults that were injected."""

import dataclasses
import threading
import tracemalloc
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from experiments.core.progress import ProgressCallback
from sensors_io.clock import NS_PER_S, JumpingClock
from sensors_io.devices.base import Identity
from sensors_io.devices.intake import Counts, Intake
from sensors_io.devices.reader import Pump, ReaderConfig
from sensors_io.devices.replay import Faults, Replay, Truth
from sensors_io.devices.sources import Recorded

_PAGE_MB = 4096 / 1e6  # of Linux, in which /proc counts a process's memory
_PICTURES = 100_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class NoiseCamera:
    """A source of pictures of noise, no two of 100,000 alike: each begins elsewhere in one long noise."""

    rate_hz: float
    size_px: tuple[int, int]
    arrays: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)  # given with every picture

    @property
    def identity(self) -> Identity:
        return Identity(sensor="gelsight_mini", serial="loop", where="loop", period_s=1 / self.rate_hz)

    def samples(self) -> Iterator[Recorded]:
        shape = (*self.size_px, 3)
        size = int(np.prod(shape))
        noise = np.random.default_rng(0).integers(0, 256, size + _PICTURES, dtype=np.uint8)
        for i in range(_PICTURES):
            frame = noise[i : i + size].reshape(shape)
            yield Recorded(time_ns=round(i * NS_PER_S / self.rate_hz), index=i, frame=frame, arrays=self.arrays)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayOutcome:
    """One replay: faults of the device, counts of the reader, lateness of the stamps, memory."""

    truth: Truth  # of the device
    counts: Counts  # of the reader
    late_s: np.ndarray  # of the samples' host stamps after the true times, [3]: median, 99th percentile, largest
    gained_mb: float  # memory of the process from the first tenth of the time to the end
    gained_kb: float  # the same of Python, where it was traced

    @property
    def wrong(self) -> dict[str, int]:
        """Each count minus the truth: all 0 if every loss was found."""
        t, c = self.truth, self.counts
        return {
            "missing": c.missing - (t.dropped + t.away - t.unseen),
            "duplicates": c.duplicates - t.duplicated,
            "arrived": c.arrived - (t.given + t.duplicated),
            "disconnects": c.disconnects - t.disconnects,
            "reconnects": c.reconnects - t.disconnects,
            "produced": t.produced - (t.given + t.dropped + t.away),
            "unaccounted": c.unaccounted,
        }


def replay_camera(
    source: NoiseCamera,
    seconds: float,
    faults: Faults,
    *,
    capacity: int,
    every: int = 1,
    traced: bool = False,
    report: ProgressCallback = lambda done_s, all_s: None,
) -> ReplayOutcome:
    """Replay a camera through the package's reader.

    The consumer visits every so many samples and reads half of the ring each time; with many, a small ring overflows.
    Tracing Python's memory takes twice the time.
    """
    clock = JumpingClock()
    replay = Replay(source, seconds=seconds, faults=faults, clock=clock)
    intake = Intake(capacity=capacity, clock=clock)
    pump = Pump(replay, intake, ReaderConfig(capacity=capacity), clock, threading.Event())
    late, tenths, visits, first = _Lateness(source.rate_hz), 0, 0, (0.0, 0.0)
    if traced:
        tracemalloc.start()
    pump.open()
    while pump.step():
        visits += 1
        if visits % every == 0:
            for _ in range(min(intake.counts.waiting, max(1, capacity // 2))):
                late.add(intake.next(0.0).host_time_ns)
        if (now_s := clock.now_ns() / NS_PER_S) >= tenths * seconds / 10:
            first = _memory() if tenths == 1 else first
            tenths += 1
            report(round(now_s), round(seconds))
    while intake.counts.waiting:
        intake.next(0.0)
    last = _memory()
    if traced:
        tracemalloc.stop()
    report(round(seconds), round(seconds))
    return ReplayOutcome(
        truth=replay.truth,
        counts=intake.counts,
        late_s=late.quantiles_s(),
        gained_mb=last[0] - first[0],
        gained_kb=last[1] - first[1],
    )


class _Lateness:
    """Histogram of the time from the last tick of the device's true clock to a stamp, in bounded memory."""

    _BINS = np.linspace(0, 1, 2001)

    def __init__(self, rate_hz: float):
        self._period_ns = NS_PER_S / rate_hz
        self._histogram = np.zeros(len(self._BINS), np.int64)

    def add(self, stamp_ns: int) -> None:
        phase = (stamp_ns / self._period_ns) % 1.0
        self._histogram[int(phase * (len(self._BINS) - 1))] += 1

    def quantiles_s(self) -> np.ndarray:
        share = np.cumsum(self._histogram) / max(1, self._histogram.sum())
        return self._BINS[np.searchsorted(share, (0.5, 0.99, 1.0 - 1e-12))] * self._period_ns / NS_PER_S


def _memory() -> tuple[float, float]:
    """Resident memory of the process, MB, and Python's own as far as it is traced, kB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * _PAGE_MB, tracemalloc.get_traced_memory()[0] / 1e3
