"""Charts of the ladder: what each component changes here and in the paper."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.core.charts import LOOK, PALETTE, SHARED, svg
from experiments.paper.conflict_metrics import Contrast
from experiments.paper.deltas import Delta, Measure
from touchr1_jax.bench.statistics import Interval

OURS, PAPER = PALETTE[0], PALETTE[1]


def delta_chart(found: Sequence[Delta]) -> bytes:
    """One panel for each measure, one line for each step: our difference with both intervals, the paper's beside it.

    Args:
      found: all differences of a table.
    """
    measures = list(dict.fromkeys(d.measure for d in found))
    steps = list(dict.fromkeys(d.step for d in found))
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(3.1 * len(measures) + 1.2, 0.42 * len(steps) + 1.3), layout="constrained")
        panels = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
        for axes, measure in zip(panels, measures, strict=True):
            of = {d.step: d for d in found if d.measure == measure}
            _panel(axes, measure, [of.get(step) for step in steps])
        panels[0].set_yticks(range(len(steps)), [f"+ {step.adds}" for step in steps])
        panels[0].invert_yaxis()
        marks = [
            Line2D([], [], color=OURS, marker="o", lw=2.4, label="here, 95 % over seeds"),
            Line2D([], [], color=OURS, lw=1, alpha=0.5, label="95 % over objects"),
            Line2D([], [], color=PAPER, marker="D", ls="", mfc="none", label="paper"),
        ]
        figure.legend(handles=marks, loc="outside upper left", ncols=3)
        return svg(figure)


def _panel(axes: Axes, measure: Measure, found: Sequence[Delta | None]) -> None:
    axes.axvline(0, color=SHARED, lw=0.8)
    for y, delta in enumerate(found):
        if delta is None:
            continue
        axes.plot([delta.objects.low, delta.objects.high], [y + 0.12] * 2, color=OURS, lw=1, alpha=0.5)
        axes.plot([delta.seeds.low, delta.seeds.high], [y, y], color=OURS, lw=2.4)
        axes.plot(delta.seeds.mean, y, "o", color=OURS, ms=6, mec="white")
        if delta.published is not None:
            axes.plot(delta.published, y - 0.2, "D", color=PAPER, ms=6, mfc="none")
    axes.set_xlabel(f"change of {measure.title}", fontsize=9)
    axes.margins(x=0.08)
    axes.grid(axis="y", visible=False)
    axes.set_ylim(-0.6, len(found) - 0.4)


def believed_chart(contrasts: Mapping[str, Contrast], gains: Mapping[str, Interval]) -> bytes:
    """Left: right answers of two policies on groups of questions; right: what each control of touch costs.

    Args:
      contrasts: group → the policy with touch against the one without.
      gains: control → points.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(9.4, 0.4 * len(contrasts) + 1.4), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(2, 1))
        y = np.arange(len(contrasts))
        left.barh(y - 0.18, [c.theirs for c in contrasts.values()], 0.34, color=PAPER, label="without touch")
        left.barh(y + 0.18, [c.ours for c in contrasts.values()], 0.34, color=OURS, label="full model")
        for at, c in enumerate(contrasts.values()):
            left.plot([c.theirs + c.objects.low, c.theirs + c.objects.high], [at + 0.18] * 2, color="k", lw=1)
        left.set_yticks(y, list(contrasts))
        left.invert_yaxis()
        left.set_xlabel("right answers (%)")
        left.grid(axis="y", visible=False)
        for at, gain in enumerate(gains.values()):
            right.plot([gain.low, gain.high], [at, at], color=OURS, lw=2.4)
            right.plot(gain.mean, at, "o", color=OURS, mec="white", ms=7)
        right.axvline(0, color=SHARED, lw=0.8)
        right.set_yticks(range(len(gains)), list(gains))
        right.invert_yaxis()
        right.set_ylim(len(gains) - 0.5, -0.5)
        right.set_xlabel("gain from touch over it (points)")
        right.grid(axis="y", visible=False)
        figure.legend(*left.get_legend_handles_labels(), loc="outside upper left", ncols=2)
        return svg(figure)
