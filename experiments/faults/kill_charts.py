"""Where kills struck."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, svg
from experiments.faults.killable_session import PHASES, Kill

BINS = 20
"""Of the share of a run that was done."""


def where_kills_struck(kills: Mapping[str, Sequence[Kill]]) -> bytes:
    """Left: kills by phase; right: by the share of the run's steps that were done; stacked over victims."""
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(9.2, 3.4), layout="constrained")
        phase, share = figure.subplots(1, 2)
        shown = [p for p in reversed(PHASES) if any(k.phase == p for each in kills.values() for k in each)]
        left, below = np.zeros(len(shown)), np.zeros(BINS)
        edges = np.linspace(0, 1, BINS + 1)
        for (victim, each), colour in zip(kills.items(), PALETTE, strict=False):
            counts = np.array([sum(k.phase == p for k in each) for p in shown])
            phase.barh(shown, counts, left=left, color=colour, label=victim)
            done = np.histogram([k.done for k in each], edges)[0]
            share.bar(100 * edges[:-1], done, 100 / BINS, below, align="edge", color=colour, edgecolor="white", lw=0.5)
            left, below = left + counts, below + done
        for y, total in enumerate(left):
            phase.annotate(f"{total:.0f}", (total, y), (3, 0), textcoords="offset points", va="center", fontsize=8)
        phase.set(xlabel="kills", xlim=(0, 1.12 * max(left, default=1)))
        phase.grid(axis="y", visible=False)
        figure.legend(*phase.get_legend_handles_labels(), fontsize=8, loc="outside upper left", ncols=len(kills))
        share.set(xlabel="steps of the run done, %", ylabel="kills", xlim=(0, 100))
        share.grid(axis="x", visible=False)
        return svg(figure)
