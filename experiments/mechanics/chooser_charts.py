"""The chart of the chooser: what was asked for against what was achieved."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, svg

Points = tuple[float, np.ndarray, np.ndarray, np.ndarray]
"""Error asked for; of every scene the error achieved, the grid chosen, whether it was promised to be met."""

_SPREAD = 0.18  # half width of a cloud, in ln(asked)


def asked_against_achieved(trials: Sequence[Points], slack: float) -> bytes:
    """Achieved over asked, logarithmic; the dots of one error asked for lie side by side in the order of the scenes."""
    sides = sorted({int(g) for _, _, grids, _ in trials for g in grids})
    colours = mpl.colormaps["viridis"].resampled(max(len(sides), 2))
    scale = ScalarMappable(BoundaryNorm(np.arange(len(sides) + 1) - 0.5, colours.N), colours)
    asked = np.array([t[0] for t in trials])
    ends = np.array([asked.min() / 1.4, asked.max() * 1.4])
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.4, 4.8), layout="constrained")
        axes = figure.subplots()
        for trial in trials:
            _draw_cloud(axes, trial, scale, sides, slack)
        axes.plot(ends, ends, "k-", lw=0.8)
        axes.plot(ends, slack * ends, "k:", lw=1)
        axes.set(xscale="log", yscale="log", xlabel="error asked for", ylabel="error achieved", xlim=ends)
        axes.set_xticks(asked, [f"{a:.0%}" for a in asked])
        axes.minorticks_off()
        bar = figure.colorbar(scale, ax=axes, label="grid chosen", ticks=range(len(sides)))
        bar.ax.set_yticklabels([f"{n}²" for n in sides])
        return svg(figure)


def _draw_cloud(axes: Axes, trial: Points, scale: ScalarMappable, sides: Sequence[int], slack: float) -> None:
    asked, error, grids, met = trial
    x = asked * np.exp(np.linspace(-_SPREAD, _SPREAD, len(error)))
    colour = scale.to_rgba(np.searchsorted(sides, grids))
    axes.scatter(x[met], error[met], s=9, color=colour[met], linewidths=0, alpha=0.8)
    axes.scatter(
        x[~met], error[~met], s=12, facecolors="none", edgecolors=[tuple(c) for c in colour[~met]], linewidths=0.7
    )
    if met.any():
        kept = f"{np.mean(error[met] <= slack * asked):.1%} kept"
        axes.annotate(kept, (asked, slack * asked), (0, 16), ha="center", textcoords="offset points", fontsize=8)
