"""Cores that feeds need, as bars."""

from collections.abc import Mapping

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.reporting.charts import LOOK, PALETTE, svg


def cores_needed(cores: Mapping[str, float], there: int) -> bytes:
    """Cores by feed on a logarithmic axis, and a line at those that a device has."""
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.2, 0.9 + 0.34 * len(cores)), layout="constrained")
        axes = figure.subplots()
        axes.barh(list(cores), list(cores.values()), color=PALETTE[0], height=0.6)
        for y, value in enumerate(cores.values()):
            axes.annotate(f"{value:.2g}", (value, y), (3, 0), textcoords="offset points", va="center", fontsize=8)
        axes.axvline(there, color=PALETTE[1], linewidth=1)
        axes.set(xlabel="cores", xscale="log", xlim=(min(*cores.values(), 1) / 2, 2 * max(*cores.values(), there)))
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        return svg(figure)
