"""One number over time from each device of a bench, and from them how late each is stamped."""

from collections.abc import Mapping
from typing import Literal

import numpy as np

from sensors_io.devices.base import Sample
from sensors_io.force import ForceError, estimate_lag
from sensors_io.offsets import Offset, Offsets, OffsetsError
from sensors_io.recording.streams import SampleReader
from sensors_io.taps import Signal, TapError, tap_offset

_STRIDE = 4  # of the pixels from which the change of a picture is computed

By = Literal["taps", "presses"]


class Listener:
    """Turns the samples of a device into one number each: what a touch changes.

    Of a picture the mean change against the first one, else the magnitude of the force, else the mean magnitude of the
    deformation or of the depth.  Samples of another size or with other arrays than most are left out of its signal.

    Args:
      feed: an open device.
    """

    def __init__(self, feed: SampleReader):
        self.feed = feed
        self._first: dict[_Kind, np.ndarray] = {}
        self._heard: dict[_Kind, list[tuple[int, float]]] = {}
        self._last: tuple[int, float] | None = None

    @property
    def name(self) -> str:
        """Of the device."""
        return self.feed.identity.sensor

    def look(self) -> None:
        """Take in everything that came since the last look; repeated stamps are left out."""
        for sample in self.feed.drain():
            if self._last is None or sample.host_time_ns > self._last[0]:
                name, array = self._telling(sample)
                kind = name, array.shape
                self._last = sample.host_time_ns, _number(name, array, self._first.setdefault(kind, array))
                self._heard.setdefault(kind, []).append(self._last)

    @property
    def newest(self) -> float:
        """The last number, 0 before the first."""
        return 0.0 if self._last is None else self._last[1]

    def signal(self) -> Signal:
        """All of them.

        Raises:
          OffsetsError: hardly any came.
        """
        heard = max(self._heard.values(), key=len, default=[])
        if len(heard) < _LEAST_SAMPLES:
            raise OffsetsError(
                f"{self.name} gave {len(heard)} samples: must be ≥ {_LEAST_SAMPLES}; look whether it is connected"
            )
        times, values = zip(*heard, strict=True)
        return Signal(time_ns=np.array(times, np.int64), value=np.array(values))

    def _telling(self, sample: Sample) -> tuple[str, np.ndarray]:
        """Name and array of what shows a touch."""
        if sample.frame is not None:
            return "frame", sample.frame[::_STRIDE, ::_STRIDE].astype(np.float32)
        for name in ("force_n", "deformation_mm", "depth_mm"):
            if name in sample.arrays:
                return name, np.nan_to_num(np.asarray(sample.arrays[name], np.float64))
        raise OffsetsError(f"{self.name} gives neither pictures nor forces nor fields: nothing shows a touch")


_Kind = tuple[str, tuple[int, ...]]
"""Name and shape of what shows a touch."""


def _number(name: str, array: np.ndarray, first: np.ndarray) -> float:
    if name == "frame":
        return float(np.abs(array - first).mean())
    return float(np.linalg.norm(array, axis=-1).mean() if name != "depth_mm" else np.abs(array).mean())


_LEAST_SAMPLES = 16


def measure_offsets(reference: Signal, others: Mapping[str, Signal], name: str, by: By) -> Offsets:
    """By how much the others lie behind the reference.

    Args:
      reference: of the force sensor, or of the first sensor without one.
      others: by name.
      name: of the reference.
      by: "taps" compares when sharp taps rose, see `taps.tap_offset`; "presses" compares rates of change, see
        `force.estimate_lag`, and wants a force for a reference.

    Raises:
      OffsetsError: too few taps, or nothing that agrees, naming the sensor.
    """
    found = {}
    for other, signal in others.items():
        try:
            found[other] = _by_taps(reference, signal) if by == "taps" else _by_presses(reference, signal)
        except (TapError, ForceError) as error:
            raise OffsetsError(f"{other} against {name}: {error}") from error
    return Offsets(reference=name, sensors=found)


def _by_taps(reference: Signal, signal: Signal) -> Offset:
    offset = tap_offset(reference, signal)
    return Offset(late_s=offset.seconds, spread_s=offset.spread_s, events=offset.taps, by="taps")


def _by_presses(reference: Signal, signal: Signal) -> Offset:
    lag = estimate_lag(signal.time_ns, signal.value, reference.time_ns, reference.value)
    return Offset(late_s=lag.seconds, spread_s=None, events=0, by="presses", agreement=lag.correlation)
