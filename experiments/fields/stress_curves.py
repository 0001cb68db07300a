"""Curves of where tracking and shear break."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.core.charts import LOOK, PALETTE, SHARED, svg

_COLUMNS = 4
_INCHES = (2.75, 2.45)  # of a panel
_DECADES = (0.01, 100.0)  # of the error, over the tolerance: what lies beyond is drawn at the edge


@dataclasses.dataclass(frozen=True, kw_only=True)
class StressCurve:
    """One method under one stress, level by level.

    Args:
      error: the worst of the frames [L], infinite where the method gives nothing.
      flagged: bool [L], whether every frame is flagged.
      broken: bool [L], whether any frame is broken.
      silent: bool [L], whether any broken frame carries no flag.
    """

    error: np.ndarray
    flagged: np.ndarray
    broken: np.ndarray
    silent: np.ndarray


def break_curves(
    curves: Mapping[str, Sequence[StressCurve]],
    stresses: Sequence[tuple[str, Sequence[float]]],
    tolerance: float,
    unit: str,
) -> bytes:
    """Error of every method under every stress, one panel a stress; where each breaks, and whether it says so.

    Args:
      curves: method → its curve under each stress; the first is drawn above the others.
      stresses: name and levels of each.
      tolerance: the error from which a point is wrong.
      unit: of the errors.
    """
    columns = min(_COLUMNS, len(stresses))
    rows = -(-len(stresses) // columns)
    colours = dict(zip(curves, itertools.cycle((*PALETTE, SHARED)), strict=False))
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(columns * _INCHES[0] + 0.6, rows * _INCHES[1] + 0.8), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for i, (axes, (name, levels)) in enumerate(zip(panels.ravel(), stresses, strict=False)):
            for z, method in enumerate(reversed(tuple(curves))):
                _draw(axes, curves[method][i], colours[method], tolerance, 2.4 if z == len(curves) - 1 else 1.1, 3 + z)
            axes.axhline(tolerance, color="black", lw=0.8, ls=":")
            axes.set_title(name, fontsize=9, loc="left")
            axes.set_xticks(range(len(levels)), [f"{level:.3g}" for level in levels], fontsize=7.5)
            axes.set(yscale="log", ylim=(_DECADES[0] * tolerance, 1.3 * _DECADES[1] * tolerance))
        for axes in panels[:, 0]:
            axes.set_ylabel(f"error, {unit}")
        for axes in panels.ravel()[len(stresses) :]:
            axes.set_visible(False)
        figure.legend(handles=_legend(colours), loc="outside lower center", ncols=5, fontsize=8)
        return svg(figure)


def _draw(axes: Axes, curve: StressCurve, colour: str, tolerance: float, width: float, above: int) -> None:
    low, high = (d * tolerance for d in _DECADES)
    error = np.clip(curve.error, low, high)
    x = np.arange(len(error))
    axes.plot(x, error, color=colour, lw=width, zorder=above)
    axes.plot(x[curve.flagged], error[curve.flagged], "o", ms=5, mfc="white", mec=colour, zorder=above)
    if curve.broken.any():
        first = int(curve.broken.argmax())
        mark = "X" if curve.silent[first] else "s"
        face = colour if curve.silent[first] else "white"
        axes.plot(first, error[first], mark, ms=8, mfc=face, mec=colour if face == "white" else "white", zorder=above)


def _legend(colours: Mapping[str, str]) -> list[Line2D]:
    lines = [Line2D([], [], color=c, lw=2, label=name) for name, c in colours.items()]
    mark = lambda shape, face, label: Line2D([], [], ls="", marker=shape, ms=7, mfc=face, mec=SHARED, label=label)
    return [
        *lines,
        mark("X", SHARED, "breaks here, without a flag"),
        mark("s", "white", "breaks here, and says so"),
        mark("o", "white", "flagged in every frame"),
    ]
