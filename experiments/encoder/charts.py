"""Charts of the encoder studies."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, Panel, Rule, Series, draw, svg
from touchr1_jax.bench.statistics import Interval
from touchr1_jax.training.probes import BOUNDS

Line = Mapping[str, Any]


def learning_curves(lines: Sequence[Line], seed: int) -> bytes:
    """Loss terms over steps; skill and probes on held-out objects over steps.

    Args:
      lines: the logged lines of a run with stages `dynamics/SEED` and `probe/SEED`.
      seed: which seed.
    """
    trained = [line for line in lines if line["stage"] == f"dynamics/{seed}"]
    probed = [line for line in lines if line["stage"] == f"probe/{seed}"]
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(10.2, 3.1), layout="constrained")
        terms, skills, probes = figure.subplots(1, 3)
        _draw(terms, trained, {"prediction": "prediction error", "variance_term": "variance term"}, dots=False)
        _draw(skills, trained, {"skill": "training batches"}, dots=False, faint=True)
        _draw(skills, probed[1:], {"skill": "over copy-last", "skill_over_mean": "over the step's mean"}, dots=True)
        names = ("hardness", "roughness", "protrusion")
        _draw(probes, probed, {f"probe_{name}": name for name in names}, dots=True)
        for axes, title in ((terms, "loss terms"), (skills, "held-out skill"), (probes, "linear probes, % right")):
            axes.set_title(title, fontsize=9.5, loc="left")
            axes.set_xlabel("step")
            axes.legend(fontsize=7.5)
        low = min((line["skill_over_mean"] for line in probed[1:]), default=0.0)
        skills.set_ylim(min(-0.1, low - 0.05), 1)
        return svg(figure)


def _draw(axes: Axes, lines: Sequence[Line], names: Mapping[str, str], *, dots: bool, faint: bool = False) -> None:
    steps = [line["step"] for line in lines]
    for (name, label), colour in zip(names.items(), PALETTE, strict=False):
        values = [line[name] for line in lines]
        style: dict[str, Any] = {"color": "#b8c0c8", "lw": 0.8} if faint else {"color": colour, "lw": 1.4}
        axes.plot(steps, values, marker="o" if dots else "", ms=4, label=label, **style)


BOUNDED = {"kept": "told apart, over untrained", "rank_share": "effective rank, share of width", "skill": "skill"}
"""Panels of the courses of collapse, by the name of the alarm."""


def collapse_curves(courses: Mapping[str, Mapping[str, np.ndarray]], block_steps: int) -> bytes:
    """One panel per alarm: measurements [seed, block] of every arm over steps, and the alarm's bound.

    Args:
      courses: arm → alarm → measurements.
      block_steps: steps between two measurements.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(10.2, 3.9), layout="constrained")
        panels = figure.subplots(1, len(BOUNDED))
        for axes, (metric, title) in zip(panels, BOUNDED.items(), strict=True):
            for (arm, looks), colour, dashes in zip(courses.items(), cycle(COLOURS), cycle(DASHES), strict=False):
                values = looks[metric]
                steps = block_steps * np.arange(1, values.shape[1] + 1)
                for seed in values:
                    axes.plot(steps, seed, color=colour, lw=0.5, alpha=0.25)
                axes.plot(steps, np.median(values, 0), dashes, color=colour, lw=1.7, label=arm)
            axes.axhline(BOUNDS[metric][0], color="k", lw=0.9, ls=":")
            axes.set_title(title, fontsize=9.5, loc="left")
            axes.set_xlabel("step")
        panels[0].set_yscale("log")
        panels[0].yaxis.set_major_formatter("{x:g}")
        panels[1].set_ylim(0, 1)
        panels[2].set_ylim(-1, 1)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7.5)
        return svg(figure)


COLOURS = (*PALETTE, "#4d5560", "#8c564b")
DASHES = ("-", "-", "-", "-", "--", "--", "--", "-")
"""Arms that take guards away are drawn through, those that give some back dashed."""


def accuracy_against_time(
    points: Sequence[tuple[str, str, float, float, Interval]], reference: float, goal: tuple[float, float]
) -> bytes:
    """Probe accuracy over milliseconds a prompt, a colour and marker for each kind of saving.

    Args:
      points: name, kind, ms, accuracy in percent, interval of the points below the reference.
      reference: accuracy that the intervals are about.
      goal: time and accuracy that must be kept, drawn as a corner.
    """
    series = []
    for kind in dict.fromkeys(kind for _, kind, *_ in points):
        names, _, ms, accuracy, lost = zip(*(point for point in points if point[1] == kind), strict=True)
        ends: dict[str, Any] = {
            "low": [reference - span.high for span in lost],
            "high": [reference - span.low for span in lost],
        }
        series.append(Series(f"saving in {kind}", x=ms, y=accuracy, **ends, line="", size=46, labels=names))
    panel = Panel(
        series,
        x_label="forward, ms a prompt of 8 frames × 4 sensors",
        y_label="probes right, %",
        x_scale="log",
        rules=[Rule(x=goal[0], y=goal[1], keep="above")],
    )
    return draw([panel], size=(8.4, 5.0))
