"""Pictures to extract fields from: files, folders, videos, records."""

import dataclasses
import pathlib
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from sensors_io.importers.keep import Keep
from sensors_io.importers.video import VideoError, read_video
from sensors_io.index import INDEX
from sensors_io.records import RecordStore

PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"})
VIDEOS = frozenset({".mp4", ".mov", ".avi", ".mkv"})


class SourceError(ValueError):
    """An input that holds no pictures, or none that fit together."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pictures:
    """Pictures of one source, uint8 [N, H, W, 3] RGB, and the name of each."""

    frames: np.ndarray
    names: tuple[str, ...]


def read_picture(path: pathlib.Path) -> np.ndarray:
    """One picture file, uint8 [H, W, 3] RGB.

    Raises:
      SourceError: it is no picture, or cut off.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise SourceError(f"{path} cannot be read as a picture: it is missing, damaged or of another kind; replace it")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_pictures(inputs: Sequence[pathlib.Path], sensor: str) -> Pictures:
    """All pictures of files, folders, videos and records, in the order given; files of a folder by name.

    Args:
      inputs: paths.
      sensor: whose frames are taken out of records.

    Raises:
      SourceError: a path without pictures, or pictures of different sizes.
    """
    named = [pair for path in inputs for pair in _read(path, sensor)]
    if not named:
        raise SourceError("inputs are empty: at least one path is needed; name a picture, folder, video or records")
    shapes = {image.shape: name for name, image in reversed(named)}
    if len(shapes) > 1:
        sizes = "; ".join(f"{name} is {shape[1]} × {shape[0]}" for shape, name in shapes.items())
        raise SourceError(f"pictures have different sizes ({sizes}): must be equal; extract them apart")
    return Pictures(frames=np.stack([image for _, image in named]), names=tuple(name for name, _ in named))


def _read(path: pathlib.Path, sensor: str) -> Iterator[tuple[str, np.ndarray]]:
    if (path / INDEX).exists():
        yield from _records(path, sensor)
    elif path.is_dir():
        files = sorted((p for p in path.rglob("*") if p.suffix.lower() in PICTURES), key=_by_number)
        if not files:
            kinds = ", ".join(sorted(PICTURES))
            raise SourceError(f"{path} holds no picture ({kinds}): name a folder that does")
        yield from ((str(file.relative_to(path)), read_picture(file)) for file in files)
    elif path.suffix.lower() in VIDEOS:
        try:
            video = read_video(path, Keep(height=0, stride=1, max_frames=0))
        except VideoError as error:
            raise SourceError(f"{path} {error}; convert or replace it") from error
        yield from ((f"{path.name}#{i}", frame) for i, frame in zip(video.index, video.frames, strict=True))
    else:
        yield path.name, read_picture(path)


def _records(path: pathlib.Path, sensor: str) -> Iterator[tuple[str, np.ndarray]]:
    """Camera frames of one sensor, contact by contact."""
    store, found = RecordStore(path, allow_incomplete=True), False
    for i in range(len(store)):
        if sensor in store.sensors_of(i):
            sequence = store.contact(i, fields=False)[sensor]
            if sequence.frames is not None:
                found = True
                yield from ((f"{sequence.name}#{n}", frame) for n, frame in enumerate(sequence.frames))
    if not found:
        raise SourceError(f"{path} holds no camera frames of {sensor}: name another sensor or other records")


def _by_number(path: pathlib.Path) -> tuple[tuple[int, str], ...]:
    """Order in which 2 comes before 10."""
    parts = "".join(c if c.isdigit() else " " + c + " " for c in str(path)).split()
    return tuple((int(p), "") if p.isdigit() else (-1, p) for p in parts)
