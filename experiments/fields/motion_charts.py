"""Maps of where tracking and shear break."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from experiments.reporting.charts import LOOK, svg

_COLUMNS = 3
_INCHES = (3.5, 2.5)  # of a panel


def break_maps(
    maps: Mapping[str, np.ndarray],
    flagged: Mapping[str, np.ndarray],
    stresses: Sequence[tuple[str, Sequence[float]]],
    tolerance: float,
    unit: str,
) -> bytes:
    """Error of every method under every stress; a cross where the method itself refuses the frame.

    Args:
      maps: method → error [stresses, levels], NaN where a stress has no such level.
      flagged: method → bool, the same shape.
      stresses: name and levels of each.
      tolerance: the error at which a method counts as broken, the middle of the colours.
      unit: of the errors.
    """
    rows = -(-len(maps) // _COLUMNS)
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(_COLUMNS * _INCHES[0] + 1.2, rows * _INCHES[1] + 0.3), layout="constrained")
        panels = figure.subplots(rows, _COLUMNS, squeeze=False, sharey=True)
        scale = ScalarMappable(LogNorm(tolerance * 0.02, tolerance * 50), "coolwarm")
        for axes, name in zip(panels.ravel(), maps, strict=False):
            _draw(axes, maps[name], flagged[name], stresses, scale)
            axes.set_title(name, fontsize=9)
        for axes in panels.ravel()[len(maps) :]:
            axes.set_visible(False)
        figure.colorbar(scale, ax=panels, label=f"error, {unit}; white: {tolerance:g}", shrink=0.7)
        return svg(figure)


def _draw(
    axes: Axes,
    error: np.ndarray,
    flagged: np.ndarray,
    stresses: Sequence[tuple[str, Sequence[float]]],
    scale: ScalarMappable,
) -> None:
    low, high = scale.get_clim()
    axes.imshow(np.clip(error, low, high), norm=LogNorm(low, high), cmap=scale.cmap, aspect="auto")
    y, x = np.nonzero(flagged)
    axes.plot(x, y, "x", color="black", ms=6)
    for row, (_, levels) in enumerate(stresses):
        for column, level in enumerate(levels):
            axes.text(column, row + 0.38, f"{level:.2g}", ha="center", va="center", fontsize=5.5)
    axes.grid(False)
    axes.set_xticks([])
    axes.set_yticks(range(len(stresses)), [name for name, _ in stresses], fontsize=7)
