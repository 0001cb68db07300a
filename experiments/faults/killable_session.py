"""A session of a victim that is watched from outside, by the files that it leaves, and killed."""

import dataclasses
import json
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from experiments.core import runs
from experiments.faults.forked_sessions import start

POLL_S = 0.005
"""How often a session's files are looked at; a step takes longer."""

PATIENCE_S = 300.0
"""A session that has done nothing for so long hangs."""

START, BETWEEN, CHECKPOINT = "start-up", "between stages", "writing a checkpoint"
STEPPING = {"sft": "SFT steps", "grpo": "GRPO steps", "blind": "blind SFT steps", "count": "steps"}
PHASES = (START, *STEPPING.values(), BETWEEN, CHECKPOINT)
"""Where a kill can strike; between stages contacts are encoded, policies are asked, the report is written."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class KillableTraining:
    """A run to kill: an experiment of this package, its options, and the steps of each phase of it."""

    name: str
    options: tuple[str, ...]
    steps: Mapping[str, int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kill:
    """One kill: the phase that it struck, seconds since the session began, share of the run's steps done by then.

    `torn` says whether it left half a line in the log.
    """

    phase: str
    after_s: float
    done: float
    torn: bool


class RunSize(NamedTuple):
    """How much a run holds: bytes of its log, and answers.  Cheap, for it is asked two hundred times a second."""

    log_bytes: int
    answers: int


class LogState(NamedTuple):
    """What a run's log says: its whole lines, the last of them, whether half a line follows."""

    lines: int
    last: tuple[str, int] | None
    torn: bool


class Session:
    """One session of a victim.

    Args:
      victim: what is run.
      home: folder of its run.
      programs: folder of compiled programs.
    """

    def __init__(self, victim: KillableTraining, home: Path, programs: Path) -> None:
        self._runs, self._steps, self._printed = home / victim.name, victim.steps, home / "printed.txt"
        home.mkdir(parents=True, exist_ok=True)
        self._directory: Path | None = None
        self._least = self._size()
        self._began, self._began_ns = time.monotonic(), time.time_ns()
        folders = ["--runs-dir", str(home), "--cache-dir", str(home / "cache")]
        self._process = start([victim.name, *victim.options, *folders], self._printed, programs)

    @property
    def age_s(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self._began

    def seen(self) -> LogState:
        """What the log says now."""
        return LogState(0, None, False) if self._found() is None else look(only(self._runs))

    def wait_for_work(self) -> bool:
        """Sleep until it adds something to its run; whether it lives then.

        Raises:
          RuntimeError: it lives and adds nothing.
        """
        while not self._worked():
            if not self.sleep_until(self.age_s + POLL_S):
                return False
            if self.age_s > PATIENCE_S:
                raise RuntimeError(f"a session did nothing in {PATIENCE_S:g} s: see {self._printed}")
        return True

    def sleep_until(self, age_s: float) -> bool:
        """Sleep until it is so old, looking at its run on the way; whether it lives then."""
        while (left_s := age_s - self.age_s) > 0 and self._process.is_alive():
            self._process.join(min(left_s, POLL_S))
            self._worked()
        return self._process.is_alive()

    def kill(self, lines: int) -> Kill | None:
        """End it by SIGKILL; `None` if it ended just before.  The log of a whole run has so many lines."""
        age_s = self.age_s
        self._process.kill()
        self._process.join()
        if self._process.exitcode != -signal.SIGKILL:
            return None
        seen = self.seen()
        return Kill(phase=self._phase(seen), after_s=age_s, done=min(seen.lines / lines, 1.0), torn=seen.torn)

    def finish(self) -> None:
        """Wait for its end.

        Raises:
          RuntimeError: it did not end well.
        """
        self._process.join()
        if self._process.exitcode:
            tail = self._printed.read_text(encoding="utf-8", errors="replace")[-2000:]
            raise RuntimeError(f"a session ended with exit code {self._process.exitcode}; it printed:\n{tail}")

    def _worked(self) -> bool:
        """Whether it added anything; lines that it first dropped, which it computes again, do not count."""
        size = self._size()
        if size.log_bytes < self._least.log_bytes:
            self._least = self._least._replace(log_bytes=size.log_bytes)
        return size.log_bytes > self._least.log_bytes or size.answers > self._least.answers

    def _phase(self, seen: LogState) -> str:
        if self._writing():
            return CHECKPOINT
        if not self._worked():
            return START
        if seen.last is None or self._size().log_bytes == self._least.log_bytes:
            return BETWEEN
        stage, step = seen.last
        kind = stage.partition("/")[0]
        return STEPPING[kind] if step + 1 < self._steps[kind] else BETWEEN

    def _writing(self) -> bool:
        """Whether it left half a checkpoint."""
        half = self._runs.glob("*/checkpoints/**/*.orbax-checkpoint-tmp*")
        return any(path.stat().st_mtime_ns >= self._began_ns for path in half)

    def _size(self) -> RunSize:
        directory = self._found()
        if directory is None:
            return RunSize(0, 0)
        log = directory / "metrics.jsonl"
        return RunSize(log.stat().st_size if log.exists() else 0, len(list((directory / "answers").glob("*.npz"))))

    def _found(self) -> Path | None:
        """The run's directory, once it was started."""
        if self._directory is None and runs.started(self._runs):
            self._directory = only(self._runs)
        return self._directory


def only(home: Path) -> Path:
    """The one run that was started in a folder; a session may have been killed before its run had a configuration."""
    (found,) = runs.started(home)
    return found


def look(directory: Path) -> LogState:
    """What the log of a run says now."""
    path = directory / "metrics.jsonl"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    whole, _, torn = text.rpartition("\n")
    lines = whole.split("\n") if whole else []
    row = json.loads(lines[-1]) if lines else None
    return LogState(lines=len(lines), last=None if row is None else (row["stage"], row["step"]), torn=bool(torn))
