"""Every file of an unfinished run, damaged in four ways: the run ends the same or names the damage."""

import contextlib
import dataclasses
import io
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from experiments.core.context import Context
from experiments.faults.digests import differences, digests
from experiments.faults.fixtures import cut, emptied, flipped, newest_checkpoints, run_counting, run_directory

DAMAGES: Mapping[str, Callable[[Path], None]] = {
    "a byte flipped": flipped,
    "cut in half": cut,
    "emptied": emptied,
    "removed": Path.unlink,
}

SAME, OLDER, NAMED, WRONG = "same end", "same end from an older checkpoint", "named error", "WRONG"
OUTCOMES = (SAME, OLDER, NAMED, WRONG)
"""Ends of a run with a damaged file; the last is a different end, or one that used half a file."""

RUN_FILES = ("config.json", "metrics.jsonl", "timing.json")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Damage:
    """One damaged file: its kind, the damage, the end of the run, the first line that names an error or the damage."""

    file: str
    damage: str
    outcome: str
    message: str


def damage_each(unfinished: Path, scratch: Path, context: Context, most: int | None = None) -> Iterator[Damage]:
    """Damage each file in a copy of an unfinished run, continue it, and compare its end with an undamaged copy's."""
    whole = scratch / "whole"
    shutil.copytree(unfinished, whole, symlinks=True)
    _continued(whole)
    wanted = digests(run_directory(whole))
    files = [path for path in sorted(newest_checkpoints(unfinished)[0].rglob("*")) if path.is_file()]
    files += [run_directory(unfinished) / name for name in RUN_FILES]
    every = [
        (i, path, damage)
        for i, path in enumerate(files[:most])
        for damage in DAMAGES
        if path.stat().st_size or damage == "removed"
    ]
    for i, path, damage in context.each("damaging files", every, still=True):  # the run's own output is captured
        folder = scratch / f"{i}-{damage.replace(' ', '-')}"
        shutil.copytree(unfinished, folder, symlinks=True)
        DAMAGES[damage](folder / path.relative_to(unfinished))
        code, output = _continued(folder)
        message = next((s for s in output.splitlines() if "Error" in s or "is kept as damaged" in s), "")
        outcome = _outcome(folder, code, output, wanted)
        yield Damage(file=_kind(path), damage=damage, outcome=outcome, message=message)
        shutil.rmtree(folder)


def _continued(folder: Path) -> tuple[int, str]:
    """Exit code and output of the run's next session."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run_counting(folder)
    return code, err.getvalue() + out.getvalue()


def _outcome(folder: Path, code: int, output: str, wanted: Mapping[str, str]) -> str:
    if code:
        return NAMED if "Error: " in output else WRONG
    ends = [p.parent for p in (folder / "runs" / "counting").glob("*/results.json") if not p.parent.is_symlink()]
    if len(ends) != 1 or differences(wanted, digests(ends[0])):
        return WRONG
    return OLDER if "is kept as damaged" in output else SAME


def _kind(path: Path) -> str:
    """The file's path in its run without names that differ from run to run."""
    if path.name in RUN_FILES:
        return path.name
    parts = path.parts[path.parts.index("0") + 2 :]
    return "/".join("…" if len(part) == len("05c2807404c774a4f452cd782f58e8b6") else part for part in parts)
