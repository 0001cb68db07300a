"""Files of an unfinished run, damaged in four ways: the run ends the same or names the damage."""

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
    """Damage each of at most so many files in a copy of an unfinished run, continue it, compare its end."""
    whole = scratch / "whole"
    shutil.copytree(unfinished, whole, symlinks=True)
    _continued(whole)
    wanted = digests(run_directory(whole))
    files = [path for path in sorted(newest_checkpoints(unfinished)[0].rglob("*")) if path.is_file()]
    files += [run_directory(unfinished) / name for name in RUN_FILES]
    full = [path for path in files if path.stat().st_size]
    every = [(path, how) for path in files[:most] for how in DAMAGES.items() if path in full or how[0] == "removed"]
    # the run's own output is captured
    for i, (path, (damage, apply)) in context.each("damaging files", enumerate(every), still=True):
        folder = scratch / str(i)
        shutil.copytree(unfinished, folder, symlinks=True)
        apply(folder / path.relative_to(unfinished))
        code, output = _continued(folder)
        outcome = end_of_run(folder / "runs" / "counting", code, output, wanted)
        yield Damage(file=_kind(path), damage=damage, outcome=outcome, message=telling_line(output, scratch))
        shutil.rmtree(folder)


def _continued(folder: Path) -> tuple[int, str]:
    """Exit code and output of the run's next session."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run_counting(folder)
    return code, err.getvalue() + out.getvalue()


def telling_line(output: str, scratch: Path) -> str:
    """The first line that a session printed about an error or damage, without the path of the scratch folder."""
    found = next((line for line in output.splitlines() if "Error" in line or " damaged" in line), "")
    return found.replace(str(scratch), "…")


def end_of_run(runs: Path, code: int, output: str, wanted: Mapping[str, str]) -> str:
    """The outcome of a run with damage by the session that continued it; `wanted` are digests of an undamaged run."""
    if code:
        return NAMED if "Error: " in output and "Traceback" not in output else WRONG
    ends = [path.parent for path in runs.glob("*/results.json") if not path.parent.is_symlink()]
    if len(ends) != 1 or differences(wanted, digests(ends[0])):
        return WRONG
    return OLDER if "is kept as damaged" in output else SAME


def _kind(path: Path) -> str:
    """The file's path in its run without names that differ from run to run."""
    if path.name in RUN_FILES:
        return path.name
    parts = path.parts[path.parts.index("0") + 2 :]
    return "/".join("…" if len(part) == len("05c2807404c774a4f452cd782f58e8b6") else part for part in parts)
