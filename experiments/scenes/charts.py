"""Chart of how fast scenes are made, and what takes the time."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, SHARED, svg

RecordRate = tuple[str, float, float]
"""Name, records a second, records a second that are required."""


def rates_and_stages(rates: Sequence[RecordRate], stages: Mapping[str, Mapping[str, float]]) -> bytes:
    """Bars of rates with a tick at what is required; stacked bars of the milliseconds of a record by sensor.

    Args:
      rates: one bar each, from the top.
      stages: sensor → part of the work → ms of one core.
    """
    with mpl.rc_context(LOOK | {"axes.grid": False}):
        figure = Figure(figsize=(8.6, 1.1 + 0.34 * max(len(rates), len(stages) + 1)), layout="constrained")
        left, right = figure.subplots(1, 2)
        names, measured, required = zip(*rates, strict=True)
        rows = np.arange(len(rates))
        left.barh(rows, measured, height=0.6, color=PALETTE[0])
        left.vlines(required, rows - 0.38, rows + 0.38, color=SHARED, lw=1.6, label="required")
        for row, value in zip(rows, measured, strict=True):
            left.annotate(f"{value:.0f}", (value, row), (4, 0), textcoords="offset points", va="center", fontsize=8)
        left.set_yticks(rows, names)
        left.set(xlabel="records/s by the clock", ylim=(len(rates) - 0.4, -0.6))
        left.margins(x=0.14)
        left.legend(loc="lower right", bbox_to_anchor=(1, 1), fontsize=8, borderaxespad=0.1)
        parts = list(next(iter(stages.values())))
        end = np.zeros(len(stages))
        for part, colour in zip(parts, PALETTE, strict=False):
            ms = np.array([max(costs[part], 0.0) for costs in stages.values()])
            right.barh(np.arange(len(stages)), ms, 0.6, left=end, color=colour, label=part)
            end += ms
        right.set_yticks(np.arange(len(stages)), list(stages))
        right.set(xlabel="ms of one core a record", ylim=(len(stages) - 0.4, -0.6))
        right.legend(
            loc="lower right", bbox_to_anchor=(1, 1), ncols=len(parts), fontsize=8, borderaxespad=0.1, columnspacing=1
        )
        return svg(figure)
