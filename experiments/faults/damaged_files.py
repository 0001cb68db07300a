"""Every file of a run that is about to go on, damaged in four ways: the same end, or a word about what is wrong."""

import contextlib
import dataclasses
import io
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from experiments.core.context import Context
from experiments.core.runner import main
from experiments.faults.digests import differences, digests
from experiments.faults.fixtures import counting_paths, cut, emptied, flipped, newest_checkpoints, run_directory
from experiments.faults.trainings import PACKAGE

WAYS: Mapping[str, Callable[[Path], None]] = {
    "a byte flipped": flipped,
    "cut in half": cut,
    "emptied": emptied,
    "removed": lambda path: path.unlink(),
}

SAME, OLDER, NAMED, WRONG = "same end", "same end from an older checkpoint", "named error", "WRONG"
OUTCOMES = (SAME, OLDER, NAMED, WRONG)
"""What a damaged run can come to; the last is another end, or one that half a file took part in."""

RUN_FILES = ("config.json", "metrics.jsonl", "timing.json")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Damage:
    """One damaged file: what it is, how it was damaged, what the run came to, what was said."""

    file: str
    way: str
    outcome: str
    said: str


def strike(unfinished: Path, scratch: Path, context: Context, most: int | None = None) -> Iterator[Damage]:
    """Damage a copy of the run, go on with it, and compare its end with the one that it would have had.

    Args:
      unfinished: a folder that `inputs.unfinished_run` filled.
      scratch: an empty folder.
      context: shows how far it is.
      most: so many files at most; `None` takes all.
    """
    whole = scratch / "whole"
    shutil.copytree(unfinished, whole, symlinks=True)
    _go_on(whole)
    wanted = digests(run_directory(whole))
    files = enumerate(_files(unfinished)[:most])
    every = [(i, path, way) for i, path in files for way in WAYS if path.stat().st_size or way == "removed"]
    with context.progress("damaging files", len(every), still=True) as advance:  # what a run prints is caught
        for i, path, way in every:
            folder = scratch / f"{i}-{way.replace(' ', '-')}"
            shutil.copytree(unfinished, folder, symlinks=True)
            WAYS[way](folder / path.relative_to(unfinished))
            code, said = _go_on(folder)
            yield Damage(file=_kind(path), way=way, outcome=_outcome(folder, code, said, wanted), said=said)
            shutil.rmtree(folder)
            advance()


def _go_on(folder: Path) -> tuple[int, str]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["counting", *counting_paths(folder)], package=PACKAGE)
    return code, err.getvalue() + out.getvalue()


def _outcome(folder: Path, code: int, said: str, wanted: Mapping[str, str]) -> str:
    if code:
        return NAMED if "Error: " in said else WRONG
    finished = [p for p in (folder / "runs" / "counting").iterdir() if (p / "results.json").exists()]
    ends = {p for p in finished if not p.is_symlink()}
    if len(ends) != 1 or differences(wanted, digests(ends.pop())):
        return WRONG
    return OLDER if "is kept as damaged" in said else SAME


def _files(unfinished: Path) -> list[Path]:
    """Of the newest checkpoint all, of the run those that its next session reads."""
    files = [path for path in sorted(newest_checkpoints(unfinished)[0].rglob("*")) if path.is_file()]
    return [*files, *(run_directory(unfinished) / name for name in RUN_FILES)]


def _kind(path: Path) -> str:
    """Name of a file without what differs from run to run."""
    if path.name in RUN_FILES:
        return path.name
    parts = path.parts[path.parts.index("0") + 2 :]
    return "/".join("…" if len(part) == len("05c2807404c774a4f452cd782f58e8b6") else part for part in parts)
