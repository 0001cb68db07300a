"""A recording as a device: at its true rate or in compressed time, with faults that a seed decides.

What was injected is counted in `Replay.truth`, so that a reader's counts can be compared with it.
"""

import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Self

import numpy as np

from sensors_io.clock import NS_PER_S, Clock, MonotonicClock
from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import (
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    StreamEndedError,
)
from sensors_io.devices.sources import Recorded, SampleSource, source_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class Disconnect:
    """A time during which the device is gone; it goes on producing samples that nobody gets."""

    at_s: float
    for_s: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults that a replay injects between device and reader.

    Args:
      drop_share: samples that never arrive.
      duplicate_share: samples that arrive twice.
      jitter_s: mean of an exponential delay of arrival; the order is kept.
      disconnects: ascending, not overlapping.
      skew: the device's clock gains this share on the host's; 5e-5 is 50 ppm.
      hide_counter, hide_clock: give samples without the device's counter, or without its stamps.
      seed: of all draws.
    """

    drop_share: float = 0.0
    duplicate_share: float = 0.0
    jitter_s: float = 0.0
    disconnects: tuple[Disconnect, ...] = ()
    skew: float = 0.0
    hide_counter: bool = False
    hide_clock: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("drop_share", "duplicate_share"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: must lie in 0 ≤ {name} < 1; correct it")
        for name in ("jitter_s", "seed"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be ≥ 0; correct it")
        ends = [-np.inf, *(d.at_s + d.for_s for d in self.disconnects)]
        if any(d.for_s <= 0 or d.at_s < end for d, end in zip(self.disconnects, ends, strict=False)):
            raise ValueError(f"disconnects is {self.disconnects}: must be ascending and apart; sort them")


@dataclasses.dataclass(kw_only=True)
class Truth:
    """True counts of a replay in samples: `produced = given + dropped + away` once it has ended.

    Args:
      produced: by the device.
      given: read at least once; `duplicated` of them twice.
      dropped: by chance; `away`: while disconnected.
      unseen: of the dropped and away, those before the first given sample or after the last: no counter shows them.
      disconnects: how often the device went away.
    """

    produced: int = 0
    given: int = 0
    duplicated: int = 0
    dropped: int = 0
    away: int = 0
    unseen: int = 0
    disconnects: int = 0


class Replay:
    """Replays a source as a device.

    Args:
      source: what is replayed, again and again.
      seconds: for how long; `None` once from beginning to end.
      faults: what goes wrong.
      clock: a `JumpingClock` compresses time.
    """

    _CLOCK_AHEAD_NS = 987_654_321  # of the device's clock: nobody may take it for the host's

    def __init__(
        self,
        source: SampleSource,
        *,
        seconds: float | None = None,
        faults: Faults | None = None,
        clock: Clock | None = None,
    ):
        self._source = source
        self._end_ns = None if seconds is None else round(seconds * NS_PER_S)
        self._faults = faults or Faults()
        self._clock = clock or MonotonicClock()
        self._rng = np.random.default_rng(self._faults.seed)
        self._start_ns: int | None = None
        self._upcoming = self._timeline()
        self._pending: tuple[int, Sample] | None = None
        self._again: tuple[int, Sample] | None = None
        self._away = iter(self._faults.disconnects)
        self._next_away = next(self._away, None)
        self._before_first = 0
        self.truth = Truth()

    @property
    def identity(self) -> Identity:
        """That of the device which recorded the source."""
        return self._source.identity

    def __enter__(self) -> Self:
        now_ns = self._clock.now_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        elapsed_s = (now_ns - self._start_ns) / NS_PER_S
        away = self._next_away
        if away is not None and elapsed_s >= away.at_s:
            if elapsed_s < away.at_s + away.for_s:
                raise DeviceNotFoundError(f"{self.identity.where} is disconnected for {away.for_s} s; wait")
            self._next_away = next(self._away, None)
            self._skip_until(now_ns)
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    def read(self, timeout_s: float) -> Sample:
        """The next sample, when its time has come, see `Device.read`."""
        if self._start_ns is None:
            raise DeviceLostError(f"{self.identity.where} is not open; use it in a with block")
        due = self._due()
        lost_ns = self._lost_ns()
        if lost_ns is not None and due[0] >= lost_ns:
            self._clock.sleep_until(lost_ns)
            self._again = None
            self.truth.disconnects += 1
            raise DeviceLostError(f"{self.identity.where} was disconnected")
        deadline_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        if due[0] > deadline_ns:
            self._clock.sleep_until(deadline_ns)
            raise DeviceTimeoutError(f"{self.identity.where} gave no sample in {timeout_s} s")
        self._clock.sleep_until(due[0])
        self._take()
        return dataclasses.replace(due[1], host_time_ns=self._clock.now_ns())

    def _due(self) -> tuple[int, Sample]:
        """Arrival and content of the next sample that is not dropped."""
        if self._again is not None:
            return self._again
        while self._pending is None:
            arrival = next(self._upcoming, None)
            if arrival is None:
                raise StreamEndedError(f"{self.identity.where} has been replayed to its end")
            self.truth.produced += 1
            if self._rng.random() < self._faults.drop_share:
                self.truth.dropped += 1
                self.truth.unseen += 1
            else:
                self._pending = arrival
        return self._pending

    def _take(self) -> None:
        if self._again is not None:
            self._again = None
            self.truth.duplicated += 1
            return
        if self.truth.given:
            self.truth.unseen = self._before_first
        else:
            self._before_first = self.truth.unseen
        self.truth.given += 1
        if self._rng.random() < self._faults.duplicate_share:
            self._again = self._pending
        self._pending = None

    def _skip_until(self, now_ns: int) -> None:
        """Lose what was produced while the device was away, dropped or not."""
        while True:
            if self._pending is None:
                self._pending = next(self._upcoming, None)
                if self._pending is None:
                    return
                self.truth.produced += 1
            if self._pending[0] >= now_ns:
                return
            self._pending = None
            self.truth.away += 1
            self.truth.unseen += 1

    def _lost_ns(self) -> int | None:
        if self._next_away is None or self._start_ns is None:
            return None
        return self._start_ns + round(self._next_away.at_s * NS_PER_S)

    def _timeline(self) -> Iterator[tuple[int, Sample]]:
        """Arrival on the host's clock and content of all samples, round after round."""
        assert self._start_ns is not None  # a generator starts when it is first asked, after the device was opened
        arrival_ns = shift_ns = base = 0
        while True:
            last_ns = previous_ns = 0
            first = last = None
            for recorded in self._source.samples():
                time_ns = shift_ns + recorded.time_ns
                if self._end_ns is not None and time_ns >= self._end_ns:
                    return
                delay = self._rng.exponential(self._faults.jitter_s) if self._faults.jitter_s else 0.0
                arrival_ns = max(arrival_ns, time_ns + round(delay * NS_PER_S))
                first = recorded.index if first is None else first
                last = recorded.index
                yield self._start_ns + arrival_ns, self._sample(recorded, time_ns, base)
                previous_ns, last_ns = last_ns, recorded.time_ns
            if self._end_ns is None:
                return
            if first is not None and last is not None:  # the counter goes on: gaps of the recording stay gaps
                base += last + 1 - first
            period = self.identity.period_s
            round_ns = last_ns + (last_ns - previous_ns if period is None else round(period * NS_PER_S))
            if round_ns <= 0:
                raise StreamEndedError(f"{self.identity.where} lasts 0 s: cannot be repeated; leave out seconds")
            shift_ns += round_ns

    def _sample(self, recorded: Recorded, time_ns: int, base: int) -> Sample:
        f = self._faults
        index = None if recorded.index is None else recorded.index + base
        return Sample(
            host_time_ns=0,
            device_time_ns=None if f.hide_clock else self._CLOCK_AHEAD_NS + round(time_ns * (1 + f.skew)),
            index=None if f.hide_counter else index,
            frame=recorded.frame,
            arrays=recorded.arrays,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """A recording as a device, see `sources.source_of`.

    Args:
      path: of the recording.
      sensor: whose pictures they are, where the recording does not say.
      rate_hz: of pictures.
      contact: number of the contact, of records.
      seconds: > 0 repeats it for so long.
      faults: what goes wrong on the way.
    """

    path: pathlib.Path
    sensor: str = "gelsight_mini"
    rate_hz: float = 25.0
    contact: int = 0
    seconds: float = 0.0
    faults: Faults = dataclasses.field(default_factory=Faults)

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= NS_PER_S:
            raise ValueError(f"rate_hz is {self.rate_hz}: must be > 0 and ≤ 10⁹; give the rate of the recording")
        for name in ("contact", "seconds"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be ≥ 0; correct it")

    def open(self, clock: Clock | None = None) -> Replay:
        """The device, not open yet."""
        source = source_of(self.path, sensor=self.sensor, rate_hz=self.rate_hz, contact=self.contact)
        return Replay(source, seconds=self.seconds or None, faults=self.faults, clock=clock)
