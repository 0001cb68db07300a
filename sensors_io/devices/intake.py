"""Samples between a device and its consumer: a ring that counts whatever is lost, and the modes of reading from it.

    next(timeout)      the oldest sample that nobody has read: nothing is skipped unless the ring overflowed
    drain()            all unread samples at once
    fresh(timeout)     a sample that was grabbed after the call
    latest(max_age)    the newest sample at once, or an error if it is too old

The balance `arrived = duplicates + delivered + overwritten + waiting` holds at every moment; `missing` are samples that
never arrived, by the device's counter, or estimated by its period where it has no counter.
"""

import collections
import dataclasses
import threading
import time
import warnings
from collections.abc import Callable

import numpy as np

from sensors_io.clock import NS_PER_S, Clock
from sensors_io.devices.base import HELD_NS, Identity, Sample
from sensors_io.devices.errors import (
    DeviceError,
    DeviceTimeoutError,
    OverloadWarning,
    StaleFrameError,
    WrongRateWarning,
)
from sensors_io.sync import ClockMap, CounterStep, IndexGaps, PeriodGaps

_REPEATED_NS = NS_PER_S // 4  # for which all numbers were seen before: the counter began anew
_STANDS_NS = NS_PER_S // 4  # for which all stamps were the same: the clock stands still, and is not coarse
_CLOCK_SET_NS = 10 * NS_PER_S  # between two clocks since the last sample: no buffer holds one back for so long


@dataclasses.dataclass(kw_only=True)
class Counts:
    """Counts of all samples by their fate.

    Args:
      arrived: handed over by the device.
      duplicates: arrived twice and were dropped.
      delivered: read by the consumer in order.
      overwritten: pushed out of the full ring unread.
      waiting: in the ring now.
      missing: never arrived, less those that arrived broken; `missing_away` of them while the device was disconnected.
      late: arrived after they had been counted as missing, and are no longer.
      broken: left out because they broke the protocol.
      disconnects, reconnects, timeouts: how often.
      restarts: the device's counter began anew; what was lost then is estimated by its period if that is known.
    """

    arrived: int = 0
    duplicates: int = 0
    delivered: int = 0
    overwritten: int = 0
    waiting: int = 0
    missing: int = 0
    missing_away: int = 0
    late: int = 0
    broken: int = 0
    disconnects: int = 0
    reconnects: int = 0
    timeouts: int = 0
    restarts: int = 0

    @property
    def unaccounted(self) -> int:
        """Samples that arrived and went nowhere; not 0 is a bug."""
        return self.arrived - self.duplicates - self.delivered - self.overwritten - self.waiting

    @property
    def lost(self) -> int:
        """Samples that the consumer will never see."""
        return self.missing + self.overwritten + self.broken


class Intake:
    """The ring and its books; one thread offers, others read.

    Args:
      capacity: samples kept for a consumer that reads in order.
      clock: what `latest` measures age by.
    """

    def __init__(self, *, capacity: int, clock: Clock):
        if capacity < 1:
            raise ValueError(f"capacity is {capacity}: must be ≥ 1; keep a second of samples or more")
        self._ring: collections.deque[Sample] = collections.deque()
        self._capacity = capacity
        self._clock = clock
        self._changed = threading.Condition()
        self._counts = Counts()
        self._newest: Sample | None = None
        self._error: DeviceError | None = None
        self._clock_map = ClockMap()
        self._device = "a device"
        self._index_gaps = IndexGaps()
        self._period_gaps: PeriodGaps | None = None
        self._period_ns: int | None = None
        self._stamps: tuple[int, int] | None = None  # of a last sample, on the device's clock and on the host's
        self._repeated_ns: int | None = None  # arrival of the first repeated number since the last new one
        self._away = self._told_fast = self._overtaken = self._back = False
        self._broken_since = 0  # the last whole sample
        self._warned_at = 0

    def opened(self, identity: Identity) -> None:
        """Take note that the device was opened, for the first time or again."""
        with self._changed:
            self._device = f"{identity.sensor} {identity.serial}".strip()
            if self._away:
                self._counts.reconnects += 1
            else:
                period = identity.period_s
                self._period_ns = None if period is None else round(period * NS_PER_S)
                self._period_gaps = None if self._period_ns is None else PeriodGaps(self._period_ns)

    def lost(self) -> None:
        """Take note that the device was lost."""
        with self._changed:
            self._counts.disconnects += 1
            self._away = True

    def timed_out(self) -> None:
        """Take note that the device gave nothing in time."""
        with self._changed:
            self._counts.timeouts += 1

    def broke(self) -> None:
        """Take note of a sample that broke the protocol."""
        with self._changed:
            self._counts.broken += 1
            self._broken_since += 1

    def fail(self, error: DeviceError) -> None:
        """End the stream: readers get what is in the ring, then this error."""
        with self._changed:
            self._error = error
            self._changed.notify_all()

    def offer(self, sample: Sample) -> None:
        """Put a sample into the ring, unless it was seen before."""
        with self._changed:
            counts = self._counts
            counts.arrived += 1
            if self._seen_before(sample):
                counts.duplicates += 1
                return
            sample = self._on_host_clock(sample)
            self._newest = sample
            self._ring.append(sample)
            if len(self._ring) > self._capacity:
                self._ring.popleft()
                counts.overwritten += 1
            counts.waiting = len(self._ring)
            self._changed.notify_all()

    def next(self, timeout_s: float) -> Sample:
        """The oldest unread sample; warns with `OverloadWarning` when some were overwritten since the last warning.

        Raises:
          DeviceTimeoutError: none came in time.
          DeviceError: the stream has ended, for the reason that it says.
        """
        with self._changed:
            self._wait(lambda: len(self._ring) > 0, timeout_s)
            sample = self._ring.popleft()
            self._counts.delivered += 1
            self._counts.waiting = len(self._ring)
        self._warn()
        return sample

    def drain(self) -> list[Sample]:
        """All unread samples at once, oldest first; none if none has come.  Warns as `next` does.

        Raises:
          DeviceError: the stream has ended and everything has been read.
        """
        with self._changed:
            if not self._ring and self._error is not None:
                raise self._error
            samples = list(self._ring)
            self._ring.clear()
            self._counts.delivered += len(samples)
            self._counts.waiting = 0
        self._warn()
        return samples

    def fresh(self, timeout_s: float) -> Sample:
        """A sample that was grabbed after this call, for one who acts and then looks; it stays in the ring.

        Raises:
          DeviceTimeoutError, DeviceError: as for `next`.
        """
        asked_ns = self._clock.now_ns()
        with self._changed:
            self._wait(lambda: self._newest is not None and self._newest.host_time_ns >= asked_ns, timeout_s)
            assert self._newest is not None
            return self._newest

    def latest(self, max_age_s: float) -> Sample:
        """The newest sample at once; it stays in the ring.

        Raises:
          StaleFrameError: it is older than `max_age_s`, or there is none yet.
        """
        with self._changed:
            newest = self._newest
        if newest is None:
            raise StaleFrameError("no sample has arrived yet; wait for the first with `fresh`")
        age_s = (self._clock.now_ns() - newest.host_time_ns) / NS_PER_S
        if age_s > max_age_s:
            raise StaleFrameError(
                f"the newest sample is {age_s:.3f} s old: at most {max_age_s} s were asked for; "
                "look whether the device is connected, or allow more"
            )
        return newest

    @property
    def counts(self) -> Counts:
        """A copy of the counts up to now."""
        with self._changed:
            return dataclasses.replace(self._counts)

    @property
    def overloaded(self) -> bool:
        """True if the consumer is more than half of the ring buffer behind."""
        return len(self._ring) > self._capacity // 2

    def _warn(self) -> None:
        """Sound the alarm if samples were overwritten since it last did."""
        with self._changed:
            overwritten, self._warned_at = self._counts.overwritten - self._warned_at, self._counts.overwritten
        if overwritten:
            warnings.warn(
                f"{overwritten} samples were overwritten unread: the consumer is slower than the device; "
                "read with `latest`, or do less per sample",
                OverloadWarning,
                stacklevel=4,
            )

    def _wait(self, ready: Callable[[], bool], timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while not ready():
            if self._error is not None:
                raise self._error
            left = deadline - time.monotonic()
            if left <= 0:
                raise DeviceTimeoutError(f"no sample in {timeout_s} s; look whether the device is connected")
            self._changed.wait(left)

    def _seen_before(self, sample: Sample) -> bool:
        """Count what is missing before this sample; whether it is a duplicate itself."""
        if sample.index is None and self._same_picture(sample):
            return True
        step = self._step(sample)
        if step.duplicate:
            return True
        counts = self._counts
        counts.restarts += step.restarted
        counts.late += step.late
        self._overtaken = step.late and self._goes_on(sample)
        if step.restarted or (self._away and not self._goes_on(sample)):  # its clock may have begun anew too
            self._clock_map = ClockMap()
        broken, self._broken_since = min(self._broken_since, max(step.missing, 0)), 0
        # a period takes back what it counted as missing, also one that is counted as broken by now
        counts.missing = max(0, counts.missing + step.missing - step.late - broken)
        if self._away:
            counts.missing_away += max(0, step.missing)
            self._away = False
        return False

    def _step(self, sample: Sample) -> CounterStep:
        """By the counter; by the period where there is none, or where it restarted."""
        by_index = CounterStep(restarted=True)
        if sample.index is not None:
            by_index = self._index_gaps.step(sample.index, reopened=self._away)
            if by_index.duplicate:
                since = self._repeated_ns = sample.host_time_ns if self._repeated_ns is None else self._repeated_ns
                if sample.host_time_ns - since > _REPEATED_NS:
                    by_index = self._index_gaps.step(sample.index, reopened=True)
            if not (by_index.duplicate or by_index.late):
                self._repeated_ns = None
        if self._period_gaps is None or by_index.duplicate or by_index.late:
            return by_index if sample.index is not None else CounterStep()
        anew = by_index.restarted and sample.index is not None
        by_period = self._by_period(self._period_gaps, sample, anew)
        if sample.index is None and self._period_gaps.fast and not self._told_fast:
            self._told_fast = True
            warnings.warn(
                f"{self._device} sends faster than the {NS_PER_S / (self._period_ns or 1):.3g} Hz that it states, by "
                "which its losses are counted: they are counted too low; state the rate at which it sends (--rate-hz)",
                WrongRateWarning,
                stacklevel=3,
            )
        if not by_index.restarted:
            return by_index
        return dataclasses.replace(by_period, restarted=anew)

    def _by_period(self, gaps: PeriodGaps, sample: Sample, anew: bool) -> CounterStep:
        """By the stamps, whose steps over a clock that was set, or began anew, are those of the host's."""
        host = sample.host_time_ns
        stamp = host if sample.device_time_ns is None else sample.device_time_ns
        last = self._stamps
        if last is not None and stamp == last[0] and not self._back and host - last[1] <= _STANDS_NS:
            return gaps.step(stamp)
        self._stamps = (stamp, host)
        if last is not None:
            moved = (stamp - last[0]) - (host - last[1])
            back = stamp <= last[0]
            if anew or back or self._back or abs(moved) > _CLOCK_SET_NS:  # after one wrong stamp comes a right one
                gaps.shift(moved)
            self._back = back
        return gaps.step(stamp)

    def _goes_on(self, sample: Sample) -> bool:
        """True if number and stamp went on, or back, by as many periods: neither counter nor clock began anew."""
        last = self._newest
        if last is None or self._period_ns is None or sample.device_time_ns is None or last.device_time_ns is None:
            return False
        since_ns = sample.device_time_ns - last.device_time_ns
        if sample.host_time_ns - last.host_time_ns - since_ns > HELD_NS:
            return False
        if sample.index is None or last.index is None:
            return since_ns > 0
        steps = sample.index - last.index
        return abs(since_ns - steps * self._period_ns) <= self._period_ns * (1 + abs(steps) / 20)

    def _same_picture(self, sample: Sample) -> bool:
        """True if a picture without a counter repeats the last one: sensor noise never repeats itself."""
        last = self._newest
        if last is None or last.frame is None or sample.frame is None or last.frame.shape != sample.frame.shape:
            return False
        row = sample.frame.shape[0] // 2
        if not np.array_equal(sample.frame[row], last.frame[row]):  # spares comparing all of nearly every picture
            return False
        return np.array_equal(sample.frame, last.frame)

    def _on_host_clock(self, sample: Sample) -> Sample:
        if sample.device_time_ns is None:
            return sample
        before = self._clock_map.slow
        mapped = self._clock_map.to_host_ns(sample.device_time_ns, sample.host_time_ns, late=self._overtaken)
        if self._clock_map.slow and not before:
            warnings.warn(
                f"{self._device}: its stamps fall behind this machine's clock, and its samples come late by them: they "
                "are timed by their arrival; look at the clock of its program, and at the link",
                WrongRateWarning,
                stacklevel=3,
            )
        return dataclasses.replace(sample, host_time_ns=mapped)
