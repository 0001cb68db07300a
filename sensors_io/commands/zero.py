"""`python -m sensors_io zero`."""

import collections
import dataclasses
import time
from typing import Protocol, runtime_checkable

import numpy as np
from rich.table import Table

from sensors_io.commands.choices import Bench, opened
from sensors_io.commands.console import OUT
from sensors_io.devices.base import Device
from sensors_io.devices.errors import DeviceDataError, DeviceNotFoundError

_TIMEOUT_S = 2.0  # for one sample
_SETTLE_S = 0.2  # samples taken before the sensor obeyed are on their way


@runtime_checkable
class Zeroable(Device, Protocol):
    """A device that can take its present state as zero."""

    def take_zero(self) -> None:
        """Take it; nothing may touch the sensor."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Zero(Bench):
    """Set the zero of sensors to their present state; nothing may touch them.  Tac3D and Net F/T can.

    Devices are joined by a + of its own: zero tac3d + netft --host H.  The sensor keeps no trace of what it took off,
    so for a force sensor `force-zero` is the better way: its bias goes with the records.
    """

    seconds: float = 0.5
    """Duration of the readings before and after."""

    def run(self) -> int:
        table = Table("sensor", "force before, N", "force after, N")
        broken: collections.Counter[str] = collections.Counter()
        for config in (self.device, *self.more):
            with opened(config) as device:
                name = device.identity.sensor
                if not isinstance(device, Zeroable):
                    raise DeviceNotFoundError(f"{name} has no zero to take: must be tac3d or netft; leave it out")
                before = _mean_force(device, self.seconds, broken)
                device.take_zero()
                _mean_force(device, _SETTLE_S, broken)
                table.add_row(name, _vector(before), _vector(_mean_force(device, self.seconds, broken)))
        OUT.print(table)
        for name, count in broken.items():
            OUT.print(f"{count} broken samples of {name} were left out", highlight=False)
        return 0


def _mean_force(device: Device, seconds: float, broken: collections.Counter[str]) -> np.ndarray:
    """Mean over some time, [3], of at least one sample; counts broken ones, by the name of the device."""
    forces: list[np.ndarray] = []
    name = device.identity.sensor
    end_s = time.monotonic() + seconds
    while not forces or time.monotonic() < end_s:
        try:
            sample = device.read(_TIMEOUT_S)
        except DeviceDataError:
            if time.monotonic() > end_s + _TIMEOUT_S:
                raise
            broken[name] += 1
            continue
        if "force_n" not in sample.arrays:
            raise DeviceDataError(
                f"{name} sent a sample without force; let its program send it, and take the zero again"
            )
        forces.append(sample.arrays["force_n"])
    return np.mean(forces, axis=0)


def _vector(force_n: np.ndarray) -> str:
    return " ".join(f"{v:+.3f}" for v in force_n)
