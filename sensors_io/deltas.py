"""Differences of camera frames, which compress better than the frames and give them back exactly.

    time   r[n] = x[n] − x[n−1]          rows   r[n, y] = x[n, y] − x[n, y−1]          (modulo 256)

The first frame or row stays as it is; one after the other they make the fourth filter.  What is still except for noise
wants "time", what was decoded from a lossy video or jumps from frame to frame wants "rows", and pure noise "none".
Undoing a difference adds whole frames or rows at a time, which costs little compared with the decompression; columns
would have to be added pixel by pixel and are left out for it.
"""

from collections.abc import Mapping

import numpy as np

FILTERS: Mapping[str, tuple[int, ...]] = {"none": (), "time": (0,), "rows": (1,), "time+rows": (0, 1)}
"""Axes of the frames along which each filter takes differences."""

_SAMPLES = 4
_RUN = 3
"""Frames that `choose_filter` looks at: so many short runs, evenly spaced over the sequence."""


def difference(frames: np.ndarray, name: str) -> np.ndarray:
    """Residual r of the frames, uint8 [N, H, W, 3]; a new array unless the filter is "none".

    Args:
      frames: uint8 [N, H, W, 3].
      name: one of `FILTERS`.
    """
    for axis in FILTERS[name]:
        residual = frames.copy()
        later, earlier = _pairs(axis)
        np.subtract(frames[later], frames[earlier], out=residual[later])
        frames = residual
    return frames


def accumulate(residual: np.ndarray, name: str) -> np.ndarray:
    """The frames that `difference` made `residual` of; a new array unless the filter is "none"."""
    for axis in reversed(FILTERS[name]):
        frames = np.empty_like(residual)
        if frames.size:
            r, x = (np.moveaxis(a, axis, 0) for a in (residual, frames))
            x[0] = r[0]
            for n in range(1, len(x)):
                np.add(x[n - 1], r[n], out=x[n])
        residual = frames
    return residual


def choose_filter(frames: np.ndarray) -> str:
    """The filter whose residual is smallest in the mean of |r|, r taken as a signed byte, over some runs of frames.

    The rule is that of the PNG specification (12.7, minimum sum of absolute differences).  Against the filter that is
    best behind zstd it costs nothing on generated scenes and on camera stills, 1 % on whole frames of compressed videos
    and 9 % on such frames shrunk to 120 rows; the entropy of the residual chooses the same.

    Args:
      frames: uint8 [N, H, W, 3].
    """
    if not frames.size:
        return "none"
    starts = np.unique(np.linspace(0, max(len(frames) - _RUN, 0), _SAMPLES).astype(int))
    runs = [frames[start : start + _RUN] for start in starts]
    cost = {name: sum(_magnitude(difference(run, name)[-1:]) for run in runs) for name in FILTERS}
    return min(cost, key=lambda name: cost[name])


def _magnitude(residual: np.ndarray) -> float:
    """Mean of |r|; −128 counts 128."""
    return float(np.abs(residual.view(np.int8).astype(np.int16)).mean())


def _pairs(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    before = (slice(None),) * axis
    return (*before, slice(1, None)), (*before, slice(None, -1))
