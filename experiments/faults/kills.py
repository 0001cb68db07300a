"""Training killed again and again at random moments, and compared bit by bit with training that was not.

Sessions are processes that are forked from a server, which has imported everything and computed nothing, so that the
start of a session costs little; they are observed by the files that they leave, and `kill -9` ends them.
"""

import dataclasses
import json
import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.core import runs
from experiments.core.runner import main
from experiments.faults.digests import digests
from experiments.faults.trainings import PACKAGE
from touchr1_jax.training.compilation import FLAGS, OLDER_LOOPS, xla_flags

UNDISTURBED = "alone"  # name of the run that is not killed
POLL_S = 0.005  # time between two looks at a session's files; a step takes longer
PATIENCE_S = 300.0  # a session that adds nothing to its run for so long hangs

START, BETWEEN, CHECKPOINT = "start-up", "between stages", "writing a checkpoint"
PRINTED = "printed.txt"  # what the sessions of a run printed, in its home

STEPPING = {
    "encoders": "encoders' steps",
    "sft": "SFT steps",
    "decoder": "decoder's SFT steps",
    "grpo": "GRPO steps",
    "blind": "blind SFT steps",
    "count": "counting steps",
}
PHASES = (START, *STEPPING.values(), BETWEEN, CHECKPOINT)
"""Phases in which a kill can strike; between stages contacts are encoded, policies answer, the report is written."""

_PRIOR_SHARE = 0.05  # share of a run by which the pace of the undisturbed one counts
_JAX_CONFIG = {
    "jax_disable_most_optimizations": True,
    "jax_compilation_cache_max_size": 2**30,  # never reached; but without a bound JAX takes no lock on what it writes
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}

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
    """One kill: its phase, seconds of the session, share of the run's steps done, half a line left in the log."""

    phase: str
    after_s: float
    done: float
    torn: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class KillConfig:
    """Number of kills, and the share of them that strikes uniformly within the duration of the last start-up.

    The others strike within `KillSchedule.longest_life_s` of the first thing that a session adds to its run.
    """

    kills: int = 200
    startup_share: float = 0.25

    def __post_init__(self) -> None:
        if self.kills < 1 or not 0 <= self.startup_share < 1:
            raise ValueError(f"{self}: needs kills ≥ 1 and 0 ≤ startup_share < 1; correct what is outside")


class LogState(NamedTuple):
    """Number of whole lines in a run's log, stage and step of the last one, whether half a line follows."""

    lines: int
    last: tuple[str, int] | None
    torn: bool


def log_state(directory: Path) -> LogState:
    """State of the log of a run."""
    path = directory / "metrics.jsonl"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    whole, _, torn = text.rpartition("\n")
    lines = whole.split("\n") if whole else []
    row = json.loads(lines[-1]) if lines else None
    return LogState(lines=len(lines), last=None if row is None else (row["stage"], row["step"]), torn=bool(torn))


class RunSize(NamedTuple):
    """Bytes of a run's log and number of its answers: cheap, for they are read two hundred times a second."""

    log_bytes: int
    answers: int


class Session:
    """One session of a training, from its start."""

    def __init__(self, training: KillableTraining, home: Path, cache: Path, programs: Path) -> None:
        self._runs, self._steps, self._printed = home / training.name, training.steps, home / PRINTED
        home.mkdir(parents=True, exist_ok=True)
        self._directory: Path | None = None
        self._least = self._size()
        self._began, self._began_ns = time.monotonic(), time.time_ns()
        folders = ["--runs-dir", str(home), "--cache-dir", str(cache)]
        arguments = [training.name, *training.options, *folders]
        target = (arguments, str(self._printed), str(programs))
        self._process: BaseProcess = _SERVER.Process(target=_session, args=target, daemon=True)
        self._process.start()

    @property
    def age_s(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self._began

    def log_state(self) -> LogState:
        """State of the run's log now."""
        return LogState(0, None, False) if (found := self._found()) is None else log_state(found)

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
        """End it by SIGKILL; `None` if it ended just before."""
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
        code, printed = self.end()
        if code:
            raise RuntimeError(f"a session ended with exit code {code}; it printed:\n{printed[-2000:]}")

    def end(self) -> tuple[int, str]:
        """Wait for its end; its exit code, and what the sessions of its run printed."""
        self._process.join()
        return self._process.exitcode or 0, self._printed.read_text(encoding="utf-8", errors="replace")

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
            (self._directory,) = runs.started(self._runs)
        return self._directory


def _session(arguments: list[str], log: str, programs: str) -> None:
    """The process: compiled programs are kept however small, and little optimised, for sessions are short."""
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (sys.stdout.fileno(), sys.stderr.fileno()):
        os.dup2(file, stream)
    # read with the first program
    os.environ[FLAGS] = f"{xla_flags()} {OLDER_LOOPS}".strip()
    for name, value in (_JAX_CONFIG | {"jax_compilation_cache_dir": programs}).items():
        jax.config.update(name, value)
    sys.exit(main(arguments, package=PACKAGE))


class KillSchedule:
    """Longest lives of sessions, from the pace of those so far and the work that each kill lost.

    The pace begins with that of the undisturbed run, which worked `work_s` seconds; lives soon weigh more.
    """

    def __init__(self, work_s: float) -> None:
        self._gained, self._worked_s = _PRIOR_SHARE, _PRIOR_SHARE * work_s
        self._lost: list[float] = []

    def longest_life_s(self, done: float, left: int) -> float:
        """Longest time for which a session works before it is killed, 2 min((1 − d) / (k + 1) + l, .45 (1 − d)) / v.

        d is the share of the run that is done, k the number of kills that are left.  A kill loses the work since the
        last checkpoint, a share l of the run.  With lives uniform up to this bound, sessions keep on average so much
        that the kills last for the whole run, and even the last kill comes before the end.
        """
        lost = float(np.mean(self._lost)) if self._lost else 0.0
        share = min((1 - done) / (left + 1) + lost, 0.45 * (1 - done))
        return 2 * share * self._worked_s / self._gained

    def add_loss(self, reached: float, done: float) -> None:
        """Record that a session begins at a share of the run, of which the one before had reached more."""
        self._lost.append(max(0.0, reached - done))

    def add_life(self, gained: float, worked_s: float) -> None:
        """Record that a session added a share of the run in so many seconds."""
        self._gained, self._worked_s = self._gained + max(0.0, gained), self._worked_s + worked_s


class UndisturbedRun(NamedTuple):
    """A run without kills: its digests, lines of its log, seconds to its first line and from there to its end."""

    digests: Mapping[str, str]
    lines: int
    startup_s: float
    work_s: float


class Campaign:
    """Runs of one training, which share compiled programs and the records that the first one made.

    Everything else in a run's cache, such as trained policies, is its own and must be made again.
    """

    def __init__(self, home: Path, programs: Path, training: KillableTraining, config: KillConfig) -> None:
        self.home, self.programs, self._training, self._config = home, programs, training, config
        self._startup_s = 1.0  # until one was measured

    def run_undisturbed(self) -> UndisturbedRun:
        """A run without kills, from its beginning; it makes the records and compiles."""
        shutil.rmtree(self.home / UNDISTURBED, ignore_errors=True)  # an interrupted one gives no time
        session = self._session(UNDISTURBED)
        session.wait_for_work()
        began_s = session.age_s
        session.finish()
        directory = self.directory(UNDISTURBED)
        return UndisturbedRun(digests(directory), log_state(directory).lines, began_s, session.age_s - began_s)

    def run_killed(
        self,
        number: int,
        kills: int,
        undisturbed: UndisturbedRun,
        *,
        before: Sequence[Kill] = (),
        keep: Callable[[tuple[Kill, ...]], None] = lambda struck: None,
    ) -> tuple[Kill, ...]:
        """Start or continue a run and kill it until it ends, which it may after all kills have struck.

        `before` are the kills of an earlier session; `keep` is called after each kill with all that have struck.
        """
        struck, schedule = tuple(before), KillSchedule(undisturbed.work_s)
        home = self.home / str(number) / self._training.name
        while not any((directory / "results.json").exists() for directory in runs.started(home)):
            session = self._session(str(number))
            left = kills - len(struck)
            reached = next((kill.done for kill in reversed(struck) if kill.phase != START), 0.0)
            lives = left > 0 and self._wait(session, undisturbed.lines, number, left, schedule, reached)
            kill = session.kill(undisturbed.lines) if lives else None
            if kill is None:
                session.finish()
            else:
                struck = (*struck, kill)
                keep(struck)
        return struck

    def run_part(self, name: str, undisturbed: UndisturbedRun, share: float) -> Path:
        """The home of a run that was killed once it had logged a share of the undisturbed one's lines."""
        shutil.rmtree(self.home / name, ignore_errors=True)
        session = self._session(name)
        self._wait_for_lines(session, share * undisturbed.lines)
        session.kill(undisturbed.lines)
        return self.home / name

    def run_two(self, name: str, undisturbed: UndisturbedRun, moment: float) -> tuple[Path, Path, Kill | None]:
        """Two runs that begin together on one empty cache; the first is killed once and continued.

        The kill strikes at a share `moment` of the undisturbed run: of its start-up, in which it makes the records, and
        its lines.  Returns the two directories and the kill, `None` if the first run ended before.
        """
        one, other = f"{name}-killed", f"{name}-other"
        for home in (one, other):
            shutil.rmtree(self.home / home, ignore_errors=True)
        cache = self.home / one / "cache"
        killed, second = (Session(self._training, self.home / home, cache, self.programs) for home in (one, other))
        total_s = undisturbed.startup_s + undisturbed.work_s
        lines = (moment * total_s - undisturbed.startup_s) / undisturbed.work_s * undisturbed.lines
        if lines <= 0:
            killed.sleep_until(moment * total_s)
        else:
            self._wait_for_lines(killed, lines)
        kill = killed.kill(undisturbed.lines)
        if kill is not None:
            killed = Session(self._training, self.home / one, cache, self.programs)
        for session in (killed, second):
            session.finish()
        return self.directory(one), self.directory(other), kill

    def directory(self, name: str) -> Path:
        """The one run directory of that name."""
        (found,) = runs.started(self.home / name / self._training.name)
        return found

    def _session(self, name: str) -> Session:
        own = self.home / name / "cache"
        if not own.exists():
            own.mkdir(parents=True)
            for records in sorted((self.home / UNDISTURBED / "cache").glob("scenes-*")):
                shutil.copytree(records, own / records.name)
        return Session(self._training, self.home / name, own, self.programs)

    def _wait_for_lines(self, session: Session, lines: float) -> None:
        """Sleep until a session's run has logged so many lines, or the session has ended."""
        while session.log_state().lines < lines and session.sleep_until(session.age_s + POLL_S):
            pass

    def _wait(
        self, session: Session, lines: int, number: int, left: int, schedule: KillSchedule, reached: float
    ) -> bool:
        """Sleep until a random moment of the session's life; false if it ended first."""
        done_now = lambda: min(session.log_state().lines / lines, 1.0)
        rng = np.random.default_rng((0, number, left))
        if rng.random() < self._config.startup_share:
            return session.sleep_until(rng.uniform(0, self._startup_s))
        if not session.wait_for_work():
            return False
        self._startup_s, done = session.age_s, done_now()
        schedule.add_loss(reached, done)
        lives = session.sleep_until(self._startup_s + rng.uniform(0, schedule.longest_life_s(done, left)))
        schedule.add_life(done_now() - done, session.age_s - self._startup_s)
        return lives
