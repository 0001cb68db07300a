"""A device with a thread around it: it is read without pause, reconnected when it is lost, and never lost count of."""

import dataclasses
import threading
from typing import Self

from sensors_io.clock import NS_PER_S, Clock, MonotonicClock
from sensors_io.devices.base import Device, Identity, Sample
from sensors_io.devices.errors import (
    DeviceDataError,
    DeviceError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    StreamEndedError,
)
from sensors_io.devices.intake import Counts, Intake

_SILENT_PERIODS = 3  # of a slow device: it may drop a sample or two without being lost


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReaderConfig:
    """Settings of a reader.

    Args:
      capacity: samples kept for a consumer that reads in order.
      timeout_s: how long one read waits; also how long stopping may take.
      lost_after_s: a device silent for longer, and for three periods of its own, is taken as lost.
      first_s: instead of it, until a device that was just opened gives its first sample.
      first_wait_s, longest_wait_s: between attempts to reconnect, doubling from the first to the longest.
      give_up_after_s: of attempts in vain.
    """

    capacity: int = 256
    timeout_s: float = 0.2
    lost_after_s: float = 0.6
    first_s: float = 5.0
    first_wait_s: float = 0.1
    longest_wait_s: float = 5.0
    give_up_after_s: float = 120.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value <= 0:
                raise ValueError(f"{field.name} is {value}: must be > 0; raise it")


class Pump:
    """Moves samples from a device into an intake, one a call; reconnects with back-off.

    It works in the caller's thread, so that a replay in compressed time can be pumped without any.
    """

    def __init__(self, device: Device, intake: Intake, config: ReaderConfig, clock: Clock, stop: threading.Event):
        self._device = device
        self._intake = intake
        self._config = config
        self._clock = clock
        self._stop = stop
        self._heard_ns = clock.now_ns()
        self._silent_s = config.first_s

    def open(self) -> None:
        """Open the device for the first time.

        Raises:
          DeviceNotFoundError: it is absent.
        """
        self._device.__enter__()
        self._intake.opened(self._device.identity)
        self._heard_ns, self._silent_s = self._clock.now_ns(), self._config.first_s

    def step(self) -> bool:
        """Read once; False when the stream has ended, for good or because it was stopped."""
        try:
            self._intake.offer(self._device.read(self._config.timeout_s))
            self._heard_ns, self._silent_s = self._clock.now_ns(), self._longest_silence_s()
        except DeviceTimeoutError:
            self._intake.timed_out()
            silent_s = (self._clock.now_ns() - self._heard_ns) / NS_PER_S
            return self._reconnect() if silent_s > self._silent_s else True
        except DeviceDataError:
            self._intake.broke()
        except DeviceLostError:
            return self._reconnect()
        except StreamEndedError as end:
            self._intake.fail(end)
            return False
        return True

    def close(self) -> None:
        """Close the device."""
        self._device.__exit__(None, None, None)

    def _longest_silence_s(self) -> float:
        period_s = self._device.identity.period_s or 0.0
        return max(self._config.lost_after_s, _SILENT_PERIODS * period_s)

    def _reconnect(self) -> bool:
        """Close the device and open it again, waiting ever longer between attempts."""
        self._intake.lost()
        self._device.__exit__(None, None, None)
        began_ns, wait_s = self._clock.now_ns(), self._config.first_wait_s
        while not self._stop.is_set():
            self._clock.sleep_until(self._clock.now_ns() + round(wait_s * NS_PER_S), self._stop)
            try:
                self.open()
            except (DeviceNotFoundError, DeviceLostError, DeviceTimeoutError, DeviceDataError) as absent:
                tried_s = (self._clock.now_ns() - began_ns) / NS_PER_S
                if tried_s > self._config.give_up_after_s:
                    self._intake.fail(DeviceLostError(f"given up after {tried_s:.0f} s: {absent}"))
                    return False
                wait_s = min(2 * wait_s, self._config.longest_wait_s)
            else:
                return True
        return False


class Reader:
    """Reads a device in a thread of its own, as a context manager.

    Args:
      device: not open yet; the reader opens and closes it.
      config: how it is read.
      clock: that of the device.

    Raises:
      DeviceNotFoundError: on entering, if the device is absent.
    """

    def __init__(self, device: Device, *, config: ReaderConfig | None = None, clock: Clock | None = None):
        self._device = device
        self._clock = clock or MonotonicClock()
        self._config = config or ReaderConfig()
        self._intake = Intake(capacity=self._config.capacity, clock=self._clock)
        self._stop = threading.Event()
        self._pump = Pump(device, self._intake, self._config, self._clock, self._stop)
        self._thread: threading.Thread | None = None

    @property
    def identity(self) -> Identity:
        """Identity of the device."""
        return self._device.identity

    @property
    def counts(self) -> Counts:
        """Counts of all samples up to now."""
        return self._intake.counts

    @property
    def overloaded(self) -> bool:
        """True if the consumer is more than half of the ring buffer behind."""
        return self._intake.overloaded

    def next(self, timeout_s: float) -> Sample:
        """The oldest unread sample, see `Intake.next`."""
        return self._intake.next(timeout_s)

    def drain(self) -> list[Sample]:
        """All unread samples at once, see `Intake.drain`."""
        return self._intake.drain()

    def fresh(self, timeout_s: float) -> Sample:
        """A sample grabbed after this call, see `Intake.fresh`."""
        return self._intake.fresh(timeout_s)

    def latest(self, max_age_s: float) -> Sample:
        """The newest sample at once, see `Intake.latest`."""
        return self._intake.latest(max_age_s)

    def __enter__(self) -> Self:
        self._pump.open()
        self._thread = threading.Thread(target=self._run, name=f"reader-{self.identity.sensor}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self._pump.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set() and self._pump.step():
                pass
        except DeviceError as error:
            self._intake.fail(error)
        except Exception as error:  # a bug in a driver must reach whoever waits, not end a thread in silence
            failure = DeviceLostError(f"{self.identity.sensor}: its driver failed with {error!r}; report it")
            failure.__cause__ = error
            self._intake.fail(failure)
