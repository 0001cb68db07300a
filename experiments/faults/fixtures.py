"""The smallest good inputs, and functions that damage them."""

import contextlib
import io
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from experiments.core.runner import main
from experiments.faults.trainings import PACKAGE
from sensors_io.records import RecordsMeta, RecordWriter
from sensors_io.schema import ContactKey, ObjectCard, Sequence

COUNTING = "trainings counting --runs-dir {folder}/runs --cache-dir {folder}/cache"
"""The command line that runs or continues `counting` in a folder."""

META = RecordsMeta(source="made up", licence="that of this code", config_hash="made up", sensors=("xense",))


def write_records(folder: Path, *, complete: bool = True) -> None:
    """Records of two contacts by one sensor, each in a shard of its own, in `folder/records`."""
    with contextlib.suppress(_Enough), RecordWriter(folder / "records", meta=META, contacts_per_shard=1) as writer:
        for n in range(2):
            writer.write_object(ObjectCard(object_id=f"object_{n}", split="train", labels={}, annotator="nobody"))
            writer.write_contact([_press(n)])
        if not complete:
            raise _Enough


def write_pictures(folder: Path) -> None:
    """Two pictures of different sizes, and a file that is not a picture."""
    for name, shape in (("press", (120, 160, 3)), ("rest", (96, 128, 3))):
        picture = np.random.default_rng(0).integers(80, 120, shape, np.uint8)
        cv2.imwrite(str(folder / f"{name}.png"), cv2.GaussianBlur(picture, (5, 5), 2))
    (folder / "none.png").write_bytes(b"a picture of nothing")


def unfinished_run(folder: Path) -> None:
    """A run of `counting` in `folder/runs` that has two checkpoints and no results."""
    with contextlib.redirect_stdout(io.StringIO()):
        code = run_counting(folder)
    if code:
        raise RuntimeError(f"the run to be damaged ended with exit code {code}: must end well; correct `counting`")
    run_directory(folder).joinpath("results.json").unlink()


def run_counting(folder: Path, *options: str) -> int:
    """Run or continue `counting` in `folder/runs`; returns the exit code."""
    folders = ["--runs-dir", str(folder / "runs"), "--cache-dir", str(folder / "cache")]
    return main(["counting", *folders, *options], package=PACKAGE)


def run_directory(folder: Path) -> Path:
    """The one run of `counting`."""
    runs = folder / "runs" / "counting"
    (found,) = (path for path in runs.iterdir() if path.is_dir() and not path.is_symlink())
    return found


def newest_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of the run, the newest first."""
    stage = run_directory(folder) / "checkpoints" / "count" / "0"
    return sorted((p for p in stage.iterdir() if p.name.isdigit()), key=lambda p: -int(p.name))


def flipped(path: Path) -> None:
    """Flip all bits of one byte, the middle one of those that are not 0, which may be padding."""
    content = bytearray(path.read_bytes())
    data = np.flatnonzero(np.frombuffer(content, np.uint8))
    content[data[len(data) // 2]] ^= 255
    path.write_bytes(content)


def flip_bit(path: Path, bit: int) -> None:
    """Flip one bit of a file."""
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def cut(path: Path) -> None:
    """Leave the first half of a file."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def emptied(path: Path) -> None:
    """Remove the content of a file."""
    path.write_bytes(b"")


def replaced(path: Path, old: str, new: str) -> None:
    """Replace a text in a file, which must hold it."""
    text = path.read_text(encoding="utf-8")
    if old not in text:
        raise ValueError(f"{path} holds no {old!r}: must hold the text to replace; correct the case")
    path.write_text(text.replace(old, new), encoding="utf-8")


@contextlib.contextmanager
def full_disk(folder: Path, most_bytes: int = 6_000) -> Iterator[None]:
    """No file can grow past so many bytes, as on a disk without space; the error's number is another (EFBIG).

    The counting run's small files fit; its report, which grows with its log, does not.  Python compiles no module to
    a file meanwhile: one that is cut off breaks every later import.
    """
    del folder
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = before


class _Enough(Exception):
    """Stops a writer before its end."""


def _press(n: int) -> Sequence:
    frames = np.random.default_rng(n).integers(0, 256, (4, 8, 8, 3), np.uint8)
    return Sequence(
        key=ContactKey(object_id=f"object_{n}", site=0, motion="press", trial=0),
        sensor="xense",
        frames=frames,
        host_time_ns=np.arange(4, dtype=np.int64) * 40_000_000,
        phase=np.ones(4, np.uint8),
        flags=np.zeros(4, np.uint32),
    )
