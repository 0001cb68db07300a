"""Charts of `stability_grpo`: how many seeds fail at each value of a knob, one small panel for every failure."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.core.charts import LOOK, PALETTE, svg

FAILING, CURE = PALETTE[1], PALETTE[0]
COLUMNS = 4


class KnobPanel(NamedTuple):
    """One failure: its code and title, its knob, and of both sides the shares of seeds at every value.

    `failing` and `cure` are the seeds that failed, `failing_fired` and `cure_fired` those that raised its alarm.
    """

    title: str
    knob: str
    values: Sequence[float]
    failing: Sequence[float]
    cure: Sequence[float]
    failing_fired: Sequence[float]
    cure_fired: Sequence[float]


def failed_against_knob(panels: Sequence[KnobPanel]) -> bytes:
    """Share of seeds failed over the knob; values are evenly spaced in the order in which they are driven."""
    rows = math.ceil(len(panels) / COLUMNS)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(2.65 * COLUMNS, 0.4 + 2.0 * rows), layout="constrained")
        for i, panel in enumerate(panels):
            _draw(figure.add_subplot(rows, COLUMNS, i + 1), panel, first=i % COLUMNS == 0)
        lines = [
            Line2D([], [], color=FAILING, marker="o", ms=4, lw=1.6),
            Line2D([], [], color=CURE, marker="D", ms=3.5, lw=1.6),
            Line2D([], [], color="0.35", lw=1.2, ls=":"),
        ]
        names = ["paper or the named variant", "stable", "alarm raised, of either"]
        figure.legend(lines, names, loc="outside upper left", ncols=3)
        return svg(figure)


def _draw(axes: Axes, panel: KnobPanel, *, first: bool) -> None:
    place = np.arange(len(panel.values))
    axes.plot(place, panel.failing_fired, color=FAILING, lw=1.2, ls=":", clip_on=False)
    axes.plot(place, panel.cure_fired, color=CURE, lw=1.2, ls=":", clip_on=False)
    axes.plot(place, panel.failing, color=FAILING, marker="o", ms=4, lw=1.6, clip_on=False)
    axes.plot(place, panel.cure, color=CURE, marker="D", ms=3.5, lw=1.6, clip_on=False)
    axes.set_title(panel.title, fontsize=8.5, loc="left")
    axes.set_xticks(place, [f"{v:g}" for v in panel.values], fontsize=7.5)
    axes.set_xlabel(panel.knob, fontsize=7.5)
    axes.set_yticks([0, 0.5, 1], ["0", "½", "1"] if first else ["", "", ""])
    axes.set_ylim(0, 1)
    axes.margins(x=0.08)
    if first:
        axes.set_ylabel("share of seeds failed", fontsize=8)
