"""Training killed again and again at random moments, held bit by bit to training that was left alone."""

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.core import runs
from experiments.faults.digests import digests
from experiments.faults.killable_session import START, Kill, KillableTraining, Session, look, only

ALONE = "alone"
"""Name of the run that is not killed."""

RECORDS = "scenes-*"
"""Folders of a cache that hold records."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class KillConfig:
    """How many kills strike, and when.

    A share of them strikes uniformly within the time that the last start-up took, the others within
    `KillSchedule.most_life_s` of the first thing that a session adds to its run.

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
    """What the lives of sessions so far say about the next: shares of the run a second, and a share lost by each kill.

    Args:
      work_s: seconds that the run worked when it was left alone; lives soon weigh more.
    """

    def __init__(self, work_s: float) -> None:
        self._gained, self._worked_s = _ALONE_WEIGHS, _ALONE_WEIGHS * work_s
        self._lost: list[float] = []

    def most_life_s(self, done: float, left: int) -> float:
        """Longest time for which a session works before it is killed, 2 min((1 − d) / (k + 1) + l, .45 (1 − d)) / v.

        A kill loses what was done since the last checkpoint, a share l of the run.  With lives uniform up to this
        bound, sessions keep on average as much as lets the kills last for the whole run, and even the last kill comes
        before the end.

        Args:
          done: d, share of the run that the session finds done.
          left: k, kills that are left.
        """
        lost = float(np.mean(self._lost)) if self._lost else 0.0
        share = min((1 - done) / (left + 1) + lost, 0.45 * (1 - done))
        return 2 * share * self._worked_s / self._gained

    def went_on(self, reached: float, done: float) -> None:
        """A session found a share of the run done, of which the one before had reached more."""
        self._lost.append(max(0.0, reached - done))

    def lived(self, gained: float, worked_s: float) -> None:
        """A session added a share of the run in so many seconds."""
        self._gained, self._worked_s = self._gained + max(0.0, gained), self._worked_s + worked_s


_ALONE_WEIGHS = 0.05  # share of a run that counts from the one that was left alone


class UndisturbedRun(NamedTuple):
    """A run that nobody killed: what it came to, lines of its log, seconds from its first line to its end."""

    digests: Mapping[str, str]
    lines: int
    work_s: float


class Campaign:
    """Runs of one victim under one folder, which share compiled programs and the records that the first one made.

    What else a run keeps in its cache, trained policies for one, is its own: the others must make it again.

    Args:
      home: folder of the runs.
      programs: folder of compiled programs.
      victim: what is run.
      config: when kills strike.
    """

    def __init__(self, home: Path, programs: Path, victim: KillableTraining, config: KillConfig) -> None:
        self._home, self._programs, self._victim, self._config = home, programs, victim, config
        self._startup_s = 1.0  # until one was measured

    def left_alone(self) -> UndisturbedRun:
        """A run that nobody kills, from its beginning; it makes the records and compiles."""
        shutil.rmtree(self._home / ALONE, ignore_errors=True)  # one that was broken off tells no time
        session = self._session(ALONE)
        session.wait_for_work()
        began_s = session.age_s
        session.finish()
        directory = self.directory(ALONE)
        return UndisturbedRun(digests(directory), look(directory).lines, session.age_s - began_s)

    def killed(
        self,
        number: int,
        kills: int,
        alone: UndisturbedRun,
        *,
        before: Sequence[Kill] = (),
        keep: Callable[[tuple[Kill, ...]], None] = lambda struck: None,
    ) -> tuple[Kill, ...]:
        """Start a run, or go on with it, and kill it until it ends, which after so many kills it may.

        Args:
          number: of the run.
          kills: that shall strike it.
          alone: the run to hold it to.
          before: those that have struck already, in an earlier session of the caller.
          keep: told after each kill of all that have struck.
        """
        struck, pace = tuple(before), KillSchedule(alone.work_s)
        while not self._ended(number):
            session = self._session(str(number))
            left = kills - len(struck)
            reached = next((kill.done for kill in reversed(struck) if kill.phase != START), 0.0)
            lives = left > 0 and self._wait(session, alone, number, left, pace, reached)
            kill = session.kill(alone.lines) if lives else None
            if kill is None:
                session.finish()
            else:
                struck = (*struck, kill)
                keep(struck)
        return struck

    def directory(self, name: str) -> Path:
        """The one run directory of that name."""
        return only(self._home / name / self._victim.name)

    def _ended(self, number: int) -> bool:
        begun = runs.started(self._home / str(number) / self._victim.name)
        return any((directory / "results.json").exists() for directory in begun)

    def _session(self, name: str) -> Session:
        own = self._home / name / "cache"
        if not own.exists():
            own.mkdir(parents=True)
            for records in sorted((self._home / ALONE / "cache").glob(RECORDS)):
                shutil.copytree(records, own / records.name)
        return Session(self._victim, self._home / name, self._programs)

    def _wait(
        self, session: Session, alone: UndisturbedRun, number: int, left: int, pace: KillSchedule, reached: float
    ) -> bool:
        """Sleep until a random moment of the session's life; whether it lives then.  Earlier ones reached a share."""
        rng = np.random.default_rng((self._config.seed, number, left))
        if rng.random() < self._config.startup_share:
            return session.sleep_until(rng.uniform(0, self._startup_s))
        if not session.wait_for_work():
            return False
        self._startup_s, done = session.age_s, self._done(session, alone)
        pace.went_on(reached, done)
        lives = session.sleep_until(self._startup_s + rng.uniform(0, pace.most_life_s(done, left)))
        pace.lived(self._done(session, alone) - done, session.age_s - self._startup_s)
        return lives

    def _done(self, session: Session, alone: UndisturbedRun) -> float:
        return min(session.seen().lines / alone.lines, 1.0)
