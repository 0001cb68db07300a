"""Matrices in colours as SVG, and grids of pictures as PNG."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.look import LOOK, png, svg


@dataclasses.dataclass(frozen=True)
class Heatmap:
    """A matrix in colours."""

    values: np.ndarray  # [R, C]
    _: dataclasses.KW_ONLY
    rows: Sequence[str]  # their names
    columns: Sequence[str]
    title: str = ""  # above it
    cells: Sequence[Sequence[str]] = ()  # what is written in each cell [R, C]; nothing by default
    crosses: np.ndarray | None = None  # bool [R, C], cells to cross out; none by default


def heatmaps(
    maps: Sequence[Heatmap],
    *,
    x_label: str = "",
    y_label: str = "",
    columns: int = 3,
    limits: tuple[float, float] = (0.0, 1.0),
    logarithmic: bool = False,
    colour_map: str = "Blues",
    colour_bar: str = "",
    mark: float | None = None,
    size: tuple[float, float] | None = None,
) -> bytes:
    """Draw matrices side by side on one scale of colours, as SVG.

    Args:
      maps: one at least, with common labels of their axes.
      columns: of matrices, at most.
      limits: values of the first and the last colour; values outside take these.
      logarithmic: whether equal ratios are equal steps of colour.
      colour_map, size: matplotlib's colour map, inches.
      colour_bar, mark: label of a bar that explains the colours, and a value to mark on it; no bar by default.
    """
    import matplotlib as mpl
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure

    columns = min(columns, len(maps))
    lines = math.ceil(len(maps) / columns)
    scale = ScalarMappable((LogNorm if logarithmic else Normalize)(*limits), colour_map)
    with mpl.rc_context(LOOK | {"axes.grid": False}):
        figure = Figure(figsize=size or (2.75 * columns + 0.4, 2.4 * lines + 0.3), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False).ravel()
        for i, (axes, one) in enumerate(zip(grid, maps, strict=False)):
            shown = np.clip(one.values, *limits)
            axes.imshow(shown, norm=scale.norm, cmap=scale.cmap, aspect="auto")
            for row, column in np.ndindex(np.shape(one.cells)[:2]):
                dark = float(np.mean(scale.to_rgba(shown[row, column])[:3])) < 0.5
                colour = "white" if dark else "black"
                axes.text(column, row, one.cells[row][column], ha="center", va="center", fontsize=7.5, color=colour)
            if one.crosses is not None:
                y, x = np.nonzero(one.crosses)
                axes.plot(x, y, "x", color="white", ms=5)
            axes.set_title(one.title, fontsize=9, loc="left")
            axes.set_xticks(range(len(one.columns)), one.columns, fontsize=7)
            axes.set_yticks(range(len(one.rows)), one.rows, fontsize=7)
            axes.set_xlabel(x_label)
            axes.set_ylabel(y_label if i % columns == 0 else "")
        for axes in grid[len(maps) :]:
            axes.set_visible(False)
        if colour_bar:
            bar = figure.colorbar(scale, ax=list(grid), label=colour_bar)
            if mark is not None:
                bar.ax.axhline(mark, color="white", lw=1)
        return svg(figure)


def image_grid(
    rows: Mapping[str, Sequence[np.ndarray] | np.ndarray], columns: Sequence[str] = (), *, cell_inch: float = 1.25
) -> bytes:
    """Draw a grid of pictures, the names of rows to the left and those of columns above, as PNG.

    Args:
      rows: name → pictures [H, W, 3], RGB, uint8 or float in [0, 1]; a shorter row leaves cells empty.
      columns: a name per column, or none.
      cell_inch: side of a picture.
    """
    from matplotlib.figure import Figure

    count = max(len(row) for row in rows.values())
    label, heading, side = 1.05, 0.25 if columns else 0.0, 0.97 * cell_inch  # the side leaves a thin gap
    width, height = label + count * cell_inch, heading + len(rows) * cell_inch
    figure = Figure(figsize=(width, height), dpi=150)
    for r, (name, pictures) in enumerate(rows.items()):
        top = height - heading - r * cell_inch
        figure.text((label - 0.08) / width, (top - cell_inch / 2) / height, name, ha="right", va="center", fontsize=8)
        for c, picture in enumerate(pictures):
            left = label + c * cell_inch
            axes = figure.add_axes((left / width, (top - side) / height, side / width, side / height))
            axes.imshow(picture, interpolation="nearest")
            axes.set_axis_off()
    for c, name in enumerate(columns):
        centre = label + (c + 0.5) * cell_inch
        figure.text(centre / width, (height - heading / 2) / height, name, ha="center", va="center", fontsize=8)
    return png(figure)
