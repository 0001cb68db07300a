"""The look that every chart shares: colours, settings of matplotlib, files whose bytes depend on the data alone."""

import io
import itertools
from collections.abc import Iterable
from typing import Any

from matplotlib.figure import Figure

PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#332288", "#882255", "#999933", "#44aa99"),
)
"""Okabe and Ito's six colours (Wong, Nature Methods 2011), four of Tol's; colour-blind readers can tell them apart."""

SHARED = "#4d5560"
"""Colour of whatever belongs to no single series."""

CONTROLS = {"sft": "#1d2126", "sft_continued": "#8c564b", "tactile_blind": SHARED}
"""Colours of the policies that every study trains beside its arms; in curves they have stages of their own."""

MARKERS = "osD^vXph"

LOOK: dict[Any, Any] = {
    "svg.hashsalt": "touchr1-jax",  # the same data give the same file
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a929c",
    "axes.grid": True,
    "grid.color": "#eceff2",
    "axes.axisbelow": True,
    "legend.frameon": False,
}
"""Settings of every chart, for `matplotlib.rc_context`."""


def colours(names: Iterable[str]) -> dict[str, str]:
    """The colour of every name: that of a control, or the next of the palette, so that charts and tables agree."""
    free = itertools.cycle(PALETTE)
    return {name: CONTROLS.get(name) or next(free) for name in names}


def svg(figure: Figure) -> bytes:
    """The figure as SVG; the same figure gives the same bytes, made within `LOOK`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """The figure as PNG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
