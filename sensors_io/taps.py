"""Clocks of two devices compared by taps that both of them measured."""

import dataclasses

import numpy as np

from sensors_io.clock import NS_PER_S

_MAD_TO_SIGMA = 1.4826  # of a normal distribution


@dataclasses.dataclass(frozen=True, kw_only=True)
class Signal:
    """One number over time that jumps at a tap: a force, or the mean change of a picture.

    Args:
      time_ns: int64 [N], ascending.
      value: float [N].
    """

    time_ns: np.ndarray
    value: np.ndarray

    def __post_init__(self) -> None:
        if self.time_ns.shape != self.value.shape or self.time_ns.ndim != 1 or len(self.time_ns) < 3:
            shapes = f"{list(self.time_ns.shape)} and {list(self.value.shape)}"
            raise ValueError(f"time_ns and value are {shapes}: must be two [N], N ≥ 3; align them")
        if np.any(np.diff(self.time_ns) <= 0):
            raise ValueError("time_ns does not increase: sort the samples and drop repeated ones")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TapOffset:
    """Delay of one signal's clock relative to another's.

    Args:
      seconds: median over the taps of (time in b − time in a).
      spread_s: standard deviation of one tap's difference, from the median absolute deviation.
      taps: how many both saw.
    """

    seconds: float
    spread_s: float
    taps: int


class TapError(ValueError):
    """Taps from which no offset can be determined."""


def tap_offset(a: Signal, b: Signal, *, max_offset_s: float = 0.5, min_taps: int = 3) -> TapOffset:
    """Compare two clocks by taps that both devices measured.

    A tap is taken at the moment it has risen to half of its peak, between samples by interpolation.  Of all shifts up
    to `max_offset_s` that bring one tap of a onto one of b, the one that pairs most is kept.

    Args:
      a, b: the signals, each with a quiet baseline.
      max_offset_s: taps must be further apart than this.
      min_taps: fewer common taps are refused.

    Raises:
      TapError: too few taps in one signal, or in common.
    """
    times = [_onsets_s(signal) for signal in (a, b)]
    for name, found in zip("ab", times, strict=True):
        if len(found) < min_taps:
            raise TapError(f"signal {name} shows {len(found)} taps: at least {min_taps} are needed; tap again, harder")
    epoch = float(a.time_ns[0]) / NS_PER_S
    ta, tb = (t - epoch for t in times)
    differences = tb[None, :] - ta[:, None]
    shifts = differences[np.abs(differences) <= max_offset_s]
    paired = [_paired(ta, tb, shift) for shift in shifts]
    best = max(paired, key=len, default=np.zeros(0))
    if len(best) < min_taps:
        raise TapError(
            f"{len(best)} taps agree within {max_offset_s} s: at least {min_taps} must; tap again, irregularly"
        )
    middle = float(np.median(best))
    spread = _MAD_TO_SIGMA * float(np.median(np.abs(best - middle)))
    return TapOffset(seconds=middle, spread_s=spread, taps=len(best))


_PAIRED_S = 0.1  # taps of one shift lie closer than this: three frames of the slowest camera


def _paired(ta: np.ndarray, tb: np.ndarray, shift: float) -> np.ndarray:
    """Differences of the taps that a shift brings together."""
    nearest = tb[np.abs(tb[None, :] - (ta[:, None] + shift)).argmin(1)]
    difference = nearest - ta
    return difference[np.abs(difference - shift) < _PAIRED_S]


def _onsets_s(signal: Signal) -> np.ndarray:
    """When each tap had risen to half of its own peak, seconds.

    A tap begins above half of a strong one (the 99.5th percentile) and ends below a quarter; strong is ten times the
    noise at least.
    """
    value = np.abs(signal.value - np.median(signal.value)).astype(np.float64)
    strong = float(np.quantile(value, 0.995))
    if strong <= 10 * _MAD_TO_SIGMA * float(np.median(value)):
        return np.zeros(0)
    position = np.arange(len(value))
    last_high = np.maximum.accumulate(np.where(value > strong / 2, position, -1))
    last_low = np.maximum.accumulate(np.where(value < strong / 4, position, -1))
    edges = np.diff((last_high > last_low).astype(np.int8), append=0)
    starts, ends = np.flatnonzero(edges == 1) + 1, np.flatnonzero(edges == -1) + 1
    ends = ends[len(ends) - len(starts) :]  # a tap that was under way at the beginning has no onset
    taps = zip(starts.tolist(), ends.tolist(), strict=True)
    return np.array([_crossing_s(signal.time_ns, value, start, end) for start, end in taps])


def _crossing_s(time_ns: np.ndarray, value: np.ndarray, start: int, end: int) -> float:
    """When the tap in [start, end) passed half of its peak, by interpolation between two samples."""
    level = value[start:end].max() / 2
    above = start + int(np.argmax(value[start:end] >= level))
    below = above - 1
    while below > 0 and value[below] >= level:
        below -= 1
    share = (level - value[below]) / (value[below + 1] - value[below])
    return float(time_ns[below] + share * (time_ns[below + 1] - time_ns[below])) / NS_PER_S
