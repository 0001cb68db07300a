"""`metrics.jsonl`, the log of a run: written line by line, read whole or named as damaged."""

import contextlib
import json
import os
import threading
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import DamagedFileError, UnwrittenError, jsonable, write_text
from experiments.core.progress import Watcher
from sensors_io.json_files import CHECKSUM, require_regular, seal, unseal


class MetricLog:
    """`metrics.jsonl`: one sealed line per logged step, each passed to the watchers.

    Lines hold no clock, and in the end those of a seed follow those of the seed before it: the file is the same, byte
    for byte, whether or not the run was ever interrupted, and however many seeds were trained at a time.
    """

    def __init__(self, path: Path, watchers: Sequence[Watcher] = ()) -> None:
        self._path, self._watchers, self._lock = path, watchers, threading.RLock()
        self._sums: dict[str, list[int]] = {}  # `summary` of the lines of each stage of this session
        _rows(path)  # what is damaged is named before anything is trained
        write_text(path, "".join(_whole_lines(path)))  # drops a line that a crash tore
        self._file = path.open("a", encoding="utf-8")

    def rewind(self, stage: str, step: int) -> None:
        """Drop the lines of a stage at or past a step: they are about to be computed again."""
        with self._lock:
            lines = _whole_lines(self._path)
            rows = [(line, _row(line, self._path)) for line in lines]
            kept = [(line, row) for line, row in rows if row["stage"] != stage or row["step"] < step]
            self._replace(lines, [line for line, _ in kept])
            self._sums[stage] = summary([line for line, row in kept if row["stage"] == stage])
            for watcher in self._watchers:
                watcher.rewound(stage, step)

    def sort(self) -> None:
        """Put the lines in the order of the seeds, which are the last part of the stages' names."""
        with self._lock:
            lines = _whole_lines(self._path)
            self._replace(lines, sorted(lines, key=lambda line: _seed(_row(line, self._path)["stage"])))

    def lines_of_stages(self) -> dict[str, list[str]]:
        """The lines of each stage, in order and as they stand in the file."""
        with self._lock:
            lines = _whole_lines(self._path)
        found: dict[str, list[str]] = {}
        for line in lines:
            found.setdefault(_row(line, self._path)["stage"], []).append(line)
        return found

    def summary_of(self, stage: str) -> list[int]:
        """`summary` of the lines of a stage of this session, which are on the disk then."""
        with self._lock, self._named():
            os.fsync(self._file.fileno())
            return self._sums[stage]

    def _replace(self, lines: list[str], by: list[str]) -> None:
        if lines != by:
            self._file.close()
            write_text(self._path, "".join(by))
            self._file = self._path.open("a", encoding="utf-8")

    def append(self, stage: str, step: int, scalars: dict[str, Any]) -> None:
        """Add one line and flush it; `ValueError` for a scalar that is not finite or takes the name of a field."""
        taken = {"stage", "step", CHECKSUM} & set(scalars)
        if taken:
            raise ValueError(f"scalars holds {sorted(taken)}: these are fields of every line; rename them")
        values = jsonable(scalars, where=f"{stage} step {step}")
        with self._lock:
            self.require_in_place()
            if stage not in self._sums:
                self.rewind(stage, step)
            line = seal(json.dumps({"stage": stage, "step": step, **values})) + "\n"
            with self._named():
                self._file.write(line)
                self._file.flush()
            number, sum_ = self._sums[stage]
            self._sums[stage] = [number + 1, zlib.crc32(line.encode(), sum_)]
            for watcher in self._watchers:
                watcher.logged(stage, step, values)

    def require_in_place(self) -> None:
        """`UnwrittenError` if the file was moved or removed, as with its run: the rest would lie elsewhere."""
        with self._lock:
            try:
                here = os.path.samestat(os.fstat(self._file.fileno()), self._path.stat())
            except (OSError, ValueError):  # removed, or closed after an error
                here = False
        if not here:
            raise UnwrittenError(f"{self._path} was moved or removed while its run goes on: put it back, then continue")

    def close(self) -> None:
        """Flush the file to the disk and close it."""
        if not self._file.closed:  # a signal may have come inside `rewind`
            with self._named():
                self._file.flush()
                os.fsync(self._file.fileno())
                self._file.close()

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise UnwrittenError(f"{self._path} cannot be written ({error}): free some space, then continue") from error


def summary(lines: Sequence[str]) -> list[int]:
    """The number of lines and their CRC-32."""
    return [len(lines), zlib.crc32("".join(lines).encode())]


def read_metrics(directory: Path) -> list[dict[str, Any]]:
    """The logged lines of a run, in order."""
    return _rows(directory / "metrics.jsonl")


def by_stage(rows: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """The rows of `metrics.jsonl` of each stage, in order."""
    stages: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        stages.setdefault(row["stage"], []).append(row)
    return stages


def _rows(path: Path) -> list[dict[str, Any]]:
    lines = _whole_lines(path)
    if len(set(lines)) < len(lines):
        raise damaged_log(path, f"a line is there twice, {Counter(lines).most_common(1)[0][0][:80]!r}")
    rows, steps = [_row(line, path) for line in lines], dict[str, int]()
    for row in rows:
        if row["step"] < steps.setdefault(row["stage"], row["step"]):
            raise damaged_log(path, f"step {row['step']} of stage {row['stage']} follows {steps[row['stage']]}")
        steps[row["stage"]] = row["step"]
    return rows


def _whole_lines(path: Path) -> list[str]:
    if not path.exists():
        return []
    try:
        require_regular(path)
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except ValueError as error:  # also one of text that is no UTF-8
        raise damaged_log(path, str(error)) from error
    if not lines or lines[-1].endswith("\n"):
        return lines
    torn = lines.pop()
    for text in (torn, torn[:-1]):  # a whole line of which the last byte, its end, is lost or flipped
        with contextlib.suppress(ValueError):
            unseal(text)
            return [*lines, f"{text}\n"]
    return lines


def _row(line: str, path: Path) -> dict[str, Any]:
    try:
        row: dict[str, Any] = unseal(line)
        if not isinstance(row, dict) or not isinstance(row.get("stage"), str) or type(row.get("step")) is not int:
            raise ValueError("no stage and step")
        jsonable(row)
        [float(x) for x in row.values() if isinstance(x, int)]  # what no chart can draw
    except (ValueError, OverflowError) as error:
        raise damaged_log(path, f"{error} in {line[:80]!r}") from error
    return row


def damaged_log(path: Path, how: str) -> DamagedFileError:
    """The error of a log that is damaged in some way."""
    return DamagedFileError(f"{path} is damaged ({how}): put a copy back, or start a new run with --fresh")


def _seed(stage: str) -> int:
    """The seed of a stage; −1 of one without, which comes before all seeds."""
    last = stage.rpartition("/")[2]
    return int(last) if last.isdecimal() else -1
