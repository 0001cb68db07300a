"""Devices and sources that do what a script says."""

import contextlib
import threading

import numpy as np

from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import DeviceNotFoundError, StreamEndedError
from sensors_io.devices.sources import Recorded

MS = 1_000_000


class Ramp:
    """A source of `count` samples at `rate_hz`; picture n is all n."""

    def __init__(self, count=10, rate_hz=100.0, size=(4, 6)):
        self.count, self.rate_hz, self.size = count, rate_hz, size

    @property
    def identity(self):
        return Identity(sensor="gelsight_mini", serial="ramp", where="ramp", period_s=1 / self.rate_hz)

    def samples(self):
        for i in range(self.count):
            frame = np.full((*self.size, 3), i % 256, np.uint8)
            yield Recorded(time_ns=round(i * 1e9 / self.rate_hz), index=i, frame=frame, arrays={})


class Scripted:
    """A device whose reads come from a list: samples, or exceptions that are raised; absent for `refusals` openings."""

    def __init__(self, script, *, refusals=0, period_s=None, refusal=DeviceNotFoundError):
        self.script, self.refusals, self.period_s, self.refusal = list(script), refusals, period_s, refusal
        self.opened = self.closed = 0

    @property
    def identity(self):
        return Identity(sensor="scripted", where="script", period_s=self.period_s)

    def __enter__(self):
        if self.opened and self.refusals:
            self.refusals -= 1
            raise self.refusal("scripted: absent")
        self.opened += 1
        return self

    def __exit__(self, *_):
        self.closed += 1

    def read(self, timeout_s):
        if not self.script:
            raise StreamEndedError("script: over")
        item = self.script.pop(0)
        if isinstance(item, BaseException):
            raise item
        return item


def sample(index=None, time_ms=0, **rest):
    """A sample at some time; without a frame unless given one."""
    return Sample(host_time_ns=time_ms * MS, index=index, **rest)


@contextlib.contextmanager
def sent(sender, *messages):
    """Messages sent again and again; those that are functions are made for each number."""
    done = threading.Event()

    def send():
        number = 0
        while not done.is_set():
            for message in messages:
                number += 1
                for datagram in message(number):
                    with contextlib.suppress(ConnectionRefusedError):  # nobody listens yet
                        sender.send(datagram)
                done.wait(0.005)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
