"""Charts of the contact experiments: speed against error, and maps of where a method breaks."""

import itertools
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from experiments.charts import LOOK, MARKERS, PALETTE, svg

Point = tuple[str, float, float, float]
"""Name, ms a frame, median error, 95th percentile of the error."""


def speed_against_error(groups: Mapping[str, Sequence[Point]], error: str, goal: tuple[float, float] | None) -> bytes:
    """Error over time a frame, logarithmic; each point's bar reaches from the median to the 95th percentile.

    Args:
      groups: points by kind; those of a kind are joined in the order given.
      error: label of the error axis.
      goal: time and error that must be kept, drawn as a corner; `None` for none.
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
            for name, x, y, _ in points:
                axes.annotate(name, (x, y), (5, 4), textcoords="offset points", fontsize=7.5, color=colour)
        if goal is not None:
            limit, bound = goal
            axes.plot([limit, limit, axes.get_xlim()[0]], [axes.get_ylim()[0], bound, bound], "k:", lw=1)
        axes.set(xscale="log", yscale="log", xlabel="time a frame, ms", ylabel=error)
        axes.legend(loc="best", fontsize=8)
        return svg(figure)


def failure_maps(
    maps: Mapping[str, np.ndarray],
    flagged: Mapping[str, np.ndarray],
    rows: tuple[str, Sequence[float]],
    columns: tuple[str, Sequence[float]],
    tolerance: float,
) -> bytes:
    """Error over two parameters, one panel a method, a cross where the method itself says that it must not be used.

    Args:
      maps: method → error [rows, columns].
      flagged: method → bool [rows, columns].
      rows, columns: label and values of either axis.
      tolerance: the error at which the colours turn.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(2.6 * len(maps) + 0.9, 3.1), layout="constrained")
        panels = figure.subplots(1, len(maps), squeeze=False)[0]
        scale = ScalarMappable(LogNorm(tolerance * 1e-2, 1.0), "cividis")
        for axes, (name, error) in zip(panels, maps.items(), strict=True):
            shown = np.maximum(error, tolerance * 1e-2)
            axes.imshow(shown, norm=scale.norm, cmap=scale.cmap, origin="lower", aspect="auto")
            y, x = np.nonzero(flagged[name])
            axes.plot(x, y, "x", color="white", ms=5)
            axes.grid(False)
            axes.set_title(name, fontsize=9)
            axes.set_xticks(range(len(columns[1])), [f"{v:g}" for v in columns[1]], fontsize=7)
            axes.set_yticks(range(len(rows[1])), [f"{v:g}" for v in rows[1]], fontsize=7)
            axes.set_xlabel(columns[0])
        panels[0].set_ylabel(rows[0])
        figure.colorbar(scale, ax=panels, label="error of displacement").ax.axhline(2 * tolerance, color="white", lw=1)
        return svg(figure)
