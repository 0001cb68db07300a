"""Methods under growing stress: the level at which each one breaks, and whether a flag warns of it."""

import collections
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.results import Picture, ReportPart, Table, at_most, named_table
from experiments.core.text import number
from sensors_io.fields.deformation import LOST_SHARE
from sensors_io.schema import Flag

OURS = "this"  # the package's method


class StressOutcome(NamedTuple):
    """One frame read by one method under one level of one stress, and the flags that warn of it.

    The error is in the unit of the chart, infinite where the method gives nothing; `wrong` is the share of the frame
    that is given and wrong.
    """

    error: float
    wrong: float
    flags: Flag

    @property
    def broken(self) -> bool:
        """More of the frame is wrong than a frame may lose."""
        return self.wrong > LOST_SHARE

    @property
    def silent(self) -> bool:
        """Broken without any flag."""
        return self.broken and not self.flags


StressOutcomes = Mapping[str, Mapping[tuple[str, float], Sequence[StressOutcome]]]
"""Method → (stress, level) → outcomes of all frames."""


def gathered(attempts: Iterable[tuple[str, str, float, StressOutcome]]) -> StressOutcomes:
    """Sort attempts (method, stress, level, outcome) by method, stress and level."""
    outcomes: dict[str, dict[tuple[str, float], list[StressOutcome]]] = {}
    for method, stress, level, outcome in attempts:
        outcomes.setdefault(method, {}).setdefault((stress, level), []).append(outcome)
    return outcomes


def silent_frames(by_level: Mapping[tuple[str, float], Sequence[StressOutcome]]) -> int:
    """Number of frames of one method that are broken without a flag."""
    return sum(outcome.silent for frames in by_level.values() for outcome in frames)


class StressedField(NamedTuple):
    """A field under stresses: name with the unit → levels, mild to severe; one panel of the chart each.

    A reading is wrong from an error of `tolerance` on; `failures` name the readings and their fault, where `OURS` must
    have no fault without a flag.
    """

    name: str
    stresses: Mapping[str, Sequence[float]]
    tolerance: float
    unit: str
    caption: str
    failures: tuple[str, str] | None = None

    @property
    def levels(self) -> list[tuple[str, float]]:
        """Name and level of every stress."""
        return [(stress, level) for stress, levels in self.stresses.items() for level in levels]


def stress_section(field: StressedField, outcomes: StressOutcomes) -> list[ReportPart]:
    """Table of first breaks and curves of the error of all methods; silent failures."""
    title, chart = f"Where {field.name} breaks", _curves(field, outcomes)
    picture = Picture(name=f"stability_{field.name}", title=title, caption=field.caption, content=chart)
    parts: list[ReportPart] = [break_table(field, outcomes), picture]
    if field.failures is not None:
        (readings, fault), silent = field.failures, {name: silent_frames(of) for name, of in outcomes.items()}
        counts = ", ".join(f"{method} {count}" for method, count in silent.items())
        total = sum(map(len, outcomes[OURS].values()))
        parts.append(f"Of {total} {readings} under stress, {fault} and not flagged: {counts}.")
        parts.append(at_most(f"{OURS}: {fault} and not flagged", silent[OURS], 0))
    return parts


def break_table(field: StressedField, outcomes: StressOutcomes) -> Table:
    """First broken level of every method under every stress, with the flags of the broken frames of all levels."""

    def cell(by_level: Mapping[tuple[str, float], Sequence[StressOutcome]], stress: str) -> str:
        broken = [(level, o) for level in field.stresses[stress] for o in by_level[stress, level] if o.broken]
        if not broken:
            return "–"
        words = {flag: str(flag.name).lower().replace("_", " ") for flag in Flag}
        names = (" + ".join(word for f, word in words.items() if f & o.flags) or "silent" for _, o in broken)
        counts = collections.Counter(names)
        return f"{number(broken[0][0])}: " + ", ".join(f"{name} {count}" for name, count in counts.items())

    return named_table(
        f"Where {field.name} breaks first",
        [{"method": m, **{s: cell(by_level, s) for s in field.stresses}} for m, by_level in outcomes.items()],
        note="First level at which any gel and motion breaks; then the number of broken frames over all levels by the "
        "flags that they carry; silent frames carry none.",
    )


def _curves(field: StressedField, outcomes: StressOutcomes) -> bytes:
    """The worst error of every method by level, one panel a stress, clipped to two decades around the tolerance."""
    first, tolerance = next(iter(outcomes)), field.tolerance
    panels = []
    for i, (stress, levels) in enumerate(field.stresses.items()):
        series = []
        for method in reversed(tuple(outcomes)):  # the first method is drawn last, over the others
            worst = [max(o.error for o in outcomes[method][stress, level]) for level in levels]
            error, width = np.clip(worst, 0.01 * tolerance, 100 * tolerance), 2.4 if method == first else 1.1
            series.append(Series(method, x=range(len(levels)), y=error, marker="", width=width))
        panel = Panel(
            series,
            title=stress,
            y_label="" if i % 4 else f"error, {field.unit}",
            y_scale="log",
            y_limits=(0.01 * tolerance, 130 * tolerance),
            x_ticks={x: number(level) for x, level in enumerate(levels)},
            rules=[Rule(y=tolerance)],
        )
        panels.append(panel)
    rows = -(-len(panels) // 4)
    return draw(panels, columns=4, size=(2.75 * min(4, len(panels)) + 0.6, 2.45 * rows + 0.8), share_y=True)
