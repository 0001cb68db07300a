"""Bad input as a case: what is prepared, which command meets it, and what must come of it."""

import contextlib
import dataclasses
import hashlib
import io
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from experiments.bench import __main__ as bench
from experiments.core import runner
from experiments.faults.trainings import PACKAGE
from sensors_io import __main__ as sensors_io
from touchr1_jax.rewards import __main__ as rewards

Program = Literal["experiments", "faults", "sensors_io", "bench", "rewards"]
Kind = Literal["command line", "configuration", "records", "recordings", "run", "checkpoint", "answers", "disk"]

PROGRAMS: Mapping[Program, Callable[[list[str]], int]] = {
    "experiments": runner.main,
    "faults": lambda arguments: runner.main(arguments, package=PACKAGE),
    "sensors_io": sensors_io.main,
    "bench": bench.main,
    "rewards": rewards.main,
}

GOING_ON = frozenset({"metrics.jsonl", "timing.json", "report.html"})
"""Files of a run that a session rewrites as it goes on, whole each time."""


LOCKS = frozenset({".lock", ".lockfile"})
"""Empty files that are held, not read: a run's, records', and the compiled programs'."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class BadInput:
    """One kind of bad input.

    Args:
      kind: what is bad.
      name: what about it.
      program, arguments: the command, from the folder that it works in.
      prepare: puts the input into that folder.
      error: name of the error; empty where the answer to a command line is enough.
      where, fix: what the message must say of the place and of the way out.
      around: what holds while the command runs, such as a limit.
    """

    kind: Kind
    name: str
    program: Program
    arguments: Callable[[Path], Sequence[str | Path]]
    prepare: Callable[[Path], None] = lambda folder: None
    error: str
    where: str
    fix: str
    around: Callable[[Path], contextlib.AbstractContextManager[None]] = lambda folder: contextlib.nullcontext()


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputOutcome:
    """What came of a case: exit code, what was said, and files that were lost or left half-written."""

    case: BadInput
    code: int
    said: str
    lost: tuple[str, ...]
    half: tuple[str, ...]

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong with it; empty where the input was answered as it must be."""
        wanted = {"error": self.case.error, "place": self.case.where, "fix": self.case.fix}
        said = [f"the message names no {name} {text!r}" for name, text in wanted.items() if text not in self.said]
        code = ["the exit code is 0"] if self.code == 0 else []
        return (*code, *said, *(f"lost {name}" for name in self.lost), *(f"half-written {name}" for name in self.half))

    @property
    def line(self) -> str:
        """The line that names the place, or else the error."""
        lines = [line.strip(" │") for line in self.said.splitlines()]
        named = [line for text in (self.case.where, self.case.error) for line in lines if text in line]
        return named[0] if named else ""


def provoke(case: BadInput, folder: Path) -> InputOutcome:
    """Prepare a case in an empty folder, run its command in this process, and look at what is left."""
    case.prepare(folder)
    before = contents(folder)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), case.around(folder):
        code = _exit_code(PROGRAMS[case.program], [str(a) for a in case.arguments(folder)])
    after = contents(folder)
    kept = set(after.values())
    return InputOutcome(
        case=case,
        code=code,
        said=err.getvalue() + out.getvalue(),
        lost=tuple(name for name, digest in before.items() if digest not in kept and Path(name).name not in GOING_ON),
        half=tuple(name for name in after if name not in before and _half_written(name)),
    )


def contents(folder: Path) -> dict[str, str]:
    """SHA-256 of every readable file below a folder, by path; locks and links are none."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if path.name not in LOCKS
    }


def _exit_code(program: Callable[[list[str]], int], arguments: list[str]) -> int:
    """As the shell would see it; an exception is what an interpreter prints and exits with."""
    try:
        return program(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    except Exception as error:  # the interpreter itself would print it
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return 1


def _half_written(name: str) -> bool:
    parts = Path(name).parts
    return any(part.startswith(".") or "tmp" in part for part in parts) and parts[-1] not in LOCKS
