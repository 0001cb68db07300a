"""Charts of the study of real recordings."""

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, MARKERS, PALETTE, svg
from experiments.core.pictures import heatmaps
from experiments.recordings.policy import LANGUAGE
from experiments.study.levels import confusion_map
from touchr1_jax.bench.statistics import Interval


def confusions(answer: np.ndarray, label: np.ndarray, titles: tuple[str, ...]) -> bytes:
    """Frequency of each answered level for each label: one panel per attribute, rows sum to 100 %.

    Args:
      answer, label: int [n, A].
      titles: what the attributes are called.
    """
    maps = [
        confusion_map(answer[:, a], label[:, a], [words[0] for words in _words(a)], title)
        for a, title in enumerate(titles)
    ]
    return heatmaps(maps, x_label="answered", y_label="label", size=(9.0, 3.2))


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
        axes.set_xticks(sorted({x for curve in curves.values() for x in curve}))
        axes.set(xlabel="objects learned from", ylabel="%", ylim=(0, 100), xlim=(0, None))
        figure.legend(loc="outside right upper")
        return svg(figure)


def _words(attribute: int) -> tuple[tuple[str, ...], ...]:
    return LANGUAGE.attributes[attribute].levels
