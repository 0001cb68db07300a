"""Table and chart of the VTV protocol, ours beside the paper's."""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.bench.vtv import CHANCE
from experiments.core.charts import LOOK, PALETTE, SHARED, svg
from experiments.core.results import Cell, Column, Table
from experiments.study import paper_numbers as paper
from touchr1_jax.bench.averages import VTV, vtv_average
from touchr1_jax.bench.statistics import Interval

SHOWN = ("VTV-LLM-7B", "Ours")
"""Rows of the paper that are drawn."""

Rows = Mapping[str, Mapping[str, Interval]]
"""Answerer → task, and "average"."""


def vtv_table(rows: Rows) -> Table:
    """Every answerer, guessing, and every row of the paper."""
    ours: list[tuple[Cell, ...]] = [
        (name, *(row[task].mean for task in (*VTV, "average")), _span(row["average"])) for name, row in rows.items()
    ]
    guess: tuple[Cell, ...] = ("guessing", *(CHANCE[task] for task in VTV), vtv_average(CHANCE), None)
    theirs: list[tuple[Cell, ...]] = [
        (f"{'Touch-R1' if name == 'Ours' else name} (paper)", *values, average, None)
        for name, (values, average) in paper.VTV.items()
    ]
    return Table(
        title="The nine tasks, ours and the paper's",
        columns=(
            Column(name="row"),
            *(Column(name=name, format=".1f") for name in paper.VTV_COLUMNS),
            Column(name="Average", format=".1f", meaning="plain mean of the nine"),
            Column(name="95 %", meaning="of the average, whole objects resampled; the paper gives none"),
        ),
        rows=(*ours, guess, *theirs),
        note="Percent right. Direction, not parity: other objects, other questions, no language model. The paper's "
        "caption says that SOI is no percentage, but its averages take it as one.",
    )


def tasks_table(counts: Mapping[str, int], half: Mapping[str, float]) -> Table:
    """What each task asks, how often here, and how far 138 questions would scatter.

    Args:
      counts: task → questions.
      half: task → half the 95 % interval of a share like ours over as many questions as the benchmark has.
    """
    rows: list[tuple[Cell, ...]] = [(task, MEANINGS[task], counts[task], CHANCE[task], half[task]) for task in VTV]
    return Table(
        title="Tasks",
        columns=(
            Column(name="task"),
            Column(name="asks for"),
            Column(name="questions"),
            Column(name="chance", unit="%", format=".1f"),
            Column(
                name=f"± of {paper.VTV_ITEMS}",
                unit="points",
                format=".1f",
                meaning="half the 95 % interval of the first row's share if it were measured on the benchmark's number "
                "of questions of a property, taken as independent",
            ),
        ),
        rows=tuple(rows),
    )


MEANINGS: Mapping[str, str] = {
    "hardness": "its level, of three",
    "protrusion": "its level, of three",
    "elasticity": "its level, of three",
    "friction": "its level, of three",
    "combined": "all four levels",
    "sfd": "which of two has more of an attribute",
    "soi": "which of three has the most, or the least",
    "osc": "which recording is which of three named objects",
    "tsa": "which of two suits a scenario",
}


def vtv_chart(rows: Rows, best: str, lines: tuple[str, ...]) -> bytes:
    """Every task: the best row with its interval, other rows as dots, guessing as a bar, the paper as diamonds.

    Args:
      rows: answerer → task.
      best: the row with intervals.
      lines: further rows.
    """
    tasks = (*VTV, "average")
    y = np.arange(len(tasks))
    chance = {**CHANCE, "average": vtv_average(CHANCE)}
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(8.2, 4.4), layout="constrained")
        axes = figure.add_subplot()
        axes.vlines([chance[t] for t in tasks], y - 0.36, y + 0.36, color=SHARED, lw=1.6, label="guessing")
        spans = [rows[best][t] for t in tasks]
        axes.hlines(y, [s.low for s in spans], [s.high for s in spans], color=PALETTE[0], lw=2.4)
        axes.plot([s.mean for s in spans], y, "o", color=PALETTE[0], ms=7, mec="white", label=best)
        for name, colour in zip(lines, PALETTE[2:], strict=False):
            axes.plot([rows[name][t].mean for t in tasks], y, "s", color=colour, ms=4.5, label=name)
        for name, mark in zip(SHOWN, ("d", "D"), strict=True):
            values, average = paper.VTV[name]
            label = f"{'Touch-R1' if name == 'Ours' else name} (paper)"
            axes.plot([*values, average], y, mark, color=PALETTE[1], mfc="none", ms=6, label=label)
        axes.set(yticks=y, yticklabels=[*paper.VTV_COLUMNS, "Average"], xlim=(0, 100), ylim=(len(tasks) - 0.4, -0.6))
        axes.set_xlabel("right answers (%)")
        axes.grid(axis="y", visible=False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper left", ncols=3)
        return svg(figure)


def _span(interval: Interval) -> str:
    return f"[{interval.low:.1f}, {interval.high:.1f}]"
