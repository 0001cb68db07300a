"""Watchers of a run in progress: `latest`, the page that a browser reloads, TensorBoard's events, Weights & Biases."""

import contextlib
import importlib
import importlib.util
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import DamagedFileError, read_times, write_text
from experiments.core.commands import print_lines
from experiments.core.curves import PhaseCurves, draw_phases
from experiments.core.metric_log import read_metrics
from experiments.core.progress import Loop, TrainingSample, Watcher
from experiments.core.report import render
from experiments.core.runs import continuing, newest, point_latest
from experiments.core.text import duration

PAGE_EVERY_S = 10  # least seconds between two pages, and between two reloads by a browser

CURVES_SHARE = 0.01
"""Share of the run's time for curves: after some that took a second to draw, the next follow after 100 s."""

MOST_PANELS = 9  # panels of a phase whose scalars the experiment does not choose

TENSORBOARD = "tensorboardX"

WANDB = "wandb"

PACKAGES = {"tensorboard": TENSORBOARD, "wandb": WANDB}
"""Flag, which is also the name of the extra that installs it, and the package that it needs."""

PROJECT = "touchr1-jax"  # project of Weights & Biases, unless WANDB_PROJECT names another
SAMPLES = 6  # answers on the page of a run
FLUSH_S = 10  # seconds until an event is on the disk


class Latest(Watcher):
    """Lets `runs/NAME/latest` point to a run once it begins to compute: with its first loop or its first line."""

    def __init__(self, directory: Path) -> None:
        self._directory, self._pointed = directory, False

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """It computes."""
        self._point()

    def looping(self, loops: Sequence[Loop]) -> None:
        """It computes."""
        self._point()

    def _point(self) -> None:
        if not self._pointed:
            point_latest(self._directory)
            self._pointed = True


class LivePage(Watcher):
    """Writes `report.html` during a run, until the report replaces it; no server, no script.

    Args:
      directory, about, description: of the run, as `write_report` takes them.
      curves: phase → scalars to draw.
      usual_s: duration of the last run of the same configuration; `None` if there was none.
      clock: seconds.
    """

    def __init__(
        self,
        directory: Path,
        *,
        about: str,
        description: Mapping[str, Any],
        curves: Mapping[str, Sequence[str]],
        usual_s: float | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._directory, self._about, self._description = directory, about, description
        self._wanted, self._usual_s, self._clock = curves, usual_s, clock
        self._loops: Sequence[Loop] = ()
        self._samples: deque[tuple[str, int, TrainingSample]] = deque(maxlen=SAMPLES)
        self._drawn: dict[str, tuple[int, dict[str, PhaseCurves]]] = {}
        self._writing = threading.Lock()
        self._began = self._due = self._due_curves = clock()
        self.write_if_due()

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """Write the page again if it is time."""
        self.write_if_due()

    def looping(self, loops: Sequence[Loop]) -> None:
        """Write the page again if it is time."""
        self._loops = loops
        self.write_if_due()

    def sampled(self, stage: str, step: int, sample: TrainingSample) -> None:
        """Show the answer on the next page."""
        self._samples.appendleft((stage, step, sample))

    def end(self, error: BaseException) -> None:
        """Write the last page of a session that an error or a signal ended: the cause, and how to continue."""
        why = f"{type(error).__name__}: {error}".rstrip(": ")
        command = continuing(self._description["command"])
        with contextlib.suppress(Exception):  # the signal may have struck while Matplotlib was imported
            self._draw()
        self._write(f"Ended on {_now()} by {why}. To continue: {command}", reload_s=None)

    def write_if_due(self, *, curves: bool = True) -> None:
        """Write the page if it is time; its curves, which may take long, are drawn again only if asked for."""
        with self._writing:
            if self._clock() < self._due:
                return
            began = self._clock()
            if curves and began >= self._due_curves:
                self._draw()
                self._due_curves = self._clock() + (self._clock() - began) / CURVES_SHARE
            self._write(f"Running: this page is of {_now()} and reloads itself.", reload_s=PAGE_EVERY_S)
            self._due = self._clock() + PAGE_EVERY_S

    @contextlib.contextmanager
    def kept_fresh(self) -> Iterator[None]:
        """Write the page from a thread also while the block is silent, as in a compilation: it is never 30 s old."""
        ended = threading.Event()

        def watch() -> None:
            while not ended.wait(PAGE_EVERY_S):
                with contextlib.suppress(OSError):  # a full disk ends the run elsewhere
                    self.write_if_due(curves=False)

        thread = threading.Thread(target=watch, name="live page", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _write(self, state: str, reload_s: int | None) -> None:
        timing = read_times(self._directory / "timing.json")
        spent = f"{duration(timing.pop('total', 0.0) + self._clock() - self._began)} so far"
        usual = "no run of this configuration has finished yet"
        if self._usual_s is not None:
            usual = f"the last run of this configuration took {duration(self._usual_s)}"
        page = render(
            "live.jinja",
            about=self._about,
            description=self._description,
            timing=timing,
            verdict=(state, f"{spent}; {usual}."),
            data_title="Time so far",
            loops=tuple(self._loops),
            samples=tuple(self._samples),
            curves={name: drawn for _, phase in self._drawn.values() for name, drawn in phase.items()},
            reload_s=reload_s,
        )
        if self._directory.is_dir():  # else the run was moved, and no page must take its place
            write_text(self._directory / "report.html", page)

    def _draw(self) -> None:
        """Draw the curves of each phase; a phase without new lines is not drawn again."""
        rows: dict[str, list[Mapping[str, Any]]] = {}
        for line in read_metrics(self._directory):
            rows.setdefault(line["stage"].partition("/")[0], []).append(line)
        for phase, lines in rows.items():
            if self._drawn.get(phase, (0,))[0] != len(lines):
                self._drawn[phase] = len(lines), draw_phases(lines, self._wanted, most=MOST_PANELS)


def usual_seconds(home: Path, config: Any) -> float | None:
    """Seconds that the newest finished run of a configuration took; of one that is damaged a note, and `None`."""
    try:
        last = newest(home, config, finished=True)
        return None if last is None else read_times(last / "timing.json").get("total")
    except DamagedFileError as error:  # of which this run needs nothing
        print_lines(f"note: the usual time is unknown: {error}")
        return None


def _now() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S")


def missing(flag: str) -> str:
    """The fix where the package of a flag, one of `PACKAGES`, is not installed; nothing where it is."""
    package = PACKAGES[flag]
    if sys.modules.get(package) is not None or (package not in sys.modules and importlib.util.find_spec(package)):
        return ""
    return (
        f"--{flag} needs the package {package}, which is not installed: "
        f"pip install 'touchr1-jax[{flag}]', or leave the flag out"
    )


class Events(Watcher):
    """Writes every number of every logged line to TensorBoard's event files, a folder for every stage.

    A continued stage gets one more file, whose first event makes TensorBoard drop the events of the last session at or
    past its step.  Events have a time, lines of `metrics.jsonl` do not.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._make = importlib.import_module(TENSORBOARD).SummaryWriter
        self._writers: dict[str, Any] = {}

    def rewound(self, stage: str, step: int) -> None:
        """Begin a file of the stage."""
        if stage in self._writers:
            self._writers[stage].close()
        suffix = f".{time.time_ns()}"  # two files of one second would be one
        folder = str(self._folder / stage)
        self._writers[stage] = self._make(folder, purge_step=step, flush_secs=FLUSH_S, filename_suffix=suffix)

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """Write the numbers among the scalars."""
        for name, value in scalars.items():
            if isinstance(value, int | float):
                self._writers[stage].add_scalar(name, value, step)

    def closed(self) -> None:
        """Write what is left and close the files."""
        for writer in self._writers.values():
            writer.close()


class WeightsAndBiases(Watcher):
    """Sends every number of every logged line to Weights & Biases, with a step of its own for every stage.

    A continued run goes on in the same place.  Its environment variables count, such as WANDB_MODE and WANDB_PROJECT.
    """

    def __init__(self, directory: Path, description: Mapping[str, Any]) -> None:
        name = f"{description['experiment']}-{directory.name}"
        order = {"id": name, "name": name, "resume": "allow", "dir": str(directory), "config": description["config"]}
        self._run = importlib.import_module(WANDB).init(
            project=os.environ.get("WANDB_PROJECT", PROJECT), tags=[description["scale"]], **order
        )

    def rewound(self, stage: str, step: int) -> None:
        """Count the stage's steps by themselves."""
        self._run.define_metric(f"{stage}/*", step_metric=f"{stage}/step")

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """Send the numbers among the scalars."""
        numbers = {f"{stage}/{name}": value for name, value in scalars.items() if isinstance(value, int | float)}
        self._run.log({f"{stage}/step": step, **numbers})

    def closed(self) -> None:
        """Send what is left."""
        self._run.finish()
