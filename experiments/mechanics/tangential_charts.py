"""Charts of the friction experiment: speed against error by what is prescribed, and promises against errors."""

import itertools
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from experiments.core.charts import LOOK, MARKERS, SHARED, Point, colours, svg

_PER_CENT = FuncFormatter(lambda value, _: f"{100 * value:g} %")
_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
_LEAST = 1e-5  # errors below it are drawn there: float32 carries little more
_TICKS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)


def speed_panels(panels: Mapping[str, Mapping[str, Sequence[Point]]]) -> bytes:
    """Error over time a frame, one panel a task, the same colour for a kind of method in all.

    Args:
      panels: task → kind of method → points, joined in the order given; bars reach from median to 95th percentile.
    """
    kinds = list(dict.fromkeys(kind for groups in panels.values() for kind in groups))
    colour, marker = colours(kinds), dict(zip(kinds, itertools.cycle(MARKERS), strict=False))
    rows = (len(panels) + 1) // 2
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(8.6, 0.5 + 3.1 * rows), layout="constrained")
        axes = figure.subplots(rows, 2, sharey=True, squeeze=False)
        shown = axes.ravel()[: len(panels)]
        for each, (title, groups) in zip(shown, panels.items(), strict=True):
            for order, (kind, points) in enumerate(groups.items()):
                names, ms, *errors = zip(*points, strict=True)
                median, high = (np.maximum(error, _LEAST) for error in errors)
                each.plot(ms, median, marker=marker[kind], color=colour[kind], lw=1.2, ms=5.5)
                each.vlines(ms, median, high, color=colour[kind], lw=1, alpha=0.5)
                for name, x, y in zip(names, ms, median, strict=True):
                    aside = (5, 3) if order % 2 else (-12, -9)  # curves that cross are named on either side
                    each.annotate(name, (x, y), aside, textcoords="offset points", fontsize=7, color=colour[kind])
            each.set(xscale="log", yscale="log")
            each.set_title(title, fontsize=9.5, loc="left")
            each.set_xlabel("time a frame, ms")
            each.xaxis.set_major_formatter(_PLAIN)
            each.yaxis.set_major_formatter(_PER_CENT)
            each.minorticks_off()
            each.margins(x=0.12)
        for each in axes[:, 0]:
            each.set_ylabel("error of the marker displacement")
        for empty in axes.ravel()[len(panels) :]:
            empty.set_axis_off()
        lines = [Line2D([], [], color=colour[k], marker=marker[k], lw=1.2, ms=5.5) for k in kinds]
        figure.legend(lines, kinds, loc="outside upper center", ncols=min(len(kinds), 3))
        return svg(figure)


def promise_scatter(points: Mapping[str, Sequence[tuple[float, float]]]) -> bytes:
    """Error over promise, both relative, a dot a contact; below the line the promise is kept.

    Args:
      points: kind of body → (promised, error).
    """
    every = np.array([pair for pairs in points.values() for pair in pairs])
    low, high = 0.7 * every.min(), 1.4 * every.max()
    colour = colours(points)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(5.4, 4.0), layout="constrained")
        axes = figure.add_subplot()
        axes.plot([low, high], [low, high], color=SHARED, lw=1, ls=":")
        for (kind, pairs), marker in zip(points.items(), itertools.cycle("os^Dv"), strict=False):
            promised, error = zip(*pairs, strict=True)
            axes.scatter(promised, error, s=22, color=colour[kind], marker=marker, alpha=0.75, linewidths=0, label=kind)
        axes.set(xscale="log", yscale="log", xlabel="promised error", ylabel="error of the superposition")
        ticks = [tick for tick in _TICKS if low < tick < high]
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_ticks(ticks, [f"{100 * tick:g} %" for tick in ticks])
        axes.minorticks_off()
        axes.legend(fontsize=8)
        return svg(figure)
