"""Charts of speed against error."""

import itertools
from collections.abc import Mapping, Sequence

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from experiments.core.charts import LOOK, MARKERS, PALETTE, svg
from experiments.core.names import Named, name_points

Point = tuple[str, float, float, float]
"""Name, ms a frame, median error, 95th percentile of the error."""


def speed_against_error(
    groups: Mapping[str, Sequence[Point]], error: str, goal: tuple[float, float] | None, *, legend: bool = True
) -> bytes:
    """Error over time a frame, logarithmic; each point's bar reaches from the median to the 95th percentile.

    Args:
      groups: points by kind; those of a kind are joined in the order given.
      error: label of the error axis.
      goal: time and error that must be kept, drawn as a corner; `None` for none.
      legend: of the kinds; without one the names of the points must say it.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.4, 4.6), layout="constrained")
        axes = figure.subplots()
        for (kind, points), colour, marker in zip(
            groups.items(), itertools.cycle(PALETTE), itertools.cycle(MARKERS), strict=False
        ):
            _, ms, median, high = zip(*points, strict=True)
            axes.plot(ms, median, marker=marker, color=colour, lw=1.2, ms=6, label=kind)
            axes.vlines(ms, median, high, color=colour, lw=1, alpha=0.5)
        if goal is not None:
            limit, bound = goal
            axes.plot([limit, limit, axes.get_xlim()[0]], [axes.get_ylim()[0], bound, bound], "k:", lw=1)
        axes.set(xscale="log", yscale="log", xlabel="time a frame, ms", ylabel=error)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))  # two decades leave few powers of ten
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        axes.margins(x=0.12)
        if legend:
            axes.legend(loc="best", fontsize=8)
        coloured = zip(groups.values(), itertools.cycle(PALETTE), strict=False)
        named = ((point, colour) for points, colour in coloured for point in points)
        name_points(axes, [Named(name=name, x=ms, y=median, colour=c) for (name, ms, median, _), c in named])
        return svg(figure)
