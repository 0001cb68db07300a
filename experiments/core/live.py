"""The report of a run that is still going on: where it stands, the time left, the curves so far."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.core import charts, curves
from experiments.core.artifacts import read_json, write_text
from experiments.core.context import read_metrics
from experiments.core.page import Html, document, row, table, tag
from experiments.core.progress import Loop
from experiments.core.report_parts import appendix, curve_figure, curve_section, data_and_time, header
from experiments.core.runs import go_on
from experiments.core.text import duration, number
from experiments.core.watcher import Watcher

EVERY_S = 10
"""Seconds between two pages at least, and between two looks of a browser."""

SHARE = 0.01
"""Of the run's time that pages may take: one that took a second is followed by the next after 100 s."""

MOST = 9
"""Panels of a phase for which nobody chose the scalars."""


class LivePage(Watcher):
    """Writes `report.html` while a run goes on, until the report takes its place; no server, no script.

    Args:
      directory: the run's.
      about: docstring of the experiment; its first line is the question.
      description: content of the run's `config.json`.
      curves: of each phase the scalars to draw.
      usual_s: what the last run of the same configuration took; `None` if there was none.
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
        self._directory, self._description, self._curves, self._usual_s = directory, description, curves, usual_s
        self._question, _, rest = about.strip().partition("\n")
        self._rest = rest.strip()
        self._loops: Sequence[Loop] = ()
        self._drawn: dict[str, tuple[int, Html]] = {}
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
        """The last page of a session that something ended: why, and how to go on."""
        why = f"{type(error).__name__}: {error}".rstrip(": ")
        command = go_on(self._description["command"])
        self._write(f"Ended on {_clock()} by {why}. To go on: {command}", reload_s=None)

    def _look(self) -> None:
        """Write the page if the last one is old enough for what it cost."""
        began = time.monotonic()
        if began >= self._due:
            self._write(f"Going on: this page is of {_clock()} and reads itself again.", reload_s=EVERY_S)
            now = time.monotonic()
            self._due = now + max(EVERY_S, (now - began) / SHARE)

    def _write(self, state: str, reload_s: int | None) -> None:
        times = self._directory / "timing.json"
        timing = read_json(times) if times.exists() else {}
        earlier_s = timing.pop("total", 0.0)
        description = self._description
        page = document(
            f"{description['experiment']} · {description['scale']}",
            header(self._question, self._rest, description, {}, (state, self._spent(earlier_s))),
            _loops(self._loops),
            curve_section("Training curves so far", self._figures()),
            data_and_time({}, timing, "Time so far") if timing else Html(""),
            appendix(description),
            reload_s=reload_s,
        )
        write_text(self._directory / "report.html", page)

    def _spent(self, earlier_s: float) -> str:
        spent = f"{duration(earlier_s + time.monotonic() - self._began)} so far"
        if self._usual_s is None:
            return f"{spent}; no run of this configuration has finished yet."
        return f"{spent}; the last run of this configuration took {duration(self._usual_s)}."

    def _figures(self) -> dict[str, Html]:
        """The curves of each phase; a phase without new lines is not drawn again."""
        rows: dict[str, list[Mapping[str, Any]]] = {}
        for line in read_metrics(self._directory):
            rows.setdefault(line["stage"].partition("/")[0], []).append(line)
        for phase, lines in rows.items():
            if self._drawn.get(phase, (0,))[0] != len(lines):
                self._drawn[phase] = len(lines), self._figure(phase, lines)
        return {phase: figure for phase, (_, figure) in self._drawn.items() if phase in rows}

    def _figure(self, phase: str, lines: Sequence[Mapping[str, Any]]) -> Html:
        scalars = curves.curves_by_phase(lines).get(phase, {})
        wanted = [name for name in self._curves.get(phase, tuple(scalars)[:MOST]) if name in scalars]
        if not wanted:
            return Html("")
        drawn = {name: scalars[name] for name in wanted}
        arms = dict.fromkeys(arm for series in drawn.values() for arm, _ in series if arm)
        figure = curve_figure(phase, wanted, curves.training_curves(drawn, charts.colours(arms)))
        left = len(scalars) - len(wanted)
        return Html(figure + tag("p", f"Scalars in metrics.jsonl that are not drawn: {left}.", class_="note"))


def _loops(loops: Sequence[Loop]) -> Html:
    if not loops:
        return Html("")
    rows = [
        row(
            loop.title,
            f"{loop.completed:,} of {loop.total:,}",
            tag("td", tag("div", tag("i", style=f"left:0;width:{100 * _share(loop):.1f}%"), class_="bar")),
            f"{number(loop.rate, '.3g')}/s",
            loop.left or "–",
            tag("td", loop.note, class_="text"),
            head=1,
        )
        for loop in loops
    ]
    head = ["Loop", "steps", "", "rate", "time left", tag("th", "latest", class_="text")]
    return tag("section", tag("h2", "Under way"), table(head, rows))


def _share(loop: Loop) -> float:
    return min(loop.completed / loop.total, 1.0) if loop.total else 1.0


def _clock() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S")
