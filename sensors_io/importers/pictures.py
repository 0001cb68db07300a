"""Pictures of a folder as the frames of a sequence, each read whole or left out by name."""

import collections
import dataclasses
import itertools
import os
import pathlib
import re
from collections.abc import Collection, Iterator
from collections.abc import Sequence as Seq
from typing import Any

import cv2
import numpy as np

from sensors_io.importers.keep import ImportSourceError, Keep, Skip, UnreadableError
from sensors_io.schema import ContactKey, Flag, Sequence

_END = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND\xaeB`\x82"}
"""First and last bytes of JPEG and PNG; OpenCV decodes the rest of a truncated file as grey without an error."""

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # first bytes of a file of one picture, or of many
_TAIL = 64  # bytes that some cameras append behind the end


class PictureError(UnreadableError):
    """A picture that cannot be read whole."""


_DECIMALS = re.compile(r"\d+(?:\.\d+)?|\D+")


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
        how = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how) if data else None
        pages = cv2.imdecodemulti(np.frombuffer(data, np.uint8), how)[1] if data[:4] in _TIFF else ()
    except cv2.error as error:  # it states more pixels than OpenCV makes room for
        raise PictureError("is larger than any picture") from error
    if image is None:
        raise PictureError("does not open as a picture")
    if (count := sum(page.shape == image.shape for page in pages)) > 1:  # a preview of another size may follow
        raise PictureError(f"holds {count} pictures: must hold one; write each into a file of its own")
    if image.dtype != np.uint8:
        raise PictureError(
            f"holds {image.dtype}: must hold 8 bits a channel; convert it, by the range that its camera fills"
        )
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
    by_size: dict[tuple[int, int], dict[int, np.ndarray]] = {}
    reasons: dict[int, str] = {}
    for position in positions.tolist():
        try:
            image = read_picture(paths[position])
        except PictureError as error:
            reasons[position] = str(error)
        else:
            by_size.setdefault(image.shape[:2], {})[position] = keep.shrink(image)
    size_px, frames = max(by_size.items(), key=lambda found: len(found[1]), default=((0, 0), {}))
    for size, others in by_size.items():
        if size != size_px:
            reasons |= dict.fromkeys(others, f"has {size} pixels, most have {size_px}")
    named = lambda path, reason: Skip(name=f"{path.parent.name}/{path.name}", reason=reason)
    lost = tuple((position, named(paths[position], reasons[position])) for position in sorted(reasons))
    if not frames:
        first = f"; the first: {lost[0][1].name} {lost[0][1].reason}" if lost else ""
        raise PictureError(f"holds no picture that can be read{first}")
    return ReadPictures(frames=np.stack([*frames.values()]), index=np.array([*frames]), lost=lost, size_px=size_px)


def numbered(folder: pathlib.Path, suffixes: tuple[str, ...] = (".jpg", ".jpeg", ".png")) -> list[pathlib.Path]:
    """Pictures of a folder in the order of the numbers in their names.

    Raises:
      ImportSourceError: names such as 0.15.png and 0.2.png, whose order depends on what the point means.
    """
    files = list(folder.iterdir()) if folder.is_dir() else []
    return in_order([f for f in files if f.suffix.lower() in suffixes and not f.name.startswith(".")])


def inside(folder: pathlib.Path) -> Iterator[pathlib.Path]:
    """All that lies below a folder, also behind links, but for hidden names: macOS writes ._a.png next to a.png.

    A folder that several links lead to is given once, without a link where it can be.

    Raises:
      ImportSourceError: a folder that may not be listed.
      OSError: one that cannot be listed for another reason.
    """
    waiting, seen = collections.deque([folder] if folder.is_dir() else []), set[str]()
    while waiting:
        start = waiting.popleft()
        for place, folders, files in os.walk(start, onerror=_raised):
            path, true = pathlib.Path(place), os.path.realpath(place)
            folders[:] = [f for f in folders if not f.startswith(".") and true not in seen]
            if true in seen:
                continue
            seen.add(true)
            above = set(map(str, pathlib.Path(true).parents))  # a link to one of them is none of the data's
            links = (path / f for f in folders if (path / f).is_symlink())
            waiting.extend(link for link in links if os.path.realpath(link) not in above)
            yield from (path / name for name in files if not name.startswith("."))
            if path != folder:
                yield path


def _raised(error: OSError) -> None:
    if isinstance(error, PermissionError):
        raise ImportSourceError(
            f"{error.filename} cannot be listed ({error.strerror}): all folders are searched; make it readable, or "
            "move it away"
        ) from error
    raise error


def below(folder: pathlib.Path, suffixes: Collection[str]) -> list[pathlib.Path]:
    """Pictures of a folder and of those below it, folder by folder, as `numbered` orders them."""
    found: dict[pathlib.Path, list[pathlib.Path]] = {}
    for path in inside(folder):
        if path.suffix.lower() in suffixes:
            found.setdefault(path.parent, []).append(path)
    folders = sorted(found, key=lambda path: [natural(part) for part in (*reversed(path.parents), path)])
    return [file for each in folders for file in in_order(found[each])]


def in_order(files: Seq[pathlib.Path]) -> list[pathlib.Path]:
    """Files of a folder in the order of the numbers in their names.

    Raises:
      ImportSourceError: as `numbered`.
    """
    files = sorted(files, key=lambda path: (natural(path.with_suffix("")), path.name))  # a.png before a (2).png
    decimal = lambda path: [float(part) if part[0].isdecimal() else part for part in _DECIMALS.findall(path.stem)]
    for first, then in itertools.pairwise(files):
        before, after = decimal(first), decimal(then)
        if [type(part) for part in before] == [type(part) for part in after] and before > after:
            raise ImportSourceError(
                f"{first.parent}: {first.name} and {then.name}: their order depends on whether the point is that of a "
                "decimal number; give the numbers of all names as many digits after the point"
            )
    return files


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
