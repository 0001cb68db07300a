"""Charts of the data card."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.bench.card import AnswerShare
from experiments.core.charts import LOOK, PALETTE, SHARED, svg


def answer_shares(rows: Sequence[AnswerShare]) -> bytes:
    """Share of every answer of every kind and attribute, beside the share that equal ones would have."""
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.4, 0.7 + 0.24 * len(rows)), layout="constrained")
        axes = figure.add_subplot()
        for y, row in enumerate(rows):
            left = 0.0
            for k, count in enumerate(row.counts):
                width = 100 * count / row.questions
                axes.barh(y, width, left=left, color=PALETTE[k % len(PALETTE)], alpha=0.75, height=0.72, lw=0)
                left += width
            ends = np.arange(1, len(row.counts)) * 100 / len(row.counts)
            axes.vlines(ends, y - 0.45, y + 0.45, color=SHARED, lw=0.9)
        axes.set(
            yticks=range(len(rows)),
            yticklabels=[f"{row.kind}, {row.attribute}" for row in rows],
            xlabel="share of the answers, %; lines: equal shares",
            xlim=(0, 100),
            ylim=(len(rows) - 0.4, -0.6),
        )
        axes.grid(visible=False)
        return svg(figure)
