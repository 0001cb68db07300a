"""Training killed again and again at random moments, and compared bit by bit with training that was not."""

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.core import runs
from experiments.faults.digests import digests
from experiments.faults.sessions import START, Kill, KillableTraining, Session, log_state, only_run

UNDISTURBED = "alone"
"""Name of the run that is not killed."""

RECORDS = "scenes-*"
"""Folders of a cache that hold records."""

_PRIOR_SHARE = 0.05  # share of a run by which the pace of the undisturbed one counts


@dataclasses.dataclass(frozen=True, kw_only=True)
class KillConfig:
    """Number and moments of the kills.

    A share of them strikes uniformly within the duration of the last start-up, the others within
    `KillSchedule.longest_life_s` of the first thing that a session adds to its run.

    Args:
      kills: how many.
      startup_share: share that strikes while a session starts.
      seed: of the moments.
    """

    kills: int = 200
    startup_share: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kills < 1 or not 0 <= self.startup_share < 1:
            raise ValueError(
                f"{self}: needs kills ≥ 1 and 0 ≤ startup_share < 1, else no session gets anywhere; correct what is "
                "outside"
            )


class KillSchedule:
    """Longest lives of sessions, from the pace of those so far and the work that each kill lost.

    Args:
      work_s: seconds that the undisturbed run worked; lives soon weigh more.
    """

    def __init__(self, work_s: float) -> None:
        self._gained, self._worked_s = _PRIOR_SHARE, _PRIOR_SHARE * work_s
        self._lost: list[float] = []

    def longest_life_s(self, done: float, left: int) -> float:
        """Longest time for which a session works before it is killed, 2 min((1 − d) / (k + 1) + l, .45 (1 − d)) / v.

        A kill loses the work since the last checkpoint, a share l of the run.  With lives uniform up to this bound,
        sessions keep on average so much that the kills last for the whole run, and even the last kill comes before the
        end.

        Args:
          done: d, share of the run that is done when the session begins to work.
          left: k, kills that are left.
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
    """A run without kills: its digests, lines of its log, seconds from its first line to its end."""

    digests: Mapping[str, str]
    lines: int
    work_s: float


class Campaign:
    """Runs of one training, which share compiled programs and the records that the first one made.

    Everything else in a run's cache, such as trained policies, is its own and must be made again.

    Args:
      home: folder of the runs.
      programs: folder of compiled programs.
      training: to run.
      config: moments of the kills.
    """

    def __init__(self, home: Path, programs: Path, training: KillableTraining, config: KillConfig) -> None:
        self._home, self._programs, self._training, self._config = home, programs, training, config
        self._startup_s = 1.0  # until one was measured

    def run_undisturbed(self) -> UndisturbedRun:
        """A run without kills, from its beginning; it makes the records and compiles."""
        shutil.rmtree(self._home / UNDISTURBED, ignore_errors=True)  # an interrupted one gives no time
        session = self._session(UNDISTURBED)
        session.wait_for_work()
        began_s = session.age_s
        session.finish()
        directory = self.directory(UNDISTURBED)
        return UndisturbedRun(digests(directory), log_state(directory).lines, session.age_s - began_s)

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

        Args:
          number: of the run.
          kills: that shall strike it.
          undisturbed: gives pace and length of a run.
          before: kills that struck it in an earlier session of the caller.
          keep: called after each kill with all that have struck.
        """
        struck, schedule = tuple(before), KillSchedule(undisturbed.work_s)
        while not self._ended(number):
            session = self._session(str(number))
            left = kills - len(struck)
            reached = next((kill.done for kill in reversed(struck) if kill.phase != START), 0.0)
            lives = left > 0 and self._wait(session, undisturbed, number, left, schedule, reached)
            kill = session.kill(undisturbed.lines) if lives else None
            if kill is None:
                session.finish()
            else:
                struck = (*struck, kill)
                keep(struck)
        return struck

    def directory(self, name: str) -> Path:
        """The one run directory of that name."""
        return only_run(self._home / name / self._training.name)

    def _ended(self, number: int) -> bool:
        begun = runs.started(self._home / str(number) / self._training.name)
        return any((directory / "results.json").exists() for directory in begun)

    def _session(self, name: str) -> Session:
        own = self._home / name / "cache"
        if not own.exists():
            own.mkdir(parents=True)
            for records in sorted((self._home / UNDISTURBED / "cache").glob(RECORDS)):
                shutil.copytree(records, own / records.name)
        return Session(self._training, self._home / name, self._programs)

    def _wait(
        self,
        session: Session,
        undisturbed: UndisturbedRun,
        number: int,
        left: int,
        schedule: KillSchedule,
        reached: float,
    ) -> bool:
        """Sleep until a random moment of the session's life; false if it ended first."""
        done_now = lambda: min(session.log_state().lines / undisturbed.lines, 1.0)
        rng = np.random.default_rng((self._config.seed, number, left))
        if rng.random() < self._config.startup_share:
            return session.sleep_until(rng.uniform(0, self._startup_s))
        if not session.wait_for_work():
            return False
        self._startup_s, done = session.age_s, done_now()
        schedule.add_loss(reached, done)
        lives = session.sleep_until(self._startup_s + rng.uniform(0, schedule.longest_life_s(done, left)))
        schedule.add_life(done_now() - done, session.age_s - self._startup_s)
        return lives
