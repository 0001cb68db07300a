"""Frames of a video file, read whole or not at all."""

import dataclasses
import math
import pathlib

import cv2
import numpy as np


class VideoError(ValueError):
    """A video that cannot be read whole; the message says what is wrong with it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Video:
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


def read_video(path: pathlib.Path, *, height: int, stride: int, max_frames: int) -> Video:
    """Decode a video and keep every stride-th frame, at most `max_frames` of them evenly spaced, at `height` rows.

    Args:
      path: the file.
      height: rows kept, the aspect ratio with them (INTER_AREA); 0 keeps frames as they are decoded.
      stride: ≥ 1.
      max_frames: 0 keeps all.

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
        frames, size_px = _decode(capture, height, stride)
    finally:
        capture.release()
    total = len(frames)
    if not total:
        raise VideoError("holds no frame that can be decoded")
    if total < stated:
        raise VideoError(f"is cut off: {total} of {stated} frames can be decoded")
    kept = np.arange(0, total, stride)
    if max_frames and len(kept) > max_frames:
        kept = kept[np.rint(np.linspace(0, len(kept) - 1, max_frames)).astype(np.int64)]
    images = np.stack([image for n in kept if (image := frames[n]) is not None])
    return Video(frames=images, index=kept, rate_hz=rate_hz, size_px=size_px, total=total)


def _decode(capture: cv2.VideoCapture, height: int, stride: int) -> tuple[list[np.ndarray | None], tuple[int, int]]:
    """All frames of an open video, `None` between the strides, and their size in the file."""
    frames: list[np.ndarray | None] = []
    size_px = (0, 0)
    while capture.grab():
        if len(frames) % stride:
            frames.append(None)
            continue
        ok, image = capture.retrieve()
        if not ok:
            break
        size_px = image.shape[:2]
        if height and height != size_px[0]:
            width = max(1, round(size_px[1] * height / size_px[0]))
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        frames.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    return frames, size_px
