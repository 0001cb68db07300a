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
from sensors_io.importers.pictures import nominal_ns

_MOST_STATED = 10**6  # frames that a header is believed
_TIMED = (".mkv", ".webm")
"""Files that state no number of frames: OpenCV takes the duration of their longest stream times a rate."""
_SOUND_S = 0.25  # by which sound may outlast the pictures


class VideoError(UnreadableError):
    """A video that cannot be read whole; the message says what is wrong with it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoFrames:
    """Frames kept of a video.

    Args:
      frames: uint8 [N, H, W, 3], RGB.
      index: position of each kept frame in the file, int64 [N].
      time_ns: of each, int64 [N]: by the stated rate, or by its stamps where they rise and leave it by over a period.
      rate_hz: frame rate that the container states.
      size_px: rows and columns before any shrinking.
      total: frames in the file.
    """

    frames: np.ndarray
    index: np.ndarray
    time_ns: np.ndarray
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
        frames, stamps_ms, size_px = _decode(capture, keep, keep.positions(expected))
    total = len(stamps_ms)
    if not total:
        raise VideoError("holds no frame that can be decoded")
    if is_cut_off(path, stated, total, rate_hz, stamps_ms[-1]):
        sound = ", or its sound is longer" if path.suffix.lower() in _TIMED else ""
        raise VideoError(f"is cut off{sound}: {total} of {stated} frames can be decoded")
    kept = keep.positions(total)
    if total != expected:  # others than these were kept
        with _opened(path) as capture:
            frames, _, size_px = _decode(capture, keep, kept)
    images = np.stack([frames[n] for n in kept.tolist()])
    times = _times_ns(np.array(stamps_ms), rate_hz)[kept]
    return VideoFrames(frames=images, index=kept, time_ns=times, rate_hz=rate_hz, size_px=size_px, total=total)


def is_cut_off(path: pathlib.Path, stated: int, count: int, rate_hz: float, last_ms: float) -> bool:
    """True if the end of a video is missing.

    Args:
      path: of the video.
      stated: frames by its header.
      count: frames that can be decoded.
      rate_hz: that it states.
      last_ms: stamp of the last frame.
    """
    if count >= stated or path.suffix.lower() not in _TIMED:
        return count < stated
    return (stated - 1) / rate_hz - last_ms / 1e3 > _SOUND_S


def _times_ns(stamps_ms: np.ndarray, rate_hz: float) -> np.ndarray:
    """Times of all frames since the first, as `VideoFrames.time_ns`."""
    nominal = nominal_ns(np.arange(len(stamps_ms)), rate_hz)
    own = np.rint((stamps_ms - stamps_ms[0]) * 1e6).astype(np.int64)
    varies = (np.diff(own) > 0).all() and np.abs(own - nominal).max() > 1e9 / rate_hz
    return own if varies else nominal


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
) -> tuple[dict[int, np.ndarray], list[float], tuple[int, int]]:
    """Frames at some positions of an open video, of which others are decoded and dropped; stamps of all; their size."""
    frames: dict[int, np.ndarray] = {}
    wanted, size_px = set(kept.tolist()), (0, 0)
    stamps_ms: list[float] = []
    while capture.grab():
        if (position := len(stamps_ms)) % keep.stride == 0:
            ok, image = capture.retrieve()
            if not ok:
                break
            size_px = image.shape[:2]
            if position in wanted:
                frames[position] = cv2.cvtColor(keep.shrink(image), cv2.COLOR_BGR2RGB)
        stamps_ms.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    return frames, stamps_ms, size_px
