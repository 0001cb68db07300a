"""A progress bar with rate and time left; plain lines where the output is no terminal."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from experiments.core.text import duration

PLAIN_EVERY_S = 10.0
"""Seconds between two plain lines."""


class Advance(Protocol):
    """What a loop calls after each step: `advance()`, or `advance(3, "reward 0.52")`."""

    def __call__(self, steps: int = 1, note: str = "") -> None: ...


Tell = Callable[[int, int], None]
"""What a loop calls that knows how far it is: with the steps that are done, and all of them."""

MB = 1_000_000


def in_megabytes(tell: Tell) -> Tell:
    """For a loop that tells bytes; those begun are counted, so that the last word is all of all."""
    return lambda done, total: tell(-(-done // MB), -(-total // MB))


class Loop:
    """How far a loop has come.

    Args:
      title: what is going on.
      total: steps of the whole loop.
      completed: steps that an earlier session did; they do not count into the rate.
      still: whether it is drawn with each step only, not ten times a second, which would take time of what is timed.
    """

    def __init__(self, title: str, total: int, completed: int = 0, *, still: bool = False) -> None:
        self.title, self.total, self.completed, self.still, self.note = title, total, completed, still, ""
        self._began = self._first_call = (completed, time.monotonic())

    def advance(self, steps: int, note: str = "") -> None:
        """So many more steps are done."""
        self.completed, self.note = self.completed + steps, note
        if self._first_call is self._began:
            self._first_call = (self.completed, time.monotonic())

    @property
    def elapsed_s(self) -> float:
        """Seconds since it began in this session."""
        return time.monotonic() - self._began[1]

    @property
    def share(self) -> float:
        """Share of the loop that is done, in [0, 1]."""
        return min(self.completed / self.total, 1.0) if self.total else 1.0

    @property
    def rate(self) -> float:
        """Steps per second; what the first call took does not count once there are others, for it compiled."""
        completed, since = self._began if self.starting else self._first_call
        elapsed_s = time.monotonic() - since
        return (self.completed - completed) / elapsed_s if elapsed_s > 0 else 0.0

    @property
    def starting(self) -> bool:
        """Whether there was no second call yet, so that all that is known of its speed is a first that compiled."""
        return self.completed == self._first_call[0]

    @property
    def left_s(self) -> float | None:
        """Seconds to its end at this rate, `None` before the first step."""
        return (self.total - self.completed) / self.rate if self.rate > 0 else None

    @property
    def left(self) -> str:
        """The same in words, empty before the first step and at the end; "at most" while all steps seem as slow."""
        if not self.left_s:
            return ""
        return f"{'at most ' if self.starting else ''}{duration(self.left_s)}"


class RateColumn(ProgressColumn):
    """Steps per second over the recent steps."""

    def render(self, task: Task) -> Text:
        """The rate, or nothing before the first step."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.3g}/s", style="progress.data.speed")


@contextlib.contextmanager
def progress(console: Console, loop: Loop, after: Callable[[], None] = lambda: None) -> Iterator[Advance]:
    """Show the progress of one loop.

    Args:
      console: a terminal gets a live bar, anything else a line every `PLAIN_EVERY_S` seconds and one at the end.
      loop: advanced by what this yields.
      after: called after each advance.
    """
    if console.is_terminal:
        with _bar(console, loop.still) as bar:
            task = bar.add_task(loop.title, total=loop.total, completed=loop.completed, note="")
            draw = lambda: bar.update(task, completed=loop.completed, note=loop.note, refresh=loop.still)
            yield _advance(loop, draw, after)
    else:
        plain = _Plain(console, loop)
        yield _advance(loop, plain.look, after)
        if plain.said != loop.completed:
            plain.print()


def _advance(loop: Loop, *shows: Callable[[], None]) -> Advance:
    def advance(steps: int = 1, note: str = "") -> None:
        loop.advance(steps, note)
        for show in shows:
            show()

    return advance


def _bar(console: Console, still: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", style="dim", markup=False),
        console=console,
        auto_refresh=not still,
    )


class _Plain:
    """The same figures as lines of text."""

    def __init__(self, console: Console, loop: Loop) -> None:
        self._console, self._loop = console, loop
        self._printed = time.monotonic()
        self.said: int | None = None
        """Steps that the last line told of."""

    def look(self) -> None:
        """Print a line if the last one is old."""
        if time.monotonic() - self._printed >= PLAIN_EVERY_S:
            self.print()

    def print(self) -> None:
        """Print a line."""
        self._printed, self.said, loop = time.monotonic(), self._loop.completed, self._loop
        left = f", {loop.left} left" if loop.left else ""
        note = f"  {loop.note}" if loop.note else ""
        line = f"{loop.title}: {loop.completed}/{loop.total}, {loop.rate:.3g}/s, {duration(loop.elapsed_s)}{left}{note}"
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
