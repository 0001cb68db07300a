"""Progress of loops: a bar with rate and time left, or plain lines where the output is no terminal."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from rich import progress
from rich.console import Console
from rich.text import Text

from experiments.core.text import duration

PLAIN_EVERY_S = 10.0  # seconds between two plain lines


class Advance(Protocol):
    """The function that a loop calls after each step: `advance()`, or `advance(3, "reward 0.52")`."""

    def __call__(self, steps: int = 1, note: str = "") -> None: ...


ProgressCallback = Callable[[int, int], None]  # called with the steps that are done, and the number of all steps

MB = 1_000_000


def in_megabytes(callback: ProgressCallback) -> ProgressCallback:
    """A callback for bytes that reports megabytes, rounded up, so that the last report is complete."""
    return lambda done, total: callback(-(-done // MB), -(-total // MB))


class Loop:
    """The progress of a loop.

    Args:
      title: of its bar.
      total: steps of the whole loop.
      completed: steps of earlier sessions; they do not count into the rate.
      still: redraw with each step only, not ten times a second, which would take time from what is timed.
      note: shown next to the bar until the first of its steps, such as "compiling".
      clock: seconds.
    """

    def __init__(
        self,
        title: str,
        total: int,
        completed: int = 0,
        *,
        still: bool = False,
        note: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.title, self.total, self.completed, self.still = title, total, completed, still
        self.note = note if completed < total else ""
        self._clock = clock
        self._began = self._first_call = (completed, clock())

    def advance(self, steps: int, note: str = "") -> None:
        """Count further steps as done."""
        self.completed, self.note = self.completed + steps, note
        if self._first_call is self._began:
            self._first_call = (self.completed, self._clock())

    @property
    def elapsed_s(self) -> float:
        """Seconds since its beginning in this session."""
        return self._clock() - self._began[1]

    @property
    def share(self) -> float:
        """Share of the loop that is done, in [0, 1]."""
        return min(self.completed / self.total, 1.0) if self.total else 1.0

    @property
    def rate(self) -> float:
        """Steps per second, without the first call as soon as there is another, since the first one compiled."""
        completed, since = self._began if self._only_one_call else self._first_call
        elapsed_s = self._clock() - since
        return (self.completed - completed) / elapsed_s if elapsed_s > 0 else 0.0

    @property
    def _only_one_call(self) -> bool:
        return self.completed == self._first_call[0]

    @property
    def left(self) -> str:
        """Time to the end at this rate; "at most" while the only known rate is that of the call that compiled."""
        if self.rate <= 0 or self.completed >= self.total:
            return ""
        return f"{'at most ' * self._only_one_call}{duration((self.total - self.completed) / self.rate)}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingSample:
    """An answer that a policy gave while it was trained: what was asked, its words, the truth, what it earned."""

    question: str
    answer: str
    truth: str
    reward: float


class Watcher:
    """Base of whatever follows a run: it is called with every logged line and every loop; here it does nothing."""

    def rewound(self, stage: str, step: int) -> None:
        """The lines of a stage at or past a step are dropped; every stage is rewound before its first line."""

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """A line was written to `metrics.jsonl`; `scalars` are in JSON's types."""

    def looping(self, loops: Sequence[Loop]) -> None:
        """A loop began, advanced or ended; `loops` are the open ones, the outermost first."""

    def sampled(self, stage: str, step: int, sample: TrainingSample) -> None:
        """A policy answered in a step of a stage."""

    def closed(self) -> None:
        """The session is over."""


@contextlib.contextmanager
def show_progress(
    console: Console,
    loop: Loop,
    after: Callable[[], None] = lambda: None,
    *,
    every_s: float = PLAIN_EVERY_S,
    plain: bool = False,
) -> Iterator[Advance]:
    """Show the progress of a loop and call `after` each advance.

    A terminal gets a live bar, anything else, and a `plain` loop, a line every `every_s` seconds and one at the end.
    """
    with (_bar if console.is_terminal and not plain else _plain_lines)(console, loop, every_s) as show:

        def advance(steps: int = 1, note: str = "") -> None:
            loop.advance(steps, note)
            show()
            after()

        yield advance


@contextlib.contextmanager
def _bar(console: Console, loop: Loop, every_s: float) -> Iterator[Callable[[], None]]:
    del every_s
    columns = (
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        RateColumn(),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.fields[note]}", style="dim", markup=False),
    )
    with progress.Progress(*columns, console=console, auto_refresh=not loop.still) as bar:
        task = bar.add_task(loop.title, total=loop.total, completed=loop.completed, note=loop.note)
        yield lambda: bar.update(task, completed=loop.completed, note=loop.note, refresh=loop.still)


class RateColumn(progress.ProgressColumn):
    """Steps per second over the recent steps."""

    def render(self, task: progress.Task) -> Text:
        """The rate, or nothing before the first step."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.3g}/s", style="progress.data.speed")


@contextlib.contextmanager
def _plain_lines(console: Console, loop: Loop, every_s: float) -> Iterator[Callable[[], None]]:
    last_s, printed = time.monotonic(), -1

    def print_line(due_s: float = 0.0) -> None:
        nonlocal last_s, printed
        if time.monotonic() - last_s < due_s:
            return
        last_s, printed = time.monotonic(), loop.completed
        left = f", {loop.left} left" if loop.left else ""
        note = f"  {loop.note}" if loop.note else ""
        line = f"{loop.title}: {loop.completed}/{loop.total}, {loop.rate:.3g}/s, {duration(loop.elapsed_s)}{left}{note}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    if loop.note:
        console.print(f"{loop.title}: {loop.note}", markup=False, highlight=False, soft_wrap=True)
    yield lambda: print_line(every_s)
    if printed != loop.completed:
        print_line()
