"""The picture of the untouched gel, kept up to date, and how far it has drifted."""

import dataclasses

import numpy as np

_STRIDE = 4  # of the pixels that are looked at for a touch
_CHANGED_LEVELS = 12.0  # grey levels of 0..255, five times the noise of a GelSight Mini
_CHANGED_SHARE = 0.005  # of the pixels: a contact of 1.4 mm on a window of 20 × 15 mm


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drift:
    """Change of the background since its first frames, in grey levels of 0..255.

    Args:
      mean: of the signed difference, per channel [3]: lamps and exposure.
      rms: over all pixels and channels: also dirt, wear and a gel that was moved.
    """

    mean: np.ndarray
    rms: float


class GelBackground:
    """Running mean of untouched frames:  b ← b + (frame − b) / min(n, memory).

    Args:
      memory: frames after which the mean forgets; four seconds of a Mini by default.
    """

    def __init__(self, memory: int = 100):
        if memory < 1:
            raise ValueError(f"memory is {memory}: must be ≥ 1 frame; raise it")
        self._memory = memory
        self._count = 0
        self._mean: np.ndarray | None = None
        self._first: np.ndarray | None = None

    @property
    def frames(self) -> int:
        """Untouched frames taken in so far."""
        return self._count

    def offer(self, frame: np.ndarray, *, touched: bool) -> None:
        """Take a frame [H, W, 3] into the mean, unless something touches the gel; one of another shape begins anew."""
        if touched:
            return
        if self._mean is None or frame.shape != self._mean.shape:
            self._mean, self._first, self._count = frame.astype(np.float32), None, 0
        self._count += 1
        self._mean += (frame - self._mean) / np.float32(min(self._count, self._memory))
        if self._count == self._memory:
            self._first = self._mean.copy()

    def looks_touched(self, frame: np.ndarray) -> bool:
        """True if a frame [H, W, 3] differs from the background as a contact does; used where no force is measured.

        More than one pixel in two hundred has changed by over 12 grey levels beyond the median change of its channel,
        which is that of the lamps.  Before there is a background nothing looks touched: start with a free gel.
        """
        if self._mean is None or frame.shape != self._mean.shape:
            return False
        change = frame[::_STRIDE, ::_STRIDE] - self._mean[::_STRIDE, ::_STRIDE]
        beyond = np.abs(change - np.median(change, axis=(0, 1))).max(-1) > _CHANGED_LEVELS
        return bool(beyond.mean() > _CHANGED_SHARE)

    def picture(self) -> np.ndarray:
        """The background, uint8 [H, W, 3].

        Raises:
          ValueError: no untouched frame has come yet.
        """
        if self._mean is None:
            raise ValueError("the background holds no frame: let nothing touch the gel, and wait for one")
        return np.rint(self._mean).astype(np.uint8)

    def drift(self) -> Drift | None:
        """Change since the first `memory` frames without contact; `None` until there are that many."""
        if self._mean is None or self._first is None:
            return None
        moved = self._mean - self._first
        return Drift(mean=moved.mean((0, 1)), rms=float(np.sqrt(np.mean(moved**2))))
