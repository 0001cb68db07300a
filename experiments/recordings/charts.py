"""Charts of the study of real recordings."""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.recordings.policy import LANGUAGE, LEVELS
from experiments.reporting.charts import LOOK, MARKERS, PALETTE, svg
from touchr1_jax.bench.statistics import Interval


def confusions(answer: np.ndarray, label: np.ndarray, titles: tuple[str, ...]) -> bytes:
    """How often each level is answered for each label: one panel per attribute, rows sum to 100 %.

    Args:
      answer, label: int [n, A].
      titles: what the attributes are called.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(9.0, 3.2), layout="constrained")
        for a, axes in enumerate(figure.subplots(1, len(titles))):
            _draw_confusion(axes, answer[:, a], label[:, a], titles[a], [words[0] for words in _words(a)])
        return svg(figure)


def against_objects(curves: Mapping[str, Mapping[int, Interval]], goals: Mapping[str, float]) -> bytes:
    """Scores in per cent over the number of objects learned from, with their intervals; goals are dotted.

    Args:
      curves: score → number of objects → interval.
      goals: score → what is asked for.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.4, 3.6), layout="constrained")
        axes = figure.subplots()
        for (name, curve), colour, marker in zip(curves.items(), PALETTE, MARKERS, strict=False):
            x, found = np.array(list(curve)), list(curve.values())
            axes.plot(x, [i.mean for i in found], color=colour, marker=marker, lw=1.6, label=name)
            axes.vlines(x, [i.low for i in found], [i.high for i in found], color=colour, lw=1, alpha=0.5)
            axes.axhline(goals[name], color=colour, ls=":", lw=1)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set(xlabel="objects learned from", ylabel="%", ylim=(0, 100), xlim=(0, None))
        figure.legend(loc="outside right upper")
        return svg(figure)


def _draw_confusion(axes: Axes, answer: np.ndarray, label: np.ndarray, title: str, words: list[str]) -> None:
    count = np.zeros((LEVELS, LEVELS), int)
    np.add.at(count, (label, answer), 1)
    share = count / np.maximum(count.sum(1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for i, j in np.ndindex(*count.shape):
        axes.text(j, i, f"{share[i, j]:.0%}\n{count[i, j]}", ha="center", va="center", fontsize=8.5,
                  color="white" if share[i, j] > 0.55 else "black")  # fmt: skip
    axes.set_title(title, fontsize=9.5, loc="left")
    axes.set_xticks(range(LEVELS), words)
    axes.set_yticks(range(LEVELS), words)
    axes.set(xlabel="answered", ylabel="label")
    axes.grid(visible=False)


def _words(attribute: int) -> tuple[tuple[str, ...], ...]:
    return LANGUAGE.attributes[attribute].levels
