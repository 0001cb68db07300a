"""The context of a run: directories, log, progress, and the stages that are already done.

Each computation is a cached *stage*, named `PHASE/SEED` or `PHASE/ARM/SEED`, for example
`sft/0` and `grpo/ordinal/0`; the report takes phases, arms and seeds of the curves from these names.
"""

import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console

from experiments.core.artifacts import (
    DamagedFileError,
    UnwrittenError,
    fitting,
    read_arrays,
    read_json,
    read_times,
    write_arrays,
    write_sealed,
)
from experiments.core.errors import ConfigurationError
from experiments.core.metric_log import MetricLog, by_stage, damaged_log, read_metrics, summary
from experiments.core.progress import Advance, Loop, ProgressCallback, TrainingSample, Watcher, show_progress
from experiments.core.runs import labelled
from experiments.core.stopping import Stopping
from sensors_io.arrays import ArraysError
from sensors_io.units import HERE, Launcher
from touchr1_jax.distributed.processes import SINGLE_PROCESS, ProcessGroup, SingleDevice
from touchr1_jax.training.compilation import drop_programs

T = TypeVar("T")

_LOGGED = "logged"  # folder in `stages` for what `Context.seal_log` keeps

_STAGE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*(?:/[A-Za-z0-9_][A-Za-z0-9_.\-]*)*")


class Context:
    """Everything through which an experiment acts on its run.

    Args:
      directory: `runs/NAME/STAMP`.
      cache_dir: data shared between runs; every entry must be named by the hash of its inputs.
      console: for people.
      watchers: called with every logged line and every loop.
      stopping: receives the signals that ask the run to stop; the default receives none.
      processes: of which the first alone writes.
      devices: of the training steps.
      launcher: where units of work run.
    """

    def __init__(
        self,
        directory: Path,
        cache_dir: Path,
        console: Console,
        watchers: Sequence[Watcher] = (),
        stopping: Stopping | None = None,
        processes: ProcessGroup = SINGLE_PROCESS,
        devices: SingleDevice | None = None,
        launcher: Launcher = HERE,
    ) -> None:
        self.directory = directory
        self._timing_file = directory / "timing.json"
        self.cache_dir = cache_dir
        self.console = console
        self.stopping = stopping or Stopping()
        self.processes = processes
        self.devices = devices or SingleDevice()
        self.launcher = launcher
        self._opened = time.monotonic()
        self._watchers = watchers
        self._lock, self._compiling = threading.RLock(), dict[str, threading.Lock]()
        self.in_threads = False
        """True while parts of the run are computed in several threads (`concurrency.concurrently`)."""
        self.loops: list[Loop] = []
        """The loops in progress, the outermost first."""
        self._log = MetricLog(directory / "metrics.jsonl", watchers) if processes.writes else None

    def print(self, text: str) -> None:
        """Print one line to the reader."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def log(self, stage: str, step: int, **scalars: Any) -> None:
        """Append `{"stage", "step", **scalars}` to `metrics.jsonl`; the steps of a stage must not decrease.

        The first line of a stage in this session drops the lines of that stage at or past its step, which an
        interrupted session left behind.  Waits for the scalars if they are still being computed.

        Raises:
          ValueError: a scalar is not finite: the run diverged, or a mean was taken over nothing.
        """
        _checked(stage)
        if self._log is not None:
            self._log.append(stage, step, scalars)

    def sampled(self, stage: str, step: int, sample: TrainingSample) -> None:
        """Show an answer of the policy that a stage trains; it is not logged."""
        with self._lock:
            for watcher in self._watchers:
                watcher.sampled(stage, step, sample)

    def rewind(self, stage: str, step: int) -> None:
        """Drop the logged lines of a stage at or past a step; needed only where the first new line may come later."""
        _checked(stage)
        if self._log is not None:
            self._stage_file(f"{_LOGGED}/{stage}").unlink(missing_ok=True)
            self._log.rewind(stage, step)

    def seal_log(self, stage: str) -> None:
        """Keep number and checksum of the lines of a stage that was saved or has ended, for `require_log`."""
        self.require_in_place()
        if self._log is not None:
            write_sealed(self._stage_file(f"{_LOGGED}/{stage}"), {"lines": self._log.summary_of(stage)})

    def has_sealed(self, stage: str) -> bool:
        """True if `seal_log` has seen a stage, as it does when the stage is saved or ends."""
        return self._stage_file(f"{_LOGGED}/{stage}").exists()

    def require_log(self) -> None:
        """`DamagedFileError` unless the log has all lines that `seal_log` has seen; no other look may be taken."""
        folder = self.directory / "stages" / _LOGGED
        if self._log is None:
            return
        lines = self._log.lines_of_stages()
        for path in sorted(folder.rglob("*.json")):
            stage = path.relative_to(folder).with_suffix("").as_posix()
            if _STAGE.fullmatch(stage) is None:  # of another program, such as ._0.json or 0 (conflicted copy).json
                continue
            kept = read_json(path)
            with fitting(path):
                number, _ = kept["lines"]
                same = summary(lines.get(stage, [])[:number]) == kept["lines"]
            if not same:
                how = f"of the {number} lines of stage {stage} some are missing or changed"
                raise damaged_log(self.directory / "metrics.jsonl", how)

    def require_in_place(self) -> None:
        """`UnwrittenError` if the run was moved or removed while it goes on: its other half would lie elsewhere."""
        if self._log is not None:
            self._log.require_in_place()

    def sort_log(self) -> None:
        """Put the lines of the log in the order of the seeds, as if one had been trained after the other."""
        if self._log is not None:
            self._log.sort()

    @contextlib.contextmanager
    def compiling(self, program: str) -> Iterator[Callable[[], None]]:
        """Let other threads that run a program wait until this one has compiled it and calls the given function.

        Programs of earlier stages are dropped first where there is no room for another (see `drop_programs`).
        """
        drop_programs()
        with self._lock:
            lock = self._compiling.setdefault(program, threading.Lock())
        with contextlib.ExitStack() as first:
            first.enter_context(lock)
            yield first.close

    @contextlib.contextmanager
    def progress(
        self, title: str, total: int, completed: int = 0, *, still: bool = False, note: str = ""
    ) -> Iterator[Advance]:
        """Show a progress bar for one loop of `total` steps, of which earlier sessions `completed` some.

        Until the first step the `note` is shown next to it.  A `still` bar and those inside are redrawn with each step
        only, so that they take no time from what is timed.
        """
        loop = Loop(title, total, completed, still=still or any(outer.still for outer in self.loops), note=note)
        self.loops.append(loop)

        def notify() -> None:
            with self._lock:
                for watcher in self._watchers:
                    watcher.looping(self.loops)

        try:
            notify()
            with show_progress(self.console, loop, notify, plain=self.in_threads) as advance:
                yield advance
        finally:
            self.loops.remove(loop)
        notify()

    def each(self, title: str, items: Iterable[T], *, still: bool = False) -> Iterator[T]:
        """Yield the items under a progress bar; an item counts as done when the next one is requested."""
        listed = tuple(items)
        with self.progress(title, len(listed), still=still) as advance:
            for item in listed:
                yield item
                advance()

    def rounds(self, title: str, number: int) -> Iterator[int]:
        """Yield the numbers of timed rounds, from 0, under a bar that is drawn between rounds only."""
        return self.each(title, range(number), still=True)

    @contextlib.contextmanager
    def progress_callback(self, title: str, *, still: bool = False) -> Iterator[ProgressCallback]:
        """Show a progress bar for a loop that reports (steps done, all steps) by a callback.

        The first report opens the bar; steps done by then do not count into the rate.
        """
        with contextlib.ExitStack() as stack:
            advance: Advance | None = None
            seen = 0

            def report(done: int, total: int) -> None:
                nonlocal advance, seen
                if advance is None:
                    advance = stack.enter_context(self.progress(title, total, done, still=still))
                elif done > seen:
                    advance(done - seen)
                seen = done

            yield report

    def require_logged(self, stage: str, steps: int) -> None:
        """`DamagedFileError` unless the log has every step before a checkpoint: no run ends with a part of it."""
        if steps == 0 or not self.processes.writes:
            return
        seen = {row["step"] for row in by_stage(read_metrics(self.directory)).get(stage, ())}
        missing = sorted(set(range(steps)) - seen)
        if missing:
            how = f"of stage {stage} {len(missing)} of {steps} steps are missing, the first is {missing[0]}"
            raise damaged_log(self.directory / "metrics.jsonl", how)

    def checkpoint_dir(self, stage: str) -> Path:
        """The directory of a stage's checkpoints, created."""
        self.require_in_place()
        path = (self.directory / "checkpoints" / _checked(stage)).absolute()
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UnwrittenError(f"{path} cannot be made ({error}): move away what is in its place") from error
        return path

    def done(self, stage: str) -> bool:
        """True if the stage has a saved result; one that is damaged is reported, for the stage is then done again."""
        path = self._stage_file(stage)
        if not path.exists():
            return False
        try:
            self._saved_result(stage)
        except DamagedFileError as error:
            self.print(f"{path} is damaged ({error.__cause__}), and stage {stage} is done again")
            return False
        return True

    def save_stage(self, stage: str, result: Any) -> None:
        """Write the result of a finished stage as JSON, which marks the stage as done."""
        self.require_in_place()
        content = {"stage": labelled(self.directory, stage), "result": result}
        self.processes.write_once(lambda: write_sealed(self._stage_file(stage), content))

    def load_stage(self, stage: str) -> Any:
        """The saved result of a finished stage, in JSON's types; `FileNotFoundError` if the stage is not done."""
        path = self._stage_file(stage)
        if not path.exists():
            raise FileNotFoundError(f"stage {stage!r} has no result at {path}: finish and save the stage first")
        return self._saved_result(stage)

    def once(self, stage: str, compute: Callable[[], Any]) -> Any:
        """The saved result of a stage, in JSON's types; it is computed and saved first if the stage is not done."""
        if not self.done(stage):
            self.save_stage(stage, compute())
        return self.load_stage(stage)

    def require_same(self, stage: str, here: Any, what: str) -> None:
        """Refuse to continue with another input than the run began with, of which `here` is a digest.

        A run goes on from policies and answers that were made with the input that it had then.

        Raises:
          ConfigurationError: naming `what`.
        """
        if self.once(stage, lambda: here) != here:
            raise ConfigurationError(
                f"{what} changed since this run began, or the code that reads this input did: put a copy back, or "
                "start anew with --fresh"
            )

    def cached_arrays(
        self, name: str, make: Callable[[], Mapping[str, Any]], *, compressed: bool = False
    ) -> dict[str, np.ndarray]:
        """The arrays in `name`.npz of the cache, made first where that is missing, damaged or not its own."""
        path = self.cache_dir / f"{name}.npz"
        if path.exists():
            try:
                return read_arrays(path, name, earlier=False)
            except ArraysError as error:
                self.print(f"{path} is made again ({error.__cause__})")
        write_arrays(path, make(), compressed=compressed, of=name)
        return read_arrays(path, name)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the wall time of the block to the stage's in `timing`, which adds up over interruptions."""
        start = time.monotonic()
        try:
            yield
        finally:
            self.add_time(stage, time.monotonic() - start)

    def add_time(self, name: str, seconds: float) -> None:
        """Add to the wall time under a name in `timing`."""
        if self.processes.writes and self.directory.is_dir():  # else it was moved, and none must take its place
            with self._lock:
                kept = self.timing()
                write_sealed(self._timing_file, kept | {name: kept.get(name, 0.0) + seconds})

    def timing(self) -> dict[str, float]:
        """Wall seconds of every timed stage so far."""
        return read_times(self._timing_file)

    @property
    def elapsed_s(self) -> float:
        """Wall seconds of the run so far, including those before interruptions."""
        return self.timing().get("total", 0.0) + time.monotonic() - self._opened

    def close(self) -> None:
        """Close the log; the runner calls this."""
        if self._log is not None:
            self._log.close()
        for watcher in self._watchers:
            watcher.closed()

    def _saved_result(self, stage: str) -> Any:
        """The result in the file of a stage; earlier versions wrote the result alone, or with the stage's bare name."""
        path = self._stage_file(stage)
        content = read_json(path)
        if not isinstance(content, dict) or content.keys() != {"stage", "result"}:
            return content
        if content["stage"] not in (stage, labelled(self.directory, stage)):
            other = ValueError(f"it is of {content['stage']!r}, this is {labelled(self.directory, stage)!r}")
            raise DamagedFileError(f"{path} is damaged ({other}): put its own copy back, or remove it") from other
        return content["result"]

    def _stage_file(self, stage: str) -> Path:
        path = self.directory / "stages" / _checked(stage)
        return path.with_name(path.name + ".json")


def _checked(stage: str) -> str:
    if _STAGE.fullmatch(stage) is None:
        raise ValueError(
            f"stage is {stage!r}: must be words of letters, digits, '_', '.' or '-' joined by '/'; for example 'sft/0'"
        )
    return stage
