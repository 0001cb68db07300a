"""Selection of an import: number of rows, frames, and the objects of the test split."""

import dataclasses

import cv2
import numpy as np

from sensors_io.errors import UserError

HIGHEST = 16_384
"""Rows of a stored picture."""

LEAST_HZ, MOST_HZ = 1e-3, 1e6
"""Frame rates; at others, times are beyond 64 bits or all the same."""


class ImportSourceError(UserError, ValueError):
    """A source that cannot be imported; the message names the path, the problem and the fix."""


class UnreadableError(ValueError):
    """One recording, picture or file of a source that cannot be read; the message says what is wrong with it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Skip:
    """One file, frame or object that was left out, and why."""

    name: str
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Keep:
    """Selection within each recording.

    The defaults store 120 rows at most, just above the 112 of a clip, and 32 frames, four times those of a clip: every
    clip decodes all frames of its entry.  Keep everything with height = max_frames = 0.

    Args:
      height: rows to which larger pictures are reduced, with the aspect ratio kept (INTER_AREA); 0 reduces none.
      stride: keep every stride-th frame.
      max_frames: of those, at most this many, evenly spaced (or in each piece, where a source cuts long recordings into
        pieces); 0 keeps all.
    """

    height: int = 120
    stride: int = 1
    max_frames: int = 32

    def __post_init__(self) -> None:
        for name, least in (("height", 0), ("stride", 1), ("max_frames", 0)):
            if getattr(self, name) < least:
                raise ImportSourceError(f"{name} is {getattr(self, name)}: must be ≥ {least}; raise it")
        if self.height > HIGHEST:
            raise ImportSourceError(f"height is {self.height}: must be ≤ {HIGHEST} rows; lower it")

    def positions(self, total: int) -> np.ndarray:
        """Positions of the frames that are kept of `total`, int64, ascending."""
        kept = np.arange(0, total, self.stride)
        if self.max_frames and len(kept) > self.max_frames:
            kept = kept[np.rint(np.linspace(0, len(kept) - 1, self.max_frames)).astype(np.int64)]
        return kept

    def pieces(self, total: int) -> list[np.ndarray]:
        """Positions of the frames kept of `total`, cut into runs of at most `max_frames`, all of them kept."""
        kept = np.arange(0, total, self.stride)
        size = self.max_frames or max(total, 1)
        return [kept[start : start + size] for start in range(0, len(kept), size)]

    def shrink(self, image: np.ndarray) -> np.ndarray:
        """The image at `height` rows at most, uint8 [H, W, 3]."""
        return at_height(image, min(self.height, image.shape[0]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shares:
    """Split by object of a source without splits of its own, see `split_by_name`.

    Args:
      val_share, test_share: shares of the objects that become the splits "val" and "test".
    """

    val_share: float = 0.1
    test_share: float = 0.2

    def __post_init__(self) -> None:
        check_share("val_share", self.val_share)
        check_share("test_share", self.test_share)
        if self.val_share + self.test_share >= 1:
            raise ImportSourceError(
                f"val_share + test_share is {self.val_share + self.test_share}: must be < 1; keep some for training"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportConfig(Keep, Shares):
    """Selection and split of a source without splits of its own."""

    def __post_init__(self) -> None:
        Keep.__post_init__(self)
        Shares.__post_init__(self)


def check_share(name: str, share: float) -> None:
    """Refuse a share outside 0 ≤ share < 1.

    Raises:
      ImportSourceError: naming the share.
    """
    if not 0 <= share < 1:
        raise ImportSourceError(f"{name} is {share}: must lie in 0 ≤ {name} < 1; correct it")


def at_height(image: np.ndarray, height: int) -> np.ndarray:
    """The image at `height` rows with its aspect ratio, by area means; unchanged for 0."""
    if not height or height == image.shape[0]:
        return image
    width = max(1, round(image.shape[1] * height / image.shape[0]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
