"""The protocol of a device: a context manager with an identity and one blocking read.

A device is used by one thread and knows neither buffers nor threads; `reader.Reader` puts both around it.  The stamp of
a sample is taken right after the grab, before anything is decoded or resized.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol, Self

import numpy as np

from sensors_io.clock import NS_PER_S

HELD_NS = 3 * NS_PER_S
"""Longest delay by a link: who is away for longer may have begun anew, though number and stamp go on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Identity:
    """Name, serial number and settings of a device.

    Args:
      sensor: canonical name in `schema.SENSORS`, or that of another kind of device, such as "netft".
      serial: of this unit; empty where it states none.
      product: what it calls itself.
      where: node, address or path it is reached by.
      settings: as read back after setting, JSON values; stored with every recording.
      period_s: time between two samples; `None` where unknown.
      mm_per_px: pitch of its pictures on the gel; `None` where unknown.
    """

    sensor: str
    serial: str = ""
    product: str = ""
    where: str = ""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    period_s: float | None = None
    mm_per_px: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, slots=True)
class Sample:
    """One reading of a device.

    Args:
      host_time_ns: monotonic, right after the grab.
      device_time_ns: by the device's own clock; `None` where it has none.
      index: by the device's own counter; `None` where it has none.
      frame: uint8 [H, W, 3] RGB, or uint16 [H, W] of a depth camera; `None` of a device without pictures.
      arrays: anything else, named as in `schema.FRAME_ARRAYS` without the leading N, such as `force_n` [3].
    """

    host_time_ns: int
    device_time_ns: int | None = None
    index: int | None = None
    frame: np.ndarray | None = None
    arrays: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


def require_pitch(mm_per_px: float | None) -> None:
    """Refuse what is no pitch of a picture of a gel, such as px per mm.

    Raises:
      ValueError: it is outside (0, 1).
    """
    if mm_per_px is not None and not 0 < mm_per_px < 1:
        raise ValueError(f"mm_per_px is {mm_per_px}: must lie in (0, 1); measure it with `geometry`")


class Device(Protocol):
    """Anything that gives samples."""

    @property
    def identity(self) -> Identity:
        """Identity of the device; complete once it is open."""
        ...

    def __enter__(self) -> Self:
        """Open it; a closed device may be opened again.

        Raises:
          DeviceNotFoundError: it is absent.
        """
        ...

    def __exit__(self, *exc: object) -> None:
        """Close it, also one that was lost."""
        ...

    def read(self, timeout_s: float) -> Sample:
        """Wait for the next sample and return it; every sample is returned once, in order.

        Raises:
          DeviceTimeoutError: none came in time; the next call may succeed.
          DeviceLostError: it must be closed and opened again.
          DeviceDataError: a sample broke the protocol and is left out.
          StreamEndedError: a replay is over.
        """
        ...
