"""Charts of the paper's own numbers."""

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.bench.paper_arithmetic import columns_as_scores, error_and_distance, impossible_distances
from experiments.core.charts import LOOK, PALETTE, SHARED, svg
from experiments.study import paper_numbers as paper


def distance_against_error() -> bytes:
    """OMAE over the error rate of the same row; below the diagonal no answers can lie."""
    rows, impossible = error_and_distance(), set(impossible_distances())
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.4, 4.4), layout="constrained")
        axes = figure.add_subplot()
        ends = np.array([0.25, 0.75])
        axes.fill_between(ends, 0, ends, color=PALETTE[1], alpha=0.08, lw=0)
        axes.plot(ends, ends, color=SHARED, lw=1, ls=":")
        axes.text(0.735, 0.5, "impossible: OMAE < 1 − Acc", ha="right", va="top", fontsize=8, color=PALETTE[1])
        for name, (error, omae) in rows.items():
            wrong, ablation = name in impossible, name.endswith("(ablation)")
            colour = PALETTE[1] if wrong else PALETTE[0]
            axes.scatter(error, omae, s=34, color=colour, marker="D" if ablation else "o", zorder=3)
            if wrong and not name.startswith("+"):
                axes.annotate(name, (error, omae), (8, -3), textcoords="offset points", fontsize=8, color=colour)
        for label, marker in (("main table", "o"), ("ablation", "D")):
            axes.scatter([], [], s=34, color=SHARED, marker=marker, label=label)
        axes.set(xlabel="1 − mean of H-, R-, P-Acc", ylabel="OMAE, levels", xlim=ends, ylim=(0.15, 0.95))
        axes.legend(loc="upper left", fontsize=8)
        return svg(figure)


def average_against_mean() -> bytes:
    """Printed Avg beside the plain mean of the nine columns, for every model."""
    low, high, average = columns_as_scores()
    mean, names = ((low + high) / 2).mean(1), list(paper.MAIN)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.4, 3.6), layout="constrained")
        axes = figure.add_subplot()
        y = np.arange(len(names))
        axes.hlines(y, average, mean, color="#cfd4da", lw=2)
        axes.scatter(average, y, s=34, color=PALETTE[1], label="Avg as printed", zorder=3)
        axes.scatter(mean, y, s=34, color=PALETTE[0], label="mean of the nine columns", zorder=3)
        axes.set(yticks=y, yticklabels=names, xlabel="points", ylim=(len(names) - 0.5, -0.5))
        axes.legend(loc="lower left", fontsize=8)
        return svg(figure)
