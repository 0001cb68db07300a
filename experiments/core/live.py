"""The page of a run in progress: its loops, the time left, the training curves so far."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core.artifacts import read_json, write_text
from experiments.core.context import read_metrics
from experiments.core.curves import PhaseCurves, draw_phases
from experiments.core.pages import render
from experiments.core.progress import Loop, Watcher
from experiments.core.runs import continuing
from experiments.core.text import duration

EVERY_S = 10
"""Least seconds between two pages, and between two reloads by a browser."""

SHARE = 0.01
"""Share of the run's time for pages: after one that took a second, the next follows after 100 s."""

MOST = 9
"""Panels of a phase whose scalars the experiment does not choose."""


class LivePage(Watcher):
    """Writes `report.html` during a run, until the report replaces it; no server, no script.

    Args:
      directory: the run's.
      about: docstring of the experiment; its first line is the question.
      description: content of the run's `config.json`.
      curves: phase → scalars to draw.
      usual_s: duration of the last run of the same configuration; `None` if there was none.
    """

    def __init__(
        self,
        directory: Path,
        *,
        about: str,
        description: Mapping[str, Any],
        curves: Mapping[str, Sequence[str]],
        usual_s: float | None,
    ) -> None:
        self._directory, self._about, self._description = directory, about, description
        self._wanted, self._usual_s = curves, usual_s
        self._loops: Sequence[Loop] = ()
        self._drawn: dict[str, tuple[int, dict[str, PhaseCurves]]] = {}
        self._began = self._due = time.monotonic()
        self._look()

    def logged(self, stage: str, step: int, scalars: Mapping[str, Any]) -> None:
        """Write the page again if it is time."""
        self._look()

    def looping(self, loops: Sequence[Loop]) -> None:
        """Write the page again if it is time."""
        self._loops = loops
        self._look()

    def end(self, error: BaseException) -> None:
        """Write the last page of a session that an error or a signal ended: the cause, and how to continue."""
        why = f"{type(error).__name__}: {error}".rstrip(": ")
        command = continuing(self._description["command"])
        self._write(f"Ended on {_clock()} by {why}. To continue: {command}", reload_s=None)

    def _look(self) -> None:
        """Write the page if the last one is old enough for its cost."""
        began = time.monotonic()
        if began >= self._due:
            self._write(f"Running: this page is of {_clock()} and reloads itself.", reload_s=EVERY_S)
            now = time.monotonic()
            self._due = now + max(EVERY_S, (now - began) / SHARE)

    def _write(self, state: str, reload_s: int | None) -> None:
        times = self._directory / "timing.json"
        timing = read_json(times) if times.exists() else {}
        earlier_s = timing.pop("total", 0.0)
        page = render(
            "live.jinja",
            about=self._about,
            description=self._description,
            settings={},
            verdict=(state, self._spent(earlier_s)),
            data={},
            data_title="Time so far",
            timing=timing,
            loops=self._loops,
            curves=self._draw(),
            reload_s=reload_s,
        )
        write_text(self._directory / "report.html", page)

    def _spent(self, earlier_s: float) -> str:
        spent = f"{duration(earlier_s + time.monotonic() - self._began)} so far"
        if self._usual_s is None:
            return f"{spent}; no run of this configuration has finished yet."
        return f"{spent}; the last run of this configuration took {duration(self._usual_s)}."

    def _draw(self) -> dict[str, PhaseCurves]:
        """The curves of each phase; a phase without new lines is not drawn again."""
        rows: dict[str, list[Mapping[str, Any]]] = {}
        for line in read_metrics(self._directory):
            rows.setdefault(line["stage"].partition("/")[0], []).append(line)
        for phase, lines in rows.items():
            if self._drawn.get(phase, (0,))[0] != len(lines):
                self._drawn[phase] = len(lines), draw_phases(lines, self._wanted, most=MOST)
        return {name: drawn for phase in rows for name, drawn in self._drawn[phase][1].items()}


def _clock() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S")
