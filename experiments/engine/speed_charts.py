"""Charts of the speed of GRPO."""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, MARKERS, PALETTE, svg
from experiments.engine.speed import RESIDENT_EVERY, LongRun

Series = Mapping[str, Mapping[int, float]]
"""Engine → prefix → figure."""


def over_prefixes(seconds: Series, memory_gb: Series, limits_s: Mapping[int, float], limit_gb: float) -> bytes:
    """Time and peak memory of every engine over the prefix, both axes logarithmic.

    Args:
      seconds: of an iteration.
      memory_gb: peak of the process.
      limits_s: bounds by prefix, drawn as crosses.
      limit_gb: a bound, drawn as a line.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(8.2, 3.9), layout="constrained")
        left, right = figure.subplots(1, 2)
        _lines(left, seconds, "an iteration, s")
        left.plot(list(limits_s), list(limits_s.values()), "kx", ms=7, label="bound of this engine")
        _lines(right, memory_gb, "peak memory, GB")
        right.axhline(limit_gb, color="k", lw=0.9, ls=":")
        left.legend(fontsize=8)
        return svg(figure)


def _lines(axes: Axes, series: Series, label: str) -> None:
    prefixes = sorted({prefix for figures in series.values() for prefix in figures})
    for (name, figures), colour, marker in zip(series.items(), PALETTE, MARKERS, strict=False):
        axes.plot(list(figures), list(figures.values()), color=colour, marker=marker, ms=5, lw=1.5, label=name)
    axes.set(xscale="log", yscale="log", xlabel="prompt, tokens", ylabel=label)
    axes.set_xticks(prefixes, map(str, prefixes))
    axes.minorticks_off()
    axes.yaxis.set_major_formatter("{x:g}")


def over_steps(course: LongRun) -> bytes:
    """Time of a step, median and 5th to 95th percentile of every hundred, and the memory held."""
    bins = course.seconds[: len(course.seconds) // RESIDENT_EVERY * RESIDENT_EVERY].reshape(-1, RESIDENT_EVERY)
    low, middle, high = 1e3 * np.percentile(bins, (5, 50, 95), axis=1)
    at = RESIDENT_EVERY * np.arange(1, len(bins) + 1)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(8.2, 3.0), layout="constrained")
        left, right = figure.subplots(1, 2)
        left.fill_between(at, low, high, color=PALETTE[0], alpha=0.25, lw=0)
        left.plot(at, middle, color=PALETTE[0], lw=1.4)
        left.set(xlabel="step", ylabel="a step, ms", ylim=(0, 1.3 * np.percentile(high, 95)))
        right.plot(at, course.resident_mb, color=PALETTE[1], lw=1.6)
        right.set(xlabel="step", ylabel="memory held, MB", ylim=(0, 1.2 * course.resident_mb.max()))
        return svg(figure)
