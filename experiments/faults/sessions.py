"""Sessions of a training in processes of their own, observed from outside by the files that they leave, and killed.

Processes are forked from a server that has imported everything and computed nothing, so that the start of a session
costs little; `kill -9` ends it as it would any other process.
"""

import dataclasses
import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import jax

from experiments.core import runs
from experiments.core.runner import main
from experiments.faults.trainings import PACKAGE

POLL_S = 0.005
"""Time between two looks at a session's files; a step takes longer."""

PATIENCE_S = 300.0
"""A session that adds nothing to its run for so long hangs."""

START, BETWEEN, CHECKPOINT = "start-up", "between stages", "writing a checkpoint"
STEPPING = {"sft": "SFT steps", "grpo": "GRPO steps", "blind": "blind SFT steps", "count": "steps"}
PHASES = (START, *STEPPING.values(), BETWEEN, CHECKPOINT)
"""Phases in which a kill can strike; between stages contacts are encoded, policies answer, the report is written."""

_FAST_COMPILATION = "--xla_cpu_use_fusion_emitters=false" if jax.__version_info__ < (0, 11) else ""
_PROGRAMS_BYTES = 2**30  # never reached; but without a bound JAX takes no lock on what it writes

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload([f"{PACKAGE}.{name}" for name in ("small_study", "small_grpo", "counting")])


@dataclasses.dataclass(frozen=True, kw_only=True)
class KillableTraining:
    """A training to kill: an experiment of `trainings`, its options, and the steps of each of its phases."""

    name: str
    options: tuple[str, ...]
    steps: Mapping[str, int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kill:
    """One kill.

    Args:
      phase: of `PHASES`, in which it struck.
      after_s: seconds since the session began.
      done: share of the run's steps done by then.
      torn: whether it left half a line in the log.
    """

    phase: str
    after_s: float
    done: float
    torn: bool


class RunSize(NamedTuple):
    """Bytes of a run's log and number of its answers: cheap, for they are read two hundred times a second."""

    log_bytes: int
    answers: int


class LogState(NamedTuple):
    """Number of whole lines in a run's log, stage and step of the last one, whether half a line follows."""

    lines: int
    last: tuple[str, int] | None
    torn: bool


class Session:
    """One session of a training, from its start.

    Args:
      training: to run or continue.
      home: folder of its run.
      programs: folder of compiled programs.
    """

    def __init__(self, training: KillableTraining, home: Path, programs: Path) -> None:
        self._runs, self._steps, self._printed = home / training.name, training.steps, home / "printed.txt"
        home.mkdir(parents=True, exist_ok=True)
        self._directory: Path | None = None
        self._least = self._size()
        self._began, self._began_ns = time.monotonic(), time.time_ns()
        folders = ["--runs-dir", str(home), "--cache-dir", str(home / "cache")]
        self._process = _start([training.name, *training.options, *folders], self._printed, programs)

    @property
    def age_s(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self._began

    def log_state(self) -> LogState:
        """State of the run's log now."""
        return LogState(0, None, False) if self._found() is None else log_state(only_run(self._runs))

    def wait_for_work(self) -> bool:
        """Sleep until it adds something to its run; false if it ended first.

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
        """Sleep until it has this age, looking at its run on the way; false if it ended first."""
        while (left_s := age_s - self.age_s) > 0 and self._process.is_alive():
            self._process.join(min(left_s, POLL_S))
            self._worked()
        return self._process.is_alive()

    def kill(self, lines: int) -> Kill | None:
        """End it by SIGKILL; `None` if it ended just before.

        Args:
          lines: of the log of a whole run.
        """
        age_s = self.age_s
        self._process.kill()
        self._process.join()
        if self._process.exitcode != -signal.SIGKILL:
            return None
        log = self.log_state()
        return Kill(phase=self._phase(log), after_s=age_s, done=min(log.lines / lines, 1.0), torn=log.torn)

    def finish(self) -> None:
        """Wait for its end.

        Raises:
          RuntimeError: its exit code is not 0.
        """
        self._process.join()
        if self._process.exitcode:
            tail = self._printed.read_text(encoding="utf-8", errors="replace")[-2000:]
            raise RuntimeError(f"a session ended with exit code {self._process.exitcode}; it printed:\n{tail}")

    def _worked(self) -> bool:
        """True if it added anything; lines that it first dropped and computes again do not count."""
        size = self._size()
        if size.log_bytes < self._least.log_bytes:
            self._least = self._least._replace(log_bytes=size.log_bytes)
        return size.log_bytes > self._least.log_bytes or size.answers > self._least.answers

    def _phase(self, log: LogState) -> str:
        half = self._runs.glob("*/checkpoints/**/*.orbax-checkpoint-tmp*")
        if any(path.stat().st_mtime_ns >= self._began_ns for path in half):
            return CHECKPOINT
        if not self._worked():
            return START
        if log.last is None or self._size().log_bytes == self._least.log_bytes:
            return BETWEEN
        stage, step = log.last
        kind = stage.partition("/")[0]
        return STEPPING[kind] if step + 1 < self._steps[kind] else BETWEEN

    def _size(self) -> RunSize:
        directory = self._found()
        if directory is None:
            return RunSize(0, 0)
        log = directory / "metrics.jsonl"
        return RunSize(log.stat().st_size if log.exists() else 0, len(list((directory / "answers").glob("*.npz"))))

    def _found(self) -> Path | None:
        """The run's directory, once it was started."""
        if self._directory is None and runs.started(self._runs):
            self._directory = only_run(self._runs)
        return self._directory


def only_run(home: Path) -> Path:
    """The one run that was started in a folder; a session may have been killed before its run had a configuration."""
    (found,) = runs.started(home)
    return found


def log_state(directory: Path) -> LogState:
    """State of the log of a run."""
    path = directory / "metrics.jsonl"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    whole, _, torn = text.rpartition("\n")
    lines = whole.split("\n") if whole else []
    row = json.loads(lines[-1]) if lines else None
    return LogState(lines=len(lines), last=None if row is None else (row["stage"], row["step"]), torn=bool(torn))


def _start(arguments: list[str], log: Path, programs: Path) -> BaseProcess:
    process = _SERVER.Process(target=_session, args=(arguments, str(log), str(programs)), daemon=True)
    process.start()
    return process


def _session(arguments: list[str], log: str, programs: str) -> None:
    """The process: compiled programs are kept however small, and little optimised, for sessions are short."""
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (sys.stdout.fileno(), sys.stderr.fileno()):
        os.dup2(file, stream)
    # read with the first program: the older of XLA's two ways to write a loop compiles twice as fast
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_FAST_COMPILATION}".strip()
    jax.config.update("jax_disable_most_optimizations", True)
    jax.config.update("jax_compilation_cache_dir", programs)
    jax.config.update("jax_compilation_cache_max_size", _PROGRAMS_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    sys.exit(main(arguments, package=PACKAGE))
