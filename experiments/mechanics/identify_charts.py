"""Charts of what touch tells: accuracy over noise beside the lines of chance, and what a tier costs in points."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.core.charts import LOOK, MARKERS, PALETTE, SHARED, svg
from touchr1_jax.bench.statistics import Interval

_LINES = ("--", ":", "-.")

LINEAR_POINTS = 5.0
"""Up to here the axis of lost points is linear, beyond it logarithmic: springs lose ten times what tiers lose."""

TICKS = (-5, -2, 0, 2, 5, 10, 20, 50)

Curves = Mapping[str, Sequence[Interval]]
"""Source → accuracy in % at each level of noise."""

Bars = Mapping[str, tuple[Interval, Sequence[float]]]
"""Tier → points lost, mean over the sensors with its interval, and each sensor's."""


def over_noise(
    panels: Mapping[str, Curves], factors: Sequence[float], lines: Mapping[str, Mapping[str, float]], chance: float
) -> bytes:
    """One panel per property: accuracy of every source over the noise, bars to the ends of the intervals; SVG.

    Args:
      panels: property → source → accuracy at each factor.
      factors: multiples of the sensors' noise, evenly spaced on the axis whatever they are.
      lines: property → name → accuracy that takes no touch.
      chance: of guessing.
    """
    with mpl.rc_context(LOOK | {"axes.grid.axis": "y"}):
        figure = Figure(figsize=(3.0 * len(panels) + 0.3, 3.5), layout="constrained")
        grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, curves) in zip(grid, panels.items(), strict=True):
            _curves(axes, curves)
            for (_, value), style in zip(lines[name].items(), _LINES, strict=False):
                axes.axhline(value, color=SHARED, lw=1.1, ls=style)
            axes.axhline(chance, color=SHARED, lw=0.6, alpha=0.6)
            axes.set_xticks(range(len(factors)), [f"×{factor:g}" for factor in factors])
            axes.set(title=name, xlabel="noise", xlim=(-0.35, len(factors) - 0.65))
        grid[0].set_ylabel("right on unseen objects, %")
        names = list(next(iter(lines.values())))
        without = [Line2D([], [], color=SHARED, lw=1.1, ls=s, label=n) for n, s in zip(names, _LINES, strict=False)]
        without.append(Line2D([], [], color=SHARED, lw=0.6, alpha=0.6, label="guessing"))
        handles, _ = grid[0].get_legend_handles_labels()
        figure.legend(handles=[*handles, *without], loc="outside lower center", ncols=4)
        return svg(figure)


def lost_points(panels: Mapping[str, Bars], bound: float) -> bytes:
    """One panel per property: points lost by every tier with intervals, a dot for every sensor; SVG.

    Args:
      panels: property → tier → points lost.
      bound: points that may be lost.
    """
    with mpl.rc_context(LOOK | {"axes.grid.axis": "x"}):
        figure = Figure(figsize=(2.9 * len(panels) + 1.0, 0.9 + 0.36 * len(next(iter(panels.values())))))
        figure.set_layout_engine("constrained")
        grid = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (name, tiers) in zip(grid, panels.items(), strict=True):
            rows = np.arange(len(tiers))
            means = np.array([interval.mean for interval, _ in tiers.values()])
            ends = np.array([(interval.low, interval.high) for interval, _ in tiers.values()])
            colours = [PALETTE[0] if mean <= bound else PALETTE[1] for mean in means]
            axes.barh(rows, means, height=0.56, color=colours, alpha=0.45)
            axes.hlines(rows, *ends.T, color=colours, lw=1.6)
            for row, (_, sensors) in zip(rows, tiers.values(), strict=True):
                axes.plot(sensors, np.full(len(sensors), row), "o", color=SHARED, ms=2.6, alpha=0.7)
            axes.axvline(0, color=SHARED, lw=0.8)
            axes.axvline(bound, color=SHARED, lw=0.9, ls=":")
            axes.set(title=name, xlabel="points lost", ylim=(len(tiers) - 0.4, -0.6))
            axes.set_xscale("symlog", linthresh=LINEAR_POINTS)
            axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
            axes.minorticks_off()
            axes.set_yticks(rows, list(tiers))
        return svg(figure)


def _curves(axes: Axes, curves: Curves) -> None:
    shift = np.linspace(-0.12, 0.12, len(curves))  # bars stand beside each other
    for (source, intervals), colour, marker, aside in zip(curves.items(), PALETTE, MARKERS, shift, strict=False):
        x = np.arange(len(intervals)) + aside
        mean, low, high = np.array([(i.mean, i.low, i.high) for i in intervals]).T
        axes.plot(x, mean, color=colour, marker=marker, ms=4.5, lw=1.4, label=source)
        axes.vlines(x, low, high, color=colour, lw=0.9, alpha=0.6)
