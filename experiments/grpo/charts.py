"""Charts of the GRPO experiments."""

import itertools
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.reporting.charts import LOOK, PALETTE, svg

STYLES = ("-", "--", ":", "-.")

Course = tuple[float, Sequence[Sequence[float]]]
"""Seconds a step, and the rewards of every seed's steps."""


def reward_over_time(courses: Mapping[tuple[str, int], Course], target: float) -> bytes:
    """Mean reward over seconds; a colour for each algorithm, a line style for each group size.

    Args:
      courses: by algorithm and group size.
      target: drawn as a level line.
    """
    names, groups = (list(dict.fromkeys(key[i] for key in courses)) for i in (0, 1))
    colour = dict(zip(names, itertools.cycle(PALETTE), strict=False))
    style = dict(zip(groups, itertools.cycle(STYLES), strict=False))
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.4, 4.2), layout="constrained")
        axes = figure.subplots()
        for (name, group), (step_s, rewards) in courses.items():
            steps = min(map(len, rewards))
            mean = np.mean([r[:steps] for r in rewards], axis=0)
            label = f"{name}, {group}"
            axes.plot(step_s * np.arange(1, steps + 1), mean, style[group], color=colour[name], lw=1.3, label=label)
        axes.axhline(target, color="k", lw=0.8, ls=":")
        axes.set(xlabel="time, s", ylabel="mean reward of a step")
        axes.legend(fontsize=7.5, ncols=2, title="algorithm, group")
        return svg(figure)
