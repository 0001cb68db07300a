"""What a run offers the experiment: where to write, how to log, and which of its stages are already done.

A *stage* is a piece of work that is done once and remembered, named `PHASE/SEED` or `PHASE/ARM/SEED`, for example
`sft/0` and `grpo/ordinal/0`; the report takes phases, arms and seeds of the curves from these names.
"""

import contextlib
import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.running.artifacts import jsonable, read_json, write_json, write_text
from experiments.running.progress import Advance, progress

_STAGE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*(?:/[A-Za-z0-9_][A-Za-z0-9_.\-]*)*")


class MetricLog:
    """`metrics.jsonl`: one line per logged step, the same file whether or not the run was ever interrupted.

    Lines hold no clock, so that an interrupted and an uninterrupted run can be compared byte for byte.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: set[str] = set()
        lines = _whole_lines(path)
        write_text(path, "".join(lines))  # drops a line that a crash tore
        self._file = path.open("a", encoding="utf-8")

    def rewind(self, stage: str, step: int) -> None:
        """Drop the lines of a stage at or past a step: they are about to be computed again."""
        self._seen.add(stage)
        lines = _whole_lines(self._path)
        kept = [line for line in lines if not _at_or_past(line, stage, step)]
        if len(kept) < len(lines):
            self._file.close()
            write_text(self._path, "".join(kept))
            self._file = self._path.open("a", encoding="utf-8")

    def append(self, stage: str, step: int, scalars: dict[str, Any]) -> None:
        """Add one line and hand it to the operating system.

        Raises:
          ValueError: a scalar is not finite, or takes the name of a field.
        """
        taken = {"stage", "step"} & set(scalars)
        if taken:
            raise ValueError(f"scalars holds {sorted(taken)}: these are fields of every line; rename them")
        if stage not in self._seen:
            self.rewind(stage, step)
        row = jsonable({"stage": stage, "step": step, **scalars}, where=f"{stage} step {step}")
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Flush the file to the disk and close it."""
        if not self._file.closed:  # a signal may have struck inside `rewind`
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()


class Context:
    """The hands of a run.

    Args:
      directory: `runs/NAME/STAMP`.
      cache_dir: data shared between runs; whatever is stored there must be named by the hash of what made it.
      console: where people read along.
    """

    def __init__(self, directory: Path, cache_dir: Path, console: Console) -> None:
        self.directory = directory
        self.cache_dir = cache_dir
        self.console = console
        self._log = MetricLog(directory / "metrics.jsonl")

    def say(self, text: str) -> None:
        """Print one line to the reader."""
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def log(self, stage: str, step: int, **scalars: Any) -> None:
        """Append `{"stage", "step", **scalars}` to `metrics.jsonl`; the steps of a stage must not decrease.

        The first line of a stage in this session drops the lines of that stage at or past its step, which an
        interrupted session left behind.  Waits for the scalars if they are still being computed.

        Raises:
          ValueError: a scalar is not finite: the run diverged, or a mean was taken over nothing.
        """
        self._log.append(_checked(stage), step, scalars)

    def rewind(self, stage: str, step: int) -> None:
        """Drop the logged lines of a stage at or past a step; needed only where the first new line may come later."""
        self._log.rewind(_checked(stage), step)

    def progress(self, title: str, total: int, completed: int = 0) -> contextlib.AbstractContextManager[Advance]:
        """A progress bar for one loop; `completed` are the steps done before this session."""
        return progress(self.console, title, total, completed)

    def checkpoint_dir(self, stage: str) -> Path:
        """The directory of a stage's checkpoints, created."""
        path = (self.directory / "checkpoints" / _checked(stage)).absolute()
        path.mkdir(parents=True, exist_ok=True)
        return path

    def done(self, stage: str) -> bool:
        """Whether the stage has a saved result."""
        return self._stage_file(stage).exists()

    def save_stage(self, stage: str, result: Any) -> None:
        """Publish the result of a finished stage as JSON; from now on the stage is done."""
        write_json(self._stage_file(stage), result)

    def load_stage(self, stage: str) -> Any:
        """The saved result of a finished stage, in JSON's types.

        Raises:
          FileNotFoundError: the stage is not done.
        """
        path = self._stage_file(stage)
        if not path.exists():
            raise FileNotFoundError(f"stage {stage!r} has no result at {path}: finish and save the stage first")
        return read_json(path)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the wall time of the block to the stage's, in `timing`, over interruptions too."""
        _checked(stage)
        start = time.monotonic()
        try:
            yield
        finally:
            seconds = self.timing()
            seconds[stage] = seconds.get(stage, 0.0) + time.monotonic() - start
            write_json(self._timing_file, seconds)

    def timing(self) -> dict[str, float]:
        """Wall seconds of every timed stage so far."""
        return read_json(self._timing_file) if self._timing_file.exists() else {}

    def close(self) -> None:
        """Close the log; the runner calls this."""
        self._log.close()

    @property
    def _timing_file(self) -> Path:
        return self.directory / "timing.json"

    def _stage_file(self, stage: str) -> Path:
        path = self.directory / "stages" / _checked(stage)
        return path.with_name(path.name + ".json")


def read_metrics(directory: Path) -> list[dict[str, Any]]:
    """The logged lines of a run, in order."""
    return [json.loads(line) for line in _whole_lines(directory / "metrics.jsonl")]


def _whole_lines(path: Path) -> list[str]:
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return lines[:-1] if lines and not lines[-1].endswith("\n") else lines


def _at_or_past(line: str, stage: str, step: int) -> bool:
    row = json.loads(line)
    return row["stage"] == stage and row["step"] >= step


def _checked(stage: str) -> str:
    if _STAGE.fullmatch(stage) is None:
        raise ValueError(
            f"stage is {stage!r}: must be words of letters, digits, '_', '.' or '-' joined by '/'; for example 'sft/0'"
        )
    return stage
