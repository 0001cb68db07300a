"""What all commands print with: standard output, complaints, a progress bar."""

import contextlib
from collections.abc import Callable, Iterator

import rich.console
import rich.live
import rich.progress

OUT = rich.console.Console()
ERR = rich.console.Console(stderr=True)


def complain(error: Exception) -> None:
    """One line on stderr, as it stands."""
    ERR.print(f"{type(error).__name__}: {error}", markup=False, highlight=False, soft_wrap=True)


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
    """A bar with rate and time left on stderr; nothing where stderr is no terminal."""
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.MofNCompleteColumn(),
        rich.progress.TextColumn("{task.fields[rate]}"),
        rich.progress.TimeRemainingColumn(),
    )
    with rich.progress.Progress(*columns, console=ERR, disable=not ERR.is_terminal) as bar:
        task = bar.add_task(what, total=None, rate="")

        def show(done: int, total: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, total=total, rate=f"{speed:.1f}/s" if speed else "")

        yield show
