"""Largest memory of a reading over the weights, as bars."""

from collections.abc import Mapping

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.reporting.charts import LOOK, PALETTE, SHARED, svg


def memory_bars(ratios: Mapping[str, Mapping[str, float]], bound: float) -> bytes:
    """Horizontal bars, one per reader and size, over the bound that the readers must keep.

    Args:
      ratios: size → reader → peak over weights.
      bound: drawn as a dotted line.
    """
    rows = [(f"{size}, {reader}", reader, ratio) for size, by in ratios.items() for reader, ratio in by.items()]
    readers = list(dict.fromkeys(reader for _, reader, _ in rows))
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.4, 0.9 + 0.34 * len(rows)), layout="constrained")
        axes = figure.subplots()
        drawn = axes.barh(
            [label for label, _, _ in rows],
            [ratio for _, _, ratio in rows],
            color=[PALETTE[readers.index(reader)] for _, reader, _ in rows],
            height=0.62,
        )
        axes.bar_label(drawn, fmt="%.2f", padding=3)
        axes.axvline(1.0, color=SHARED, lw=0.8)
        axes.axvline(bound, color="black", ls=":", lw=1)
        axes.set(xlabel="largest resident size of the process, in weights")
        axes.invert_yaxis()
        axes.margins(x=0.1)
        return svg(figure)
