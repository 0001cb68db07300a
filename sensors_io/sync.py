"""Times of several devices on one clock: device stamps mapped to host stamps, lost samples counted.

A host stamp is late by whatever the bus and the scheduler took, a device stamp is on time on a clock of its own.  The
smallest difference of the two seen lately is that of a sample which nothing held up:

    t̂(n) = device(n) + min over the last W seconds of (host − device)

The window makes the minimum follow a clock that runs fast or slow: at a skew of s the error grows to s · W, 0.5 ms at
50 ppm and 10 s, and no further.  (Zhang, Liu and Xia, INFOCOM 2002, fit a line below the differences; over ten seconds
that gains less than the delay of the least delayed sample.)
"""

import collections
import dataclasses
from typing import NamedTuple

from sensors_io.clock import NS_PER_S


class ClockMap:
    """Maps the stamps of one device to the host's clock by the running minimum of their difference.

    A clock stands still or runs slow if, within a second, it fell behind by over 3 % and all samples came over ¼ s late
    by it.  Samples then have the time of their arrival, until one came sooner and its time is not before the last.  One
    whose stamp first came over 20 ms ago has it too.

    Args:
      window_s: how long a difference is remembered.
    """

    _LATE_NS, _BEHIND_NS = NS_PER_S // 4, NS_PER_S * 3 // 100
    _STANDS_NS = NS_PER_S // 50  # the clock of Windows counts by 15.6 ms

    def __init__(self, window_s: float = 10.0):
        if window_s <= 0:
            raise ValueError(f"window_s is {window_s}: must be > 0; 10 s suits clocks that differ by 50 ppm")
        self._window_ns = round(window_s * NS_PER_S)
        self._rising: collections.deque[tuple[int, int]] = collections.deque()  # (host, difference), both ascending
        self._last_device_ns: int | None = None
        self._stamp_came_ns = 0  # for the first time
        self._second: _Second | None = None
        self._arrived_ns: int | None = None  # the time of the last sample, if it is that of its arrival
        self.restarts = 0
        self.slow = False

    def to_host_ns(self, device_ns: int, host_ns: int, *, late: bool = False) -> int:
        """When a sample was taken, on the host's clock; never after it arrived.

        Args:
          device_ns: stamp of the sample on the device's clock; one that goes back says that the device restarted.
          host_ns: when it arrived; must not decrease from call to call.
          late: by its number it was taken before the last one, so that its stamp may go back.
        """
        if late and self._rising:
            return host_ns if self.slow else min(device_ns + self._rising[0][1], host_ns)
        if self._last_device_ns is not None and device_ns < self._last_device_ns:
            self._rising.clear()
            self._second, self.slow = None, False
            self.restarts += 1
        if device_ns != self._last_device_ns:
            self._last_device_ns, self._stamp_came_ns = device_ns, host_ns
        stands = host_ns - self._stamp_came_ns > self._STANDS_NS
        difference = host_ns - device_ns
        while self._rising and self._rising[-1][1] >= difference:
            self._rising.pop()
        self._rising.append((host_ns, difference))
        while self._rising[0][0] < host_ns - self._window_ns:
            self._rising.popleft()
        self._judge(difference, host_ns)
        taken_ns = device_ns + self._rising[0][1]
        if stands or self.slow or (self._arrived_ns is not None and taken_ns < self._arrived_ns):
            self._arrived_ns = host_ns
            return host_ns
        self._arrived_ns = None
        return taken_ns

    def _judge(self, difference_ns: int, host_ns: int) -> None:
        """Judge the clock at the end of each second without a pause; a link that is late falls behind once only."""
        late_ns, second = difference_ns - self._rising[0][1], self._second
        if second is None or host_ns - second.last_ns > NS_PER_S:
            self._second = _Second(host_ns, host_ns, difference_ns, late_ns)
            return
        least = min(second.least_ns, late_ns)
        self._second = second._replace(last_ns=host_ns, least_ns=least)
        if host_ns - second.began_ns >= NS_PER_S:
            fell_behind = difference_ns - second.difference_ns > self._BEHIND_NS
            self.slow = least > self._LATE_NS and (self.slow or fell_behind)
            self._second = _Second(host_ns, host_ns, difference_ns, late_ns)


class _Second(NamedTuple):
    """Arrival of the first and of the last sample of a second, the first one's difference, and the least delay."""

    began_ns: int
    last_ns: int
    difference_ns: int
    least_ns: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class CounterStep:
    """Relation of one sample to those before it.

    Args:
      missing: samples that never came between the last one and this; −1 takes back one that was counted in error.
      duplicate: it was seen before.
      late: it had been counted as missing.
      restarted: the device counts from the beginning again, so that its counter does not show what was lost.
    """

    missing: int = 0
    duplicate: bool = False
    late: bool = False
    restarted: bool = False


_NEXT = CounterStep()


class IndexGaps:
    """Finds lost, repeated and late samples by the device's own counter."""

    REMEMBERED = 1024
    """Longest delay of a sample: half a second of a force sensor at 2 kHz, half a minute of a camera."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._missing: collections.OrderedDict[int, None] = collections.OrderedDict()

    def step(self, index: int, *, reopened: bool = False) -> CounterStep:
        """Take the counter of the next sample into account.

        Args:
          index: the counter.
          reopened: the device was opened anew since the last sample: a counter that goes back says that it restarted.
        """
        if self._last is None:
            self._last = index
            return _NEXT
        ahead = index - self._last
        if ahead >= 1:
            self._remember(self._last + 1, ahead - 1)
            self._last = index
            return _NEXT if ahead == 1 else CounterStep(missing=ahead - 1)
        if ahead and (reopened or -ahead >= self.REMEMBERED):
            self._missing.clear()
            self._last = index
            return CounterStep(restarted=True)
        if index in self._missing:
            del self._missing[index]
            return CounterStep(late=True)
        return CounterStep(duplicate=True)

    def _remember(self, first: int, count: int) -> None:
        for k in range(first + max(0, count - self.REMEMBERED), first + count):
            self._missing[k] = None
        while self._missing and first + count - next(iter(self._missing)) > self.REMEMBERED:
            self._missing.popitem(last=False)


class PeriodGaps:
    """Estimates the lost samples of a device without a counter from its stamps.

    A loop follows phase φ and period T of the stamps; a sample at t is number k = round((t − φ) / T) after the last:

        e = t − φ − k T,   φ ← φ + k T + e / 8,   T ← T + e / (256 k)

    so that a sample that is more than half a period late counts one as missing, and the next, on time, takes it back.
    Samples that come early while none is counted as missing are extra: more than a second of them say that the device
    sends faster than its period.

    Args:
      period_ns: time between two samples, to 5 %.
    """

    _PHASE_GAIN = 1 / 8  # of eight samples' error: one late sample hardly moves the phase
    _PERIOD_GAIN = 1 / 256  # critically damped: a quarter of the square of the phase gain
    _DRIFT = 0.05

    def __init__(self, period_ns: int):
        if period_ns <= 0:
            raise ValueError(f"period_ns is {period_ns}: must be > 0; give 10⁹ over the frame rate")
        self._nominal_ns = self._period_ns = float(period_ns)
        self._phase_ns: float | None = None
        self._counted = 0  # as missing, less those taken back; of the last second, for no sample is held up for longer
        self._early = self._extra = 0  # samples that came early and took back none: since the last on time, and ever

    @property
    def fast(self) -> bool:
        """True if the device has sent a second of samples more than its period gives."""
        return self._extra * self._nominal_ns > NS_PER_S

    def shift(self, by_ns: int) -> None:
        """Take note that the clock of the stamps was set forward by so much since the last sample."""
        if self._phase_ns is not None:
            self._phase_ns += by_ns

    def step(self, time_ns: int) -> CounterStep:
        """Take the stamp of the next sample into account."""
        if self._phase_ns is None:
            self._phase_ns = float(time_ns)
            return _NEXT
        count = round((time_ns - self._phase_ns) / self._period_ns)
        error = time_ns - self._phase_ns - count * self._period_ns
        self._phase_ns += count * self._period_ns + self._PHASE_GAIN * error
        if count == 1:
            period = self._period_ns + self._PERIOD_GAIN * error
            self._period_ns = min(
                max(period, self._nominal_ns * (1 - self._DRIFT)), self._nominal_ns * (1 + self._DRIFT)
            )
            self._early = 0
            return _NEXT
        if count < 1:
            missing = -min(1, self._counted)
            came_early = 1 + missing
        else:
            came_early = -min(count - 1, self._early)  # behind samples that came early there is a gap
            missing = count - 1 + came_early
        self._early += came_early
        self._extra += came_early
        self._counted = min(self._counted + missing, max(1, round(NS_PER_S / self._nominal_ns)))
        return CounterStep(missing=missing)
