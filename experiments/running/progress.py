"""A progress bar with rate and time left; plain lines where the output is no terminal."""

import contextlib
import time
from collections.abc import Iterator
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

PLAIN_EVERY_S = 10.0
"""Seconds between two plain lines."""


class Advance(Protocol):
    """What a loop calls after each step: `advance()`, or `advance(3, "reward 0.52")`."""

    def __call__(self, steps: int = 1, note: str = "") -> None: ...


class RateColumn(ProgressColumn):
    """Steps per second over the recent steps."""

    def render(self, task: Task) -> Text:
        """The rate, or nothing before the first step."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.3g}/s", style="progress.data.speed")


@contextlib.contextmanager
def progress(console: Console, title: str, total: int, completed: int = 0) -> Iterator[Advance]:
    """Show the progress of one loop.

    Args:
      console: a terminal gets a live bar, anything else a line every `PLAIN_EVERY_S` seconds and one at the end.
      title: what is going on.
      total: steps of the whole loop.
      completed: steps that an earlier session did; they do not count into the rate.
    """
    if console.is_terminal:
        with _bar(console) as bar:
            task = bar.add_task(title, total=total, completed=completed, note="")
            yield lambda steps=1, note="": bar.update(task, advance=steps, note=note)
    else:
        plain = _Plain(console, title, total, completed)
        yield plain
        plain.close()


def _bar(console: Console) -> Progress:
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
    )


class _Plain:
    """The same figures as lines of text."""

    def __init__(self, console: Console, title: str, total: int, completed: int) -> None:
        self._console, self._title, self._total = console, title, total
        self._completed = self._first = completed
        self._start = self._printed = time.monotonic()
        self._note = ""

    def __call__(self, steps: int = 1, note: str = "") -> None:
        self._completed, self._note = self._completed + steps, note
        if time.monotonic() - self._printed >= PLAIN_EVERY_S:
            self._print()

    def close(self) -> None:
        self._print()

    def _print(self) -> None:
        self._printed = time.monotonic()
        elapsed = self._printed - self._start
        rate = (self._completed - self._first) / elapsed if elapsed > 0 else 0.0
        left = f", {(self._total - self._completed) / rate:.0f} s left" if rate > 0 else ""
        note = f"  {self._note}" if self._note else ""
        line = f"{self._title}: {self._completed}/{self._total}, {rate:.3g}/s, {elapsed:.0f} s{left}{note}"
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
