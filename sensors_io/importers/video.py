"""Frames of a video file, read whole or not at all."""

import dataclasses
import math
import pathlib
from typing import Any

import cv2
import numpy as np

from sensors_io.importers.keep import Keep, UnreadableError


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
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise VideoError("does not open as a video")
        rate_hz, stated = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise VideoError(f"states a frame rate of {rate_hz}")
        frames, size_px = _decode(capture, keep)
    finally:
        capture.release()
    total = len(frames)
    if not total:
        raise VideoError("holds no frame that can be decoded")
    if total < stated:
        raise VideoError(f"is cut off: {total} of {stated} frames can be decoded")
    kept = keep.positions(total)
    images = np.stack([image for n in kept if (image := frames[n]) is not None])
    return VideoFrames(frames=images, index=kept, rate_hz=rate_hz, size_px=size_px, total=total)


def _decode(capture: cv2.VideoCapture, keep: Keep) -> tuple[list[np.ndarray | None], tuple[int, int]]:
    """All frames of an open video, `None` between the strides, and their size in the file."""
    frames: list[np.ndarray | None] = []
    size_px = (0, 0)
    while capture.grab():
        if len(frames) % keep.stride:
            frames.append(None)
            continue
        ok, image = capture.retrieve()
        if not ok:
            break
        size_px = image.shape[:2]
        frames.append(cv2.cvtColor(keep.shrink(image), cv2.COLOR_BGR2RGB))
    return frames, size_px
