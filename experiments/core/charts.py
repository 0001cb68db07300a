"""The charts of a report as SVG: training curves, and accuracy against the rate of middle answers."""

import io
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from experiments.core.results import Estimate
from touchr1_jax.bench.metrics import METRICS

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito's colours, which stay apart for colour-blind eyes (Wong, Nature Methods 8, 441, 2011)."""

SHARED = "#4d5560"
"""Colour of whatever belongs to no single arm."""

MARKERS = "Ds^vXph"

Curve = tuple[np.ndarray, np.ndarray]
"""Steps and values of one logged scalar of one stage."""

LOOK: dict[Any, Any] = {
    "svg.hashsalt": "touchr1-jax",  # the same data give the same file
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a929c",
    "axes.grid": True,
    "grid.color": "#eceff2",
    "axes.axisbelow": True,
    "legend.frameon": False,
}
"""Settings of every chart, for `matplotlib.rc_context`."""


def colours(arms: Iterable[str]) -> dict[str, str]:
    """The colour of every arm, the same in every chart and table."""
    return dict(zip(arms, itertools.cycle(PALETTE), strict=False))


def svg(figure: Figure) -> bytes:
    """The figure as SVG; the same figure gives the same bytes, made within `LOOK`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def curves_by_phase(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[tuple[str, str], Curve]]]:
    """Sort logged lines into phase → scalar → (arm, seed) → curve; the arm is empty where the stage names none."""
    points: dict[str, dict[str, dict[tuple[str, str], list[tuple[int, float]]]]] = {}
    for line in rows:
        phase, *middle = line["stage"].split("/")
        seed = middle.pop() if middle else "0"
        for name, value in line.items():
            if name not in ("stage", "step") and isinstance(value, int | float):
                series = points.setdefault(phase, {}).setdefault(name, {})
                series.setdefault(("/".join(middle), seed), []).append((line["step"], float(value)))
    return {
        phase: {name: {key: _curve(p) for key, p in series.items()} for name, series in scalars.items()}
        for phase, scalars in points.items()
    }


def training_curves(scalars: Mapping[str, Mapping[tuple[str, str], Curve]], colour: Mapping[str, str]) -> bytes:
    """One panel per scalar: a thin line per seed, a bold one for the running mean over the seeds of an arm.

    Args:
      scalars: scalar → (arm, seed) → curve, of one phase.
      colour: that of each arm; a curve of no arm is grey.
    """
    columns = min(3, len(scalars))
    rows = math.ceil(len(scalars) / columns)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(3.35 * columns, 0.35 + 2.15 * rows), layout="constrained")
        for i, (name, series) in enumerate(scalars.items()):
            axes = figure.add_subplot(rows, columns, i + 1)
            _draw_series(axes, series, colour)
            axes.set_title(name, fontsize=9.5, loc="left")
            if i >= len(scalars) - columns:
                axes.set_xlabel("step")
        arms = {arm: None for series in scalars.values() for arm, _ in series if arm}
        if arms:
            lines = [Line2D([], [], color=colour.get(arm, SHARED), lw=2) for arm in arms]
            figure.legend(lines, list(arms), loc="outside upper left", ncols=len(arms))
        return svg(figure)


def accuracy_against_middle(
    arms: Mapping[str, Mapping[str, Estimate]],
    baselines: Mapping[str, Mapping[str, Estimate]],
    colour: Mapping[str, str],
) -> bytes | None:
    """Accuracy over the rate of middle answers: small dots are seeds, large ones their mean; `None` if not measured."""
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.6, 3.7), layout="constrained")
        axes = figure.add_subplot()
        drawn = [_draw_point(axes, name, row, colour[name], "o") for name, row in arms.items()]
        for (name, row), marker in zip(baselines.items(), itertools.cycle(MARKERS), strict=False):
            drawn.append(_draw_point(axes, name, row, SHARED, marker))
        axes.set(xlabel=f"{METRICS['middle_rate'].meaning} (%)", ylabel=f"{METRICS['acc'].title} (%)")
        axes.margins(0.08)
        if not any(drawn):
            return None
        figure.legend(loc="outside right upper")
        return svg(figure)


def _draw_series(axes: Axes, series: Mapping[tuple[str, str], Curve], colour: Mapping[str, str]) -> None:
    """All thin lines first, so that no seed covers a mean."""
    arms = {arm: [curve for (a, _), curve in series.items() if a == arm] for arm, _ in series}
    for arm, curves in arms.items():
        for steps, values in curves:
            axes.plot(steps, values, color=colour.get(arm, SHARED), lw=0.6, alpha=0.25, zorder=2)
    halo = [Stroke(linewidth=3.4, foreground="white"), Normal()]
    for arm, curves in arms.items():
        common = sorted(set.intersection(*(set(steps.tolist()) for steps, _ in curves)))
        if common:
            mean = np.mean([values[np.isin(steps, common)] for steps, values in curves], axis=0)
            mark = "o" if len(common) == 1 else ""
            colour_a = colour.get(arm, SHARED)
            axes.plot(common, running_mean(mean), color=colour_a, lw=1.8, marker=mark, zorder=3, path_effects=halo)


def _draw_point(axes: Axes, name: str, row: Mapping[str, Estimate], colour: str, marker: str) -> bool:
    if "acc" not in row or "middle_rate" not in row:
        return False
    middle, acc = row["middle_rate"], row["acc"]
    if len(acc.per_seed) > 1:
        axes.scatter(middle.per_seed, acc.per_seed, s=14, color=colour, alpha=0.4, linewidths=0, marker=marker)
    axes.vlines(middle.mean, *acc.ci95, color=colour, lw=1)
    axes.scatter(middle.mean, acc.mean, s=62, color=colour, edgecolors="white", marker=marker, label=name, zorder=3)
    return True


def running_mean(values: np.ndarray) -> np.ndarray:
    """Centred mean over a twentieth of the points, the window cut off at the ends.

    Args:
      values: float [n].
    """
    half = len(values) // 40
    total = np.concatenate([[0.0], np.cumsum(values)])
    low = np.maximum(np.arange(len(values)) - half, 0)
    high = np.minimum(np.arange(len(values)) + half + 1, len(values))
    return (total[high] - total[low]) / (high - low)


def _curve(points: Sequence[tuple[int, float]]) -> Curve:
    """Sorted by step; of several lines with one step the last counts."""
    last = dict(points)
    steps = sorted(last)
    return np.array(steps), np.array([last[s] for s in steps])
