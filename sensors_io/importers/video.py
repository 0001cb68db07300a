"""Frames of a video file, read whole or not at all."""

import contextlib
import dataclasses
import pathlib
import struct
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from sensors_io.errors import UserError, path_text
from sensors_io.importers import mp4
from sensors_io.importers.keep import LEAST_HZ, MOST_HZ, Keep, UnreadableError
from sensors_io.importers.pictures import nominal_ns

_MOST_STATED = 10**6  # frames that a header is believed
_TIMED = (".mkv", ".webm")
"""Files that state no number of frames: OpenCV takes the duration of their longest stream times a rate."""
_SOUND_S = 0.25  # by which sound may outlast the pictures
_INDEX = np.dtype([("stream", "S2"), ("kind", "S2"), ("flags", "<u4"), ("start", "<u4"), ("bytes", "<u4")])  # of AVI
_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"  # the two elements of a Matroska file (RFC 9559)


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
        last = capture.get(cv2.CAP_PROP_PTS)
    total = len(stamps_ms)
    if not total:
        raise VideoError("holds no frame that can be decoded")
    if is_cut_off(path, stated, total, rate_hz, last):
        sound = ", or its sound is longer" if path.suffix.lower() in _TIMED else ""
        raise VideoError(f"is cut off{sound}: {total} of {max(stated, total + 1)} frames can be decoded")
    kept = keep.positions(total)
    if total != expected:  # others than these were kept
        with _opened(path) as capture:
            frames, _, size_px = _decode(capture, keep, kept)
    images = np.stack([frames[n] for n in kept.tolist()])
    times = _times_ns(np.array(stamps_ms), rate_hz)[kept]
    return VideoFrames(frames=images, index=kept, time_ns=times, rate_hz=rate_hz, size_px=size_px, total=total)


def is_cut_off(path: pathlib.Path, stated: int, count: int, rate_hz: float, last: float) -> bool:
    """True if the end of a video is missing.

    Args:
      path: of the video.
      stated: frames by its header.
      count: frames that can be decoded.
      rate_hz: that it states.
      last: stamp of the last frame, in periods of that rate since the start of the file.
    """
    if path.suffix.lower() in mp4.SUFFIXES:
        return mp4.is_cut_off(path, stated, count)
    if path.suffix.lower() not in _TIMED:
        return count < stated and count < stated - _dropped(path)
    return _lacks_bytes(path) or (count < stated and stated - 1 - last > _SOUND_S * rate_hz)


def _dropped(path: pathlib.Path) -> int:
    """Entries of no bytes in the index of an AVI file, each for a frame that was dropped, or came before the sound."""
    start, found = 12, 0  # behind "RIFF", a size and the kind
    with path.open("rb") as file:
        while file.seek(start) and len(head := file.read(8)) == 8:
            kind, size = struct.unpack("<4sI", head)
            if kind == b"idx1":
                data = file.read(size)  # perhaps less than that
                rows = np.frombuffer(data[: len(data) // _INDEX.itemsize * _INDEX.itemsize], _INDEX)
                found += int(((rows["bytes"] == 0) & np.isin(rows["kind"], (b"dc", b"db"))).sum())
            start += 8 + size + size % 2
    return found


def _lacks_bytes(path: pathlib.Path) -> bool:
    """True if a Matroska file is shorter than its elements say."""
    end = 0
    with path.open("rb") as file:
        for kind in (_EBML, _SEGMENT):
            file.seek(end)
            if file.read(4) != kind:
                return False  # another container by this name
            if not (first := file.read(1)):
                return True
            bits = 7 * (9 - first[0].bit_length())  # as many bytes as there are zeros before the first one, and one
            size = int.from_bytes(first + file.read(bits // 7 - 1)) & ((1 << bits) - 1)
            if size == (1 << bits) - 1:
                return False  # written without going back, as a recorder that is killed leaves it
            end = file.tell() + size
    return path.stat().st_size < end


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
    elif path.exists():  # a pipe is waited for, maybe for ever
        raise VideoError("is a folder, a pipe or a device")
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
