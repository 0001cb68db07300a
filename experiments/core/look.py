"""The look that every chart shares: colours, settings of matplotlib, files whose bytes depend on the data alone.

Modules that every start imports import matplotlib where they draw, for it takes a second.
"""

import io
import itertools
import math
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

PALETTE = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#332288", "#882255", "#999933", "#44aa99"),
)
"""Okabe and Ito's six colours (Wong, Nature Methods 2011), four of Tol's; colour-blind readers can tell them apart."""

SHARED = "#4d5560"
"""Colour of whatever belongs to no single series."""

CONTROLS = {"sft": "#1d2126", "sft_continued": "#8c564b", "tactile_blind": SHARED}
"""Colours of the policies that every study trains in addition to its arms; in curves they have stages of their own."""

MARKERS = "osD^vXph"
SYMBOLS = "●■◆▲▼✖⬟⬢"  # the markers in a text

LINES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (6, 2, 1, 2, 1, 2)))

LONG_AXIS = 300.0  # ends of a logarithmic axis, one over the other, beyond which its ticks are powers of ten alone
LETTERS = 13  # an inch, of a tick or a legend
GAP = 3  # letters from one tick to the next; the layout, which is not known yet, leaves axes narrower
NICE = [1, 2, 2.5, 5, 10]  # steps of ticks, as matplotlib's own

_PATH, _LONG = re.compile(rb' d="[^"]*"'), re.compile(rb"(\.\d\d)\d+")
"""Coordinates of lines, and their digits beyond a hundredth of a point, which nobody sees and which weigh a fourth."""

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


class Mark(NamedTuple):
    """Look of a name in charts and tables: colour, matplotlib's marker and line, and the marker as a letter."""

    colour: str
    marker: str = MARKERS[0]
    line: Any = LINES[0]
    symbol: str = SYMBOLS[0]


def marks(names: Iterable[str]) -> dict[str, Mark]:
    """The mark of every name; when the colours are used up they return with other markers and lines."""
    names = tuple(names)
    turn = {name: i // len(PALETTE) for i, name in enumerate(name for name in names if name not in CONTROLS)}
    look = lambda i: (MARKERS[i % len(MARKERS)], LINES[i % len(LINES)], SYMBOLS[i % len(SYMBOLS)])
    return {name: Mark(colour, *look(turn.get(name, 0))) for name, colour in colours(names).items()}


def set_ticks(
    axis: "Axis", scale: str, ticks: Mapping[float, str] | None, form: str = "", *, whole: bool = False
) -> None:
    """The ticks given, else matplotlib's, of which `whole` keeps whole numbers; formatted by `form`.

    On a short logarithmic axis 2 and 5 times powers of ten have ticks too, if they fit.
    """
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator, StrMethodFormatter

    if ticks is not None:
        axis.set_ticks(list(ticks), list(ticks.values()))
        axis.set_minor_locator(NullLocator())
        return
    low, high = axis.get_view_interval()
    room = LETTERS * axis.axes.bbox.width / axis.axes.figure.dpi if axis is axis.axes.xaxis else math.inf
    if scale == "log":
        fine = LogLocator(subs=(1.0, 2.0, 5.0))
        letters = sum(len(f"{tick:g}") for tick in fine.tick_values(low, high) if low <= tick <= high)
        axis.set_major_locator(fine if high < LONG_AXIS * low and letters <= room else LogLocator(subs=(1.0,)))
        axis.set_minor_formatter(NullFormatter())
    elif scale == "linear":
        counts: Iterable[Any] = ("auto",) if room == math.inf else range(min(axis.get_tick_space(), 9), 1, -1)
        for most in counts:
            axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10] if whole else NICE, integer=whole))
            shown = [tick for tick in axis.get_majorticklocs() if low <= tick <= high]
            if sum(GAP + len(text) for text in axis.get_major_formatter().format_ticks(shown)) <= room:
                break
    if form or scale != "linear":
        axis.set_major_formatter(StrMethodFormatter(form or "{x:g}"))


def svg(figure: "Figure") -> bytes:
    """The figure as SVG; the same figure gives the same bytes, made within `LOOK`."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return _PATH.sub(lambda path: _LONG.sub(rb"\1", path[0]), buffer.getvalue())


def png(figure: "Figure") -> bytes:
    """The figure as PNG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
