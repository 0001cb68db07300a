"""Figures of a handful of named things as horizontal bars."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, svg


def bars(
    values: Mapping[str, float],
    label: str,
    *,
    written: str = "{:.2g}",
    bounds: Sequence[float] = (),
    logarithmic: bool = False,
) -> bytes:
    """One bar for each name, its figure written beside it, as SVG.

    Args:
      values: name → figure, from the top; above 0 where the axis is logarithmic.
      label: of the axis, with the unit.
      written: how a figure is written.
      bounds: drawn as dotted lines.
      logarithmic: whether equal distances are equal ratios.
    """
    figures = (*values.values(), *bounds)
    lowest, highest = min(figures), max(figures)
    limits = (lowest / 2, 2 * highest) if logarithmic else (0.0, 1.12 * highest)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.2, 0.9 + 0.34 * len(values)), layout="constrained")
        axes = figure.subplots()
        drawn = axes.barh(list(values), list(values.values()), color=PALETTE[0], height=0.6)
        axes.bar_label(drawn, fmt=written, padding=3, fontsize=8)
        for bound in bounds:
            axes.axvline(bound, color="black", linestyle=":", linewidth=1)
        axes.set(xlabel=label, xscale="log" if logarithmic else "linear", xlim=limits)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        return svg(figure)
