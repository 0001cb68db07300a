"""Frames of a video file, read whole or not at all."""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from sensors_io.errors import UserError, path_text
from sensors_io.importers.keep import LEAST_HZ, MOST_HZ, Keep, UnreadableError

_MOST_STATED = 10**6  # frames that a header is believed


class VideoError(UnreadableError):
    """A video that cannot be read whole; the message says what is wrong with it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoFrames:
    """Frames kept of a video.

    Args:
      frames: uint8 [N, H, W, 3], RGB.
      index: position of each kept frame in the file, int64 [N].
      rate_hz: frame rate that the container states.
      size_px: rows and columns before any shrinking.
      total: frames in the file.
    """

    frames: np.ndarray
    index: np.ndarray
    rate_hz: float
    size_px: tuple[int, int]
    total: int

    def camera(self, path: pathlib.Path) -> dict[str, Any]:
        """Camera entry of a record: the file that it comes from."""
        return {"file": path.name, "rate_hz": self.rate_hz, "size_px": self.size_px, "frames": self.total}


def read_video(path: pathlib.Path, keep: Keep) -> VideoFrames:
    """Decode a video and keep what `keep` says of it.

    Args:
      path: the file.
      keep: which frames, at how many rows.

    Raises:
      VideoError: it does not open, states no frame rate, holds no frame, or fewer frames than it states.
    """
    with _opened(path) as capture:
        rate_hz, stated = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if not LEAST_HZ <= rate_hz <= MOST_HZ:
            raise VideoError(f"states a frame rate of {rate_hz}")
        expected = min(max(stated, 0), _MOST_STATED)
        frames, total, size_px = _decode(capture, keep, keep.positions(expected))
    if not total:
        raise VideoError("holds no frame that can be decoded")
    if total < stated:
        raise VideoError(f"is cut off: {total} of {stated} frames can be decoded")
    kept = keep.positions(total)
    if total > expected:  # it states too few, so that others than these were kept
        with _opened(path) as capture:
            frames, total, size_px = _decode(capture, keep, kept)
    images = np.stack([frames[n] for n in kept.tolist()])
    return VideoFrames(frames=images, index=kept, rate_hz=rate_hz, size_px=size_px, total=total)


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator[cv2.VideoCapture]:
    if path.is_file():
        path.open("rb").close()  # what the system refuses is no fault of the video
    try:
        capture = cv2.VideoCapture(path_text(path))
    except UserError as error:
        raise VideoError("has a name that is not UTF-8; rename it") from error
    try:
        if not capture.isOpened():
            raise VideoError("does not open as a video")
        yield capture
    finally:
        capture.release()


def _decode(
    capture: cv2.VideoCapture, keep: Keep, kept: np.ndarray
) -> tuple[dict[int, np.ndarray], int, tuple[int, int]]:
    """Frames at some positions of an open video, of which all others are decoded and dropped; their number and size."""
    frames: dict[int, np.ndarray] = {}
    wanted, total, size_px = set(kept.tolist()), 0, (0, 0)
    while capture.grab():
        if total % keep.stride == 0:
            ok, image = capture.retrieve()
            if not ok:
                break
            size_px = image.shape[:2]
            if total in wanted:
                frames[total] = cv2.cvtColor(keep.shrink(image), cv2.COLOR_BGR2RGB)
        total += 1
    return frames, total, size_px
