"""Pictures to extract fields from: files, folders, videos, records."""

import dataclasses
import pathlib
from collections.abc import Iterator, Sequence

import numpy as np

from sensors_io.errors import UserError
from sensors_io.importers import pictures
from sensors_io.importers.keep import Keep
from sensors_io.importers.video import VideoError, read_video
from sensors_io.importers.videos import SUFFIXES
from sensors_io.index import looks_like_records
from sensors_io.quality import QualityConfig, after_gap
from sensors_io.records import RecordStore

PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"})
VIDEOS = frozenset(SUFFIXES)


class SourceError(UserError, ValueError):
    """An input that holds no pictures, or none that fit together."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureSequence:
    """N pictures, one after the other.

    Args:
      frames: uint8 [N, H, W, 3] RGB.
      names: of each.
      gap: bool [N], where time is known to be missing before a picture.
      apart: bool [N], where nothing says that a picture follows the one before: stills, and the first of a sequence.
    """

    frames: np.ndarray
    names: tuple[str, ...]
    gap: np.ndarray
    apart: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)

    def chosen(self, index: np.ndarray) -> "PictureSequence":
        """Some of the pictures."""
        names = tuple(self.names[i] for i in index)
        return PictureSequence(frames=self.frames[index], names=names, gap=self.gap[index], apart=self.apart[index])


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Shot:
    """One picture, uint8 [H, W, 3], its name and what is known of the time before it, as in `PictureSequence`."""

    name: str
    frame: np.ndarray
    gap: bool = False
    apart: bool = False


def read_picture(path: pathlib.Path) -> np.ndarray:
    """One picture file, uint8 [H, W, 3] RGB.

    Raises:
      SourceError: it is no picture, or cut off.
    """
    try:
        return pictures.read_picture(path)
    except pictures.PictureError as error:
        raise SourceError(f"{path} {error}: must be a whole picture; replace it") from error


def read_pictures(inputs: Sequence[pathlib.Path], sensor: str, quality: QualityConfig | None = None) -> PictureSequence:
    """All pictures of files, folders, videos and records, in the order given; files of a folder by name.

    Args:
      inputs: paths.
      sensor: whose frames are taken out of records.
      quality: defines what is a gap between frames of records.

    Raises:
      SourceError: a path without pictures, or pictures of different sizes.
    """
    shots = [shot for path in inputs for shot in _read(path, sensor, quality or QualityConfig())]
    if not shots:
        raise SourceError("inputs are empty: at least one path is needed; name a picture, folder, video or records")
    shapes = {shot.frame.shape: shot.name for shot in reversed(shots)}
    if len(shapes) > 1:
        sizes = "; ".join(f"{name} is {shape[1]} × {shape[0]}" for shape, name in shapes.items())
        raise SourceError(f"pictures have different sizes ({sizes}): must be equal; extract them apart")
    return PictureSequence(
        frames=np.stack([shot.frame for shot in shots]),
        names=tuple(shot.name for shot in shots),
        gap=np.array([shot.gap for shot in shots]),
        apart=np.array([shot.apart for shot in shots]),
    )


def _read(path: pathlib.Path, sensor: str, quality: QualityConfig) -> Iterator[_Shot]:
    if looks_like_records(path):
        yield from _records(path, sensor, quality)
    elif path.is_dir():
        files = pictures.below(path, PICTURES)
        if not files:
            kinds = ", ".join(sorted(PICTURES))
            raise SourceError(f"{path} holds no picture ({kinds}): name a folder that does")
        if films := [f for f in pictures.inside(path) if f.suffix.lower() in VIDEOS]:
            raise SourceError(
                f"{path} holds pictures and videos, such as {films[0]}: must be one kind; name them apart"
            )
        yield from (_Shot(name=str(f.relative_to(path)), frame=read_picture(f), apart=True) for f in files)
    elif path.suffix.lower() in VIDEOS:
        try:
            video = read_video(path, Keep(height=0, stride=1, max_frames=0))
        except VideoError as error:
            raise SourceError(f"{path} {error}; convert or replace it") from error
        for i, frame in zip(video.index, video.frames, strict=True):
            yield _Shot(name=f"{path.name}#{i}", frame=frame, apart=bool(i == 0))
    else:
        yield _Shot(name=path.name, frame=read_picture(path), apart=True)


def _records(path: pathlib.Path, sensor: str, quality: QualityConfig) -> Iterator[_Shot]:
    """Camera frames of one sensor, contact by contact; gaps by their flags and their times."""
    store, found = RecordStore(path, allow_incomplete=True), False
    for i in range(len(store)):
        if sensor in store.sensors_of(i):
            sequence = store.contact(i, fields=False)[sensor]
            if sequence.frames is not None:
                found = True
                gaps = after_gap(sequence, quality).tolist()
                for n, (frame, gap) in enumerate(zip(sequence.frames, gaps, strict=True)):
                    yield _Shot(name=f"{sequence.name}#{n}", frame=frame, gap=gap, apart=n == 0)
    if not found:
        raise SourceError(f"{path} holds no camera frames of {sensor}: name another sensor or other records")
