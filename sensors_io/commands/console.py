"""Output shared by all commands: standard output, errors, a progress bar."""

import contextlib
import errno
import functools
import io
import os
import sys
import time
from collections.abc import Callable, Iterator

import rich.console
import rich.live
import rich.progress

WIDTH = 110
"""Columns where there is no terminal: tables in files and pipes keep their names whole."""

PLAIN_EVERY_S = 10.0
"""Between two lines of progress where there is no terminal."""


FIXES = {
    errno.ENOSPC: "free some space, or name another path",
    errno.EDQUOT: "free some space, or name another path",
    errno.EFBIG: "raise the limit of a file's size (ulimit -f), or name a path where files may be larger",
    errno.EACCES: "make it accessible, or name another path",
    errno.EROFS: "make it writable, or name another path",
    errno.ENOENT: "name a path that is there; a folder must stay while it is written",
    errno.ENOTDIR: "a file is in the place of a folder: move it away, or name another path",
    errno.EEXIST: "a file is in the place of a folder: move it away, or name another path",
    errno.EISDIR: "a folder is in the place of a file: move it away, or name another path",
    errno.ELOOP: "its symbolic links lead in a circle: correct them, or name another path",
    errno.ENAMETOOLONG: "name a shorter path",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
}
"""By the number of an error of the system."""


def _console(*, stderr: bool) -> rich.console.Console:
    make = functools.partial(rich.console.Console, stderr=stderr, emoji=False, markup=False)  # a path may hold [/x]
    console = make()
    return console if console.is_terminal else make(width=WIDTH)


OUT, ERR = _console(stderr=False), _console(stderr=True)


def print_in_any_encoding() -> None:
    """Let a terminal or a pipe that cannot show a letter show a question mark instead of ending the program.

    Streams that are closed lead nowhere: else the next file would take their number, and with it what libraries print.
    """
    while (spare := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(spare)
    sys.stdout, sys.stderr = sys.stdout or os.fdopen(1, "w"), sys.stderr or os.fdopen(2, "w")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a notebook's is another
            stream.reconfigure(errors="replace")


def complain(error: Exception) -> None:
    """One line on stderr, as it stands; the system's errors name no fix, which is added."""
    fix = f": {FIXES[error.errno]}" if isinstance(error, OSError) and error.errno in FIXES else ""
    ERR.print(f"{type(error).__name__}: {error}{fix}", markup=False, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def live_display(
    per_second: float, get_renderable: Callable[[], rich.console.RenderableType] | None = None
) -> Iterator[rich.live.Live]:
    """A part of the terminal that is drawn anew; where there is no terminal its last state, on lines of its own."""
    with rich.live.Live(console=OUT, refresh_per_second=per_second, get_renderable=get_renderable) as live:
        try:
            yield live
        finally:
            live.stop()
            if not OUT.is_terminal:
                OUT.line()


@contextlib.contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """Rate and time left of a loop on stderr: a bar, or a line every `PLAIN_EVERY_S` where stderr is no terminal.

    Args:
      what: is counted.

    Yields:
      (done, total) → None, to be called as the loop comes on.
    """
    if not ERR.is_terminal:
        yield _Plain(what).show
        return
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.MofNCompleteColumn(),
        rich.progress.TextColumn("{task.fields[rate]}"),
        rich.progress.TimeRemainingColumn(),
    )
    with rich.progress.Progress(*columns, console=ERR) as bar:
        task = bar.add_task(what, total=None, rate="")

        def show(done: int, total: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, total=total, rate=f"{speed:.3g}/s" if speed else "")

        yield show


class _Plain:
    """The same figures as lines of text."""

    def __init__(self, what: str) -> None:
        self._what, self._began_s = what, time.monotonic()
        self._printed_s = self._began_s
        self._first: int | None = None

    def show(self, done: int, total: int) -> None:
        """Print a line if the last one is old enough; what an earlier command did does not count into the rate."""
        now = time.monotonic()
        self._first = done - 1 if self._first is None else self._first
        if now - self._printed_s < PLAIN_EVERY_S or done >= total:
            return
        self._printed_s = now
        rate = (done - self._first) / (now - self._began_s)
        line = f"{self._what}: {done}/{total}, {rate:.3g}/s, {(total - done) / rate:.0f} s left"
        ERR.print(line, markup=False, highlight=False, soft_wrap=True)
