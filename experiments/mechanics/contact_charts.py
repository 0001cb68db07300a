"""Maps of where a contact method breaks."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, svg


def failure_maps(
    maps: Mapping[str, np.ndarray],
    flagged: Mapping[str, np.ndarray],
    rows: tuple[str, Sequence[float]],
    columns: tuple[str, Sequence[float]],
    tolerance: float,
) -> bytes:
    """Error over two parameters, one panel a method, a cross where the method itself says that it must not be used.

    Args:
      maps: method → error [rows, columns].
      flagged: method → bool [rows, columns].
      rows, columns: label and values of either axis.
      tolerance: the error at which the colours turn.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(2.6 * len(maps) + 0.9, 3.1), layout="constrained")
        panels = figure.subplots(1, len(maps), squeeze=False)[0]
        scale = ScalarMappable(LogNorm(tolerance * 1e-2, 1.0), "cividis")
        for axes, (name, error) in zip(panels, maps.items(), strict=True):
            shown = np.maximum(error, tolerance * 1e-2)
            axes.imshow(shown, norm=scale.norm, cmap=scale.cmap, origin="lower", aspect="auto")
            y, x = np.nonzero(flagged[name])
            axes.plot(x, y, "x", color="white", ms=5)
            axes.grid(False)
            axes.set_title(name, fontsize=9)
            axes.set_xticks(range(len(columns[1])), [f"{v:g}" for v in columns[1]], fontsize=7)
            axes.set_yticks(range(len(rows[1])), [f"{v:g}" for v in rows[1]], fontsize=7)
            axes.set_xlabel(columns[0])
        panels[0].set_ylabel(rows[0])
        figure.colorbar(scale, ax=panels, label="error of displacement").ax.axhline(2 * tolerance, color="white", lw=1)
        return svg(figure)
