"""Charts of what GRPO's algorithms cost and gain."""

import dataclasses
import itertools
from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.core.charts import LOOK, MARKERS, PALETTE, SHARED, svg
from experiments.core.curves import running_mean

Key = tuple[str, int]
"""Algorithm and group size."""

COLUMNS = 3  # panels in a row


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearningCurves:
    """One algorithm and group size: mean reward of every seed's steps, [seeds, steps], and the seconds of a step."""

    rewards: np.ndarray
    step_s: float

    @property
    def score(self) -> float:
        """Mean reward over the last tenth of the steps and over the seeds."""
        return float(self.rewards[:, -max(1, self.rewards.shape[1] // 10) :].mean())

    def reached(self, target: float) -> np.ndarray:
        """Steps until each seed's reward first passes the target, [seeds]; ∞ where it never does."""
        passed = self.rewards >= target
        return np.where(passed.any(1), passed.argmax(1) + 1.0, np.inf)


def cost_and_gain(courses: Mapping[Key, LearningCurves], target: float, default: Key) -> bytes:
    """Score over the time of a step, and time to the target by algorithm.

    Args:
      courses: by algorithm and group size.
      target: reward that is to be passed.
      default: the one that is ringed.
    """
    colour, marker = _keys(courses)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(9.0, 3.9), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.1, 1))
        for key, c in courses.items():
            name, group = key
            left.plot(1e3 * c.step_s, c.score, marker[group], color=colour[name], ms=7, mew=0)
            steps = c.reached(target)
            there = np.isfinite(steps)
            if there.any():
                face = colour[name] if there.all() else "white"
                seconds = float(np.median(steps[there])) * c.step_s
                right.plot(seconds, name, marker[group], color=colour[name], mfc=face, ms=7)
            if key == default:
                _ring(left, 1e3 * c.step_s, c.score)
                if there.any():
                    _ring(right, seconds, name)
        left.axhline(target, color="k", lw=0.8, ls=":")
        left.set(xlabel="a step, ms", ylabel="score: mean reward at the end")
        right.set(xlabel=f"time to a mean reward of {target:g}, s", xlim=(0, None))
        right.margins(y=0.12)
        right.invert_yaxis()
        algorithms = [Line2D([], [], color=colour[n], marker="o", ls="", label=n) for n in colour]
        groups = [Line2D([], [], color=SHARED, marker=m, ls="", label=f"groups of {g}") for g, m in marker.items()]
        figure.legend(handles=[*algorithms, *groups], loc="outside lower center", ncols=5, fontsize=8)
        return svg(figure)


def reward_over_time(courses: Mapping[Key, LearningCurves], target: float) -> bytes:
    """Mean reward over seconds, a panel for each algorithm and a line for each group size.

    Args:
      courses: by algorithm and group size.
      target: drawn as a level line.
    """
    names, groups = list(dict.fromkeys(n for n, _ in courses)), list(dict.fromkeys(g for _, g in courses))
    colour = dict(zip(groups, itertools.cycle(PALETTE), strict=False))
    with mpl.rc_context(LOOK):
        rows = -(-len(names) // COLUMNS)
        figure = Figure(figsize=(9.0, 0.5 + 2.1 * rows), layout="constrained")
        panels = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False).ravel()
        for name, axes in zip(names, panels, strict=False):
            for group in groups:
                c = courses[name, group]
                time = c.step_s * np.arange(1, c.rewards.shape[1] + 1)
                axes.plot(time, running_mean(c.rewards.mean(0)), color=colour[group], lw=1.4)
            axes.axhline(target, color="k", lw=0.8, ls=":")
            axes.set_title(name, loc="left", fontsize=9.5)
        for axes in panels[len(names) :]:
            axes.set_visible(False)
        for axes in panels[::COLUMNS]:
            axes.set_ylabel("mean reward")
        for axes in panels[-COLUMNS:]:
            axes.set_xlabel("time, s")
        lines = [Line2D([], [], color=colour[g], lw=2, label=f"groups of {g}") for g in groups]
        figure.legend(handles=lines, loc="outside upper left", ncols=len(groups), fontsize=8)
        return svg(figure)


def _keys(courses: Mapping[Key, LearningCurves]) -> tuple[dict[str, str], dict[int, str]]:
    """Colour of each algorithm, marker of each group size."""
    colour = dict(zip(dict.fromkeys(name for name, _ in courses), itertools.cycle(PALETTE), strict=False))
    return colour, dict(zip(dict.fromkeys(group for _, group in courses), itertools.cycle(MARKERS), strict=False))


def _ring(axes: Axes, x: float, y: float | str) -> None:
    axes.plot(x, y, "o", mfc="none", mec="k", ms=13, mew=1)
