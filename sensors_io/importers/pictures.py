"""Pictures of a folder as the frames of a sequence, each read whole or left out by name."""

import dataclasses
import pathlib
import re
from collections.abc import Sequence as Seq
from typing import Any

import cv2
import numpy as np

from sensors_io.importers.keep import Keep, Skip, UnreadableError
from sensors_io.schema import ContactKey, Flag, Sequence

_END = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND\xaeB`\x82"}
"""First and last bytes of JPEG and PNG; OpenCV decodes the rest of a truncated file as grey without an error."""

_TAIL = 64  # bytes that some cameras append behind the end


class PictureError(UnreadableError):
    """A picture that cannot be read whole."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadPictures:
    """The pictures that could be read.

    Args:
      frames: uint8 [N, H, W, 3], RGB.
      index: position of each in the list of paths, int64 [N], ascending.
      lost: each that was asked for and could not be read, with its position.
      size_px: rows and columns before any shrinking.
    """

    frames: np.ndarray
    index: np.ndarray
    lost: tuple[tuple[int, Skip], ...]
    size_px: tuple[int, int]

    @property
    def left_out(self) -> tuple[Skip, ...]:
        """Counts of lost pictures, for the report."""
        return tuple(skip for _, skip in self.lost)

    def after_loss(self) -> np.ndarray:
        """Mask of frames that directly follow a lost one, bool [N]."""
        lost = np.array([position for position, _ in self.lost], np.int64)
        before = np.concatenate([[-1], self.index[:-1]])
        return np.any((lost > before[:, None]) & (lost < self.index[:, None]), axis=1)


def read_picture(path: pathlib.Path) -> np.ndarray:
    """One picture, uint8 [H, W, 3], RGB.

    Raises:
      PictureError: it is absent, cut off, or no picture.
    """
    if not path.is_file():
        raise PictureError("is absent")
    return decode_picture(path.read_bytes())


def decode_picture(data: bytes) -> np.ndarray:
    """One picture from the bytes of its file, uint8 [H, W, 3], RGB.

    Raises:
      PictureError: they are cut off, or no picture.
    """
    end = _END.get(data[:2])
    if end is not None and end not in data[-_TAIL:]:
        raise PictureError("is cut off")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
    except cv2.error as error:  # it states more pixels than OpenCV makes room for
        raise PictureError("is larger than any picture") from error
    if image is None:
        raise PictureError("does not open as a picture")
    return image


def read_pictures(paths: Seq[pathlib.Path], positions: np.ndarray, keep: Keep) -> ReadPictures:
    """The pictures at some positions of a list, at `keep.height` rows.

    Args:
      paths: one per frame, in order.
      positions: which of them, int64, ascending.
      keep: gives the height.

    Raises:
      PictureError: none can be read.
    """
    frames: list[np.ndarray] = []
    index: list[int] = []
    lost: list[tuple[int, Skip]] = []
    size_px = (0, 0)
    for position in positions.tolist():
        path = paths[position]
        try:
            image = read_picture(path)
            if frames and image.shape[:2] != size_px:
                raise PictureError(f"has {image.shape[:2]} pixels, those before it {size_px}")
        except PictureError as error:
            lost.append((position, Skip(name=f"{path.parent.name}/{path.name}", reason=str(error))))
            continue
        size_px = image.shape[:2]
        frames.append(keep.shrink(image))
        index.append(position)
    if not frames:
        first = f"; the first: {lost[0][1].name} {lost[0][1].reason}" if lost else ""
        raise PictureError(f"holds no picture that can be read{first}")
    return ReadPictures(frames=np.stack(frames), index=np.array(index), lost=tuple(lost), size_px=size_px)


def numbered(folder: pathlib.Path, suffixes: tuple[str, ...] = (".jpg", ".jpeg", ".png")) -> list[pathlib.Path]:
    """Pictures of a folder in the order of the numbers in their names."""
    files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes] if folder.is_dir() else []
    return sorted(files, key=natural)


def natural(path: pathlib.Path) -> tuple[tuple[int, int | str], ...]:
    """Key that sorts the numbers in a name by value: frame_9 before frame_10."""
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in re.findall(r"\d+|\D+", path.name))


def film(key: ContactKey, sensor: str, *, gap: np.ndarray, host_time_ns: np.ndarray, **arrays: Any) -> Sequence:
    """A sequence of unguided frames (phase 0), with `Flag.TIME_GAP` where something is missing before a frame.

    Args:
      key, sensor: identity.
      gap: bool [N].
      host_time_ns: int64 [N].
      arrays: the other fields of the sequence.
    """
    return Sequence(
        key=key,
        sensor=sensor,
        host_time_ns=host_time_ns,
        phase=np.zeros(len(gap), np.uint8),
        flags=np.where(gap, np.uint32(Flag.TIME_GAP), np.uint32(0)),
        **arrays,
    )


def stored_ns(seconds: np.ndarray, file: str) -> np.ndarray:
    """Stored times, int64 [N].

    Raises:
      UnreadableError: they are not finite, or run backwards.
    """
    if not np.isfinite(seconds).all() or (np.diff(seconds) < 0).any():
        raise UnreadableError(f"{file} has times that are not finite, or run backwards")
    return whole(seconds * 1e9, f"{file}, times in ns")


def nominal_ns(frame: np.ndarray, rate_hz: float) -> np.ndarray:
    """Times of frame numbers at a stated rate, int64 [N]."""
    return whole(np.asarray(frame, np.float64) * (1e9 / rate_hz), "frame numbers, times in ns")


def whole(values: np.ndarray, what: str) -> np.ndarray:
    """Values rounded to int64.

    Raises:
      UnreadableError: they are not finite, or beyond 64 bits.
    """
    if not (np.abs(values) < 2.0**63).all():
        raise UnreadableError(f"{what}: reach {np.abs(values).max():.3g}, which 64 bits cannot hold; check their unit")
    return np.rint(values).astype(np.int64)
