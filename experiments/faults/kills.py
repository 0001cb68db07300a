"""Training killed again and again at random moments, held bit by bit to training that was left alone."""

import dataclasses
import hashlib
import json
import shutil
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp

from experiments.faults.sessions import start
from experiments.running import runs
from experiments.running.artifacts import read_json

POLL_S = 0.005
"""How often a session's files are looked at; a step takes longer."""

PATIENCE_S = 300.0
"""A session that has done nothing for so long hangs."""

START, BETWEEN, CHECKPOINT = "start-up", "between stages", "writing a checkpoint"
STEPPING = {"sft": "SFT steps", "grpo": "GRPO steps", "blind": "blind SFT steps", "count": "steps"}
PHASES = (START, *STEPPING.values(), BETWEEN, CHECKPOINT)
"""Where a kill can strike; between stages contacts are encoded, policies are asked, the report is written."""

ALONE = "alone"
"""Name of the run that is not killed."""

RECORDS = "scenes-*"
"""Folders of a cache that hold records."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Victim:
    """A run to kill: an experiment of this package, its options, and the steps of each phase of it."""

    name: str
    options: tuple[str, ...]
    steps: Mapping[str, int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class KillConfig:
    """When kills strike.

    Args:
      kills: how many.
      startup_share: share that strikes uniformly within the time that the last start-up took.
      life_s: the others strike uniformly within so long after the first thing that a session adds to its run.
      seed: of the moments.
    """

    kills: int = 200
    startup_share: float = 0.25
    life_s: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kills < 1 or not 0 <= self.startup_share < 1 or self.life_s <= 0:
            raise ValueError(
                f"{self}: needs kills ≥ 1, 0 ≤ startup_share < 1 (else no session gets anywhere) and life_s > 0; "
                "correct what is outside"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Kill:
    """One kill: the phase that it struck, seconds since the session began, share of the run's steps done by then.

    `torn` says whether it left half a line in the log.
    """

    phase: str
    after_s: float
    done: float
    torn: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class Killed:
    """A run that was killed and came to its end: the kills, and what of it differs from the run left alone."""

    kills: tuple[Kill, ...]
    differs: tuple[str, ...]


class Seen(NamedTuple):
    """What lies in a run's directory: whole lines of the log and the last of them, whether half a line, answers."""

    lines: int
    last: tuple[str, int] | None
    torn: bool
    answers: int


class Campaign:
    """Runs of one victim under one folder, which share compiled programs and the records that the first one made.

    What else a run keeps in its cache, trained policies for one, is its own: the others must make it again.

    Args:
      home: folder of the runs.
      programs: folder of compiled programs.
      victim: what is run.
      config: when kills strike.
    """

    def __init__(self, home: Path, programs: Path, victim: Victim, config: KillConfig) -> None:
        self._home, self._programs, self._victim, self._config = home, programs, victim, config
        self._startup_s = 1.0  # until one was measured

    def left_alone(self) -> Path:
        """The directory of a run that nobody kills; it makes the records and compiles."""
        self._session(ALONE).finish()
        return self.directory(ALONE)

    def killed(self, name: str, kills: int, rng: np.random.Generator) -> tuple[Kill, ...]:
        """Start a run, kill it and go on, until it ends, which after `kills` kills it may."""
        lines = look(self.directory(ALONE)).lines
        struck: list[Kill] = []
        while True:
            session = self._session(name)
            kill = session.kill(lines) if len(struck) < kills and self._wait(session, rng) else None
            if kill is None:
                session.finish()
                return tuple(struck)
            struck.append(kill)

    def directory(self, name: str) -> Path:
        """The one run directory of that name."""
        return only(self._home / name / self._victim.name)

    def _session(self, name: str) -> "Session":
        own = self._home / name / "cache"
        if not own.exists():
            own.mkdir(parents=True)
            for records in sorted((self._home / ALONE / "cache").glob(RECORDS)):
                shutil.copytree(records, own / records.name)
        return Session(self._victim, self._home / name, self._programs)

    def _wait(self, session: "Session", rng: np.random.Generator) -> bool:
        """Sleep until a random moment of the session's life; whether it lives then."""
        if rng.random() < self._config.startup_share:
            return session.sleep_until(rng.uniform(0, self._startup_s))
        if not session.wait_for_work():
            return False
        self._startup_s = session.age_s
        return session.sleep_until(session.age_s + rng.uniform(0, self._config.life_s))


class Session:
    """One session of a victim.

    Args:
      victim: what is run.
      home: folder of its run.
      programs: folder of compiled programs.
    """

    def __init__(self, victim: Victim, home: Path, programs: Path) -> None:
        self._runs, self._steps, self._printed = home / victim.name, victim.steps, home / "printed.txt"
        home.mkdir(parents=True, exist_ok=True)
        self._least = self._look()
        self._began, self._began_ns = time.monotonic(), time.time_ns()
        folders = ["--runs-dir", str(home), "--cache-dir", str(home / "cache")]
        self._process = start([victim.name, *victim.options, *folders], self._printed, programs)

    @property
    def age_s(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self._began

    def wait_for_work(self) -> bool:
        """Sleep until it adds something to its run; whether it lives then."""
        while not self._worked(self._look()):
            if not self.sleep_until(self.age_s + POLL_S):
                return False
            if self.age_s > PATIENCE_S:
                raise RuntimeError(f"a session did nothing in {PATIENCE_S:g} s: see {self._printed}")
        return True

    def sleep_until(self, age_s: float) -> bool:
        """Sleep until it is so old, looking at its run on the way; whether it lives then."""
        while (left_s := age_s - self.age_s) > 0 and self._process.is_alive():
            self._process.join(min(left_s, POLL_S))
            self._worked(self._look())
        return self._process.is_alive()

    def kill(self, lines: int) -> Kill | None:
        """End it by SIGKILL; `None` if it ended just before.  The log of a whole run has so many lines."""
        age_s = self.age_s
        self._process.kill()
        self._process.join()
        if self._process.exitcode != -signal.SIGKILL:
            return None
        seen = self._look()
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

    def _worked(self, seen: Seen) -> bool:
        """Whether it added anything; lines that it first dropped do not count."""
        if seen.lines < self._least.lines:
            self._least = self._least._replace(lines=seen.lines)
        return seen.lines > self._least.lines or seen.answers > self._least.answers

    def _phase(self, seen: Seen) -> str:
        if self._writing():
            return CHECKPOINT
        if not self._worked(seen):
            return START
        if seen.last is None or seen.lines == self._least.lines:
            return BETWEEN
        stage, step = seen.last
        kind = stage.partition("/")[0]
        return STEPPING[kind] if step + 1 < self._steps[kind] else BETWEEN

    def _writing(self) -> bool:
        """Whether it left half a checkpoint."""
        half = self._runs.glob("*/checkpoints/**/*.orbax-checkpoint-tmp*")
        return any(path.stat().st_mtime_ns >= self._began_ns for path in half)

    def _look(self) -> Seen:
        begun = runs.started(self._runs)
        return look(only(self._runs)) if begun else Seen(0, None, False, 0)


def only(home: Path) -> Path:
    """The one run that was started in a folder; a session may have been killed before its run had a configuration."""
    (found,) = runs.started(home)
    return found


def look(directory: Path) -> Seen:
    """What lies in a run's directory now."""
    path = directory / "metrics.jsonl"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    whole, _, torn = text.rpartition("\n")
    lines = whole.split("\n") if whole else []
    row = json.loads(lines[-1]) if lines else None
    return Seen(
        lines=len(lines),
        last=None if row is None else (row["stage"], row["step"]),
        torn=bool(torn),
        answers=len(list((directory / "answers").glob("*.npz"))),
    )


def evidence(directory: Path) -> dict[str, str]:
    """SHA-256 of all that a run came to: log lines, answers, what every stage kept at its end, results."""
    found = {"metrics.jsonl": _hash((directory / "metrics.jsonl").read_bytes())}
    for path in sorted((directory / "answers").glob("*.npz")):
        found[f"answers/{path.name}"] = _hash(path.read_bytes())
    results = read_json(directory / "results.json")
    found["results"] = _hash(json.dumps([results["verdict"], results["data"]]).encode())
    checkpoints = directory / "checkpoints"
    for stage in sorted(path.parent for path in checkpoints.rglob("*") if path.name.isdigit() and _holds_state(path)):
        kept = sorted((path for path in stage.iterdir() if path.name.isdigit()), key=lambda path: int(path.name))
        found[f"state of {stage.relative_to(checkpoints)}"] = _hash("".join(map(_state_hash, kept)).encode())
    return found


def differences(a: Mapping[str, str], b: Mapping[str, str]) -> tuple[str, ...]:
    """What two runs came to differently."""
    return tuple(sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name)))


def _holds_state(path: Path) -> bool:
    return (path / "state").is_dir()


def _state_hash(checkpoint: Path) -> str:
    """Of step, data iterator, score and every array of a checkpoint."""
    with ocp.StandardCheckpointer() as checkpointer:
        state = checkpointer.restore(checkpoint / "state")
    digest = hashlib.sha256(checkpoint.name.encode() + (checkpoint / "data" / "metadata").read_bytes())
    for score in sorted(checkpoint.glob("metrics/*")):
        digest.update(score.read_bytes())
    for path, array in jax.tree.leaves_with_path(state):
        bits = jax.random.key_data(array) if jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key) else array
        digest.update(jax.tree_util.keystr(path).encode() + np.asarray(bits).tobytes())
    return digest.hexdigest()


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
