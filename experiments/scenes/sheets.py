"""Sheets of pictures as PNG: rows of named pictures, the same look in every experiment about scenes."""

import io
from collections.abc import Mapping, Sequence

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from experiments.core.charts import LOOK, SHARED, svg

CELL_INCH = 1.25
DPI = 150
ARROW = 4.0
"""Length of an arrow over the displacement that it shows."""


def picture_rows(
    rows: Mapping[str, Sequence[np.ndarray] | np.ndarray], columns: Sequence[str] = (), cell_inch: float = CELL_INCH
) -> bytes:
    """A grid of pictures with the names of rows to the left and those of columns above.

    Args:
      rows: name → pictures, uint8 RGB [H, W, 3] each; a shorter row leaves cells empty.
      columns: a name per column, or none.
      cell_inch: side of a picture.
    """
    count = max(len(row) for row in rows.values())
    label, heading = 1.05, 0.25 if columns else 0.0
    width, height = label + count * cell_inch, heading + len(rows) * cell_inch
    figure = Figure(figsize=(width, height), dpi=DPI)
    side = 0.97 * cell_inch  # leaves a thin gap
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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """A height map in colour, uint8 RGB, from its least to its greatest value."""
    scaled = (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    return _coloured(scaled)


def field_picture(depth_mm: np.ndarray, displacement_mm: np.ndarray, top_mm: float, px: int = 160) -> np.ndarray:
    """Depth in colour and displacement as arrows four times their length, uint8 RGB [px, px, 3].

    Args:
      depth_mm: [h, w], black at 0 and brightest at `top_mm`.
      displacement_mm: [h, w, 2], in units of a node of 1 mm.
      top_mm: brightest depth.
      px: side of the picture.
    """
    field = cv2.resize(np.clip(depth_mm / max(top_mm, 1e-9), 0, 1), (px, px), interpolation=cv2.INTER_CUBIC)
    picture = _coloured(np.clip(field, 0, 1))
    cell = px / depth_mm.shape[0]
    for row, column in np.ndindex(*depth_mm.shape):
        start = (np.array([column, row]) + 0.5) * cell
        end = start + ARROW * cell * displacement_mm[row, column]
        begin, tip = ((int(p[0]), int(p[1])) for p in (start, end))
        cv2.line(picture, begin, tip, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def strips(panels: Mapping[str, tuple[Mapping[str, tuple[float, ...]], tuple[float, float]]], colour: str) -> bytes:
    """One panel per quantity on a logarithmic axis: a range with its middle per row, lines at thresholds; SVG.

    Args:
      panels: title → (row → low, middle, high; thresholds).
      colour: of the ranges.
    """
    with mpl.rc_context(LOOK | {"font.size": 8, "axes.grid.axis": "x"}):
        figure = Figure(figsize=(2.2 * len(panels), 2.6), layout="constrained")
        for k, (title, (spans, thresholds)) in enumerate(panels.items()):
            axes = figure.add_subplot(1, len(panels), k + 1)
            rows = np.arange(len(spans))
            low, middle, high = np.array(list(spans.values())).T
            axes.hlines(rows, low, high, color=colour, lw=3, alpha=0.35)
            axes.scatter(middle, rows, color=colour, s=14, zorder=3)
            axes.vlines(thresholds, -0.6, len(spans) - 0.4, color=SHARED, lw=0.8, ls="--")
            axes.set(xscale="log", title=title, ylim=(len(spans) - 0.4, -0.6))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.set_yticks(rows, list(spans) if k == 0 else [""] * len(spans))
        return svg(figure)


def _coloured(scaled: np.ndarray) -> np.ndarray:
    """Values 0..1 in the colours of `magma`, uint8 RGB."""
    picture: np.ndarray = (255 * mpl.colormaps["magma"](scaled)[..., :3]).astype(np.uint8)
    return picture
