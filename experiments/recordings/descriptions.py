"""Descriptions of all videos of a folder, made once and cached."""

import dataclasses
import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from experiments.core.artifacts import write_bytes
from experiments.core.context import Context
from experiments.recordings.descriptors import describe, families
from experiments.recordings.policy import LANGUAGE
from experiments.recordings.touches import read_touch
from sensors_io.importers.keep import ImportSourceError, Skip
from sensors_io.importers.physiclear import read_labels
from sensors_io.importers.video import VideoError

VERSION = 1
"""Raised when a description changes, so that no cache outlives it."""

SUFFIXES = (".mov", ".mp4", ".avi", ".mkv")
"""What counts as a video in a folder that no table lists."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Described:
    """n videos: name, object, levels (−1 unknown) and description of each, and those that could not be read."""

    names: np.ndarray
    objects: np.ndarray
    label: Int[np.ndarray, "n A"]
    x: Float[np.ndarray, "n D"]
    skipped: tuple[Skip, ...]

    @property
    def family(self) -> np.ndarray:
        """Name of the family of each of the D numbers."""
        return np.array(families())

    def labelled(self) -> "Described":
        """The videos whose levels are all known."""
        return self.rows(np.flatnonzero((self.label >= 0).all(1)))

    def rows(self, chosen: np.ndarray) -> "Described":
        """Some of the videos."""
        take = {name: getattr(self, name)[chosen] for name in ("names", "objects", "label", "x")}
        return dataclasses.replace(self, **take)


def describe_source(source: Path, frames: int, context: Context, objects: int | None = None) -> Described:
    """Describe the videos of a folder that holds labels.json and videos/.

    Args:
      source: the folder.
      frames: frames in contact that are described of each video.
      context: its cache keeps the descriptions.
      objects: how many labelled objects to take, the first of the table; `None` takes all, unlabelled ones too.

    Raises:
      ImportSourceError: as `read_labels`, or not one readable video.
    """
    entries = read_labels(source / "labels.json")
    if objects is not None:
        known = [e for e in entries if all(e.card.labels[a.name] >= 0 for a in LANGUAGE.attributes)]
        entries = known[:objects]
    files = [source / "videos" / name for entry in entries for name in entry.videos]
    owner = np.array([entry.card.object_id for entry in entries for _ in entry.videos])
    levels = [[e.card.labels[a.name] for a in LANGUAGE.attributes] for e in entries for _ in e.videos]
    return _describe(files, owner, np.array(levels, np.int32).reshape(len(files), -1), frames, context)


def describe_folder(folder: Path, frames: int, context: Context) -> Described:
    """Describe the videos that lie in a folder, of which nothing is known.

    Raises:
      ImportSourceError: no such folder, no video in it, or not one that can be read.
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES) if folder.is_dir() else []
    if not files:
        raise ImportSourceError(f"predict is {folder}: must hold videos ({', '.join(SUFFIXES)}); correct it")
    unknown = np.full((len(files), len(LANGUAGE.attributes)), -1, np.int32)
    return _describe(files, np.array([p.name for p in files]), unknown, frames, context)


def _describe(
    files: Sequence[Path], objects: np.ndarray, label: np.ndarray, frames: int, context: Context
) -> Described:
    """Descriptions from the cache, made first where it lacks them."""
    sizes = [(str(p.resolve()), p.stat().st_size if p.is_file() else -1) for p in files]
    identity = hashlib.sha256(json.dumps([VERSION, frames, families(), sizes]).encode()).hexdigest()[:16]
    path = context.cache_dir / f"descriptions-{identity}.npz"
    if not path.exists():
        _make(files, frames, path, context)
    with np.load(path) as cached:
        x, reasons = cached["x"], cached["reasons"]
    read = np.flatnonzero(reasons == "")
    if not len(read):
        raise ImportSourceError(f"{files[0].parent}: no video can be read, the first {reasons[0]}; check the folder")
    skipped = tuple(Skip(name=file.name, reason=str(why)) for file, why in zip(files, reasons, strict=True) if why)
    names = np.array([p.name for p in files])
    return Described(names=names[read], objects=objects[read], label=label[read], x=x[read], skipped=skipped)


def _make(files: Sequence[Path], frames: int, path: Path, context: Context) -> None:
    """Read and describe every video; one that cannot be read leaves its reason."""
    x, reasons = np.zeros((len(files), len(families())), np.float32), []
    with context.progress("describing touches", len(files)) as advance, context.timed("descriptions"):
        for i, file in enumerate(files):
            try:
                x[i] = describe(read_touch(file, frames))
                reasons.append("")
            except VideoError as error:
                reasons.append(str(error))
            advance()
    buffer = io.BytesIO()
    np.savez_compressed(buffer, x=x, reasons=np.array(reasons))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, buffer.getvalue())
