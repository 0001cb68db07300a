"""Sources of time: the monotonic clock of this machine, and one that jumps, for an hour of recording in seconds."""

import threading
import time
from typing import Protocol

NS_PER_S = 1_000_000_000


class Clock(Protocol):
    """Monotonic time, and waiting for it."""

    def now_ns(self) -> int:
        """Nanoseconds since some fixed moment; never decreases."""
        ...

    def sleep_until(self, time_ns: int, wake: threading.Event | None = None) -> None:
        """Return at `time_ns`, at once if it has passed, or earlier when `wake` is set."""
        ...


class MonotonicClock:
    """`time.monotonic_ns`: on Linux the same clock for all processes, and the one that V4L2 stamps its buffers by."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until(self, time_ns: int, wake: threading.Event | None = None) -> None:
        seconds = (time_ns - time.monotonic_ns()) / NS_PER_S
        if seconds <= 0:
            return
        if wake is None:
            time.sleep(seconds)
        else:
            wake.wait(seconds)


class JumpingClock:
    """Compressed time: whoever waits moves the clock on; nobody ever waits.

    Args:
      start_ns: what it reads at first.
    """

    def __init__(self, start_ns: int = 0):
        self._now_ns = start_ns
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until(self, time_ns: int, wake: threading.Event | None = None) -> None:
        del wake
        with self._lock:
            self._now_ns = max(self._now_ns, time_ns)
