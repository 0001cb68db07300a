"""Charts as SVG in one style; a caller describes the data and never uses matplotlib.

A chart is a sequence of `Panel`s, a panel a sequence of `Series`:

    draw([
        Panel(
            [Series("ours", x=ms, y=error, high=p95, labels=names), Series("published", x=ms_2, y=error_2)],
            x_label="time a frame, ms", y_label="error", x_scale="log", y_scale="log", rules=[Rule(y=0.05)],
        )
    ])

Series of one name have one colour, one marker and one entry in the legend in all panels; unnamed ones have no entry.
`estimates` makes a series from `statistics.Interval` or `results.Estimate`; `bars` and `speed_against_error` are charts
that many experiments share.  `experiments.core.pictures` draws matrices and grids of pictures.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from experiments.core.look import LETTERS, LOOK, MARKERS, PALETTE, SHARED, colours, set_ticks, svg
from experiments.core.text import WithInterval, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

PLACING: dict[str, Any] = {"expand": (1.15, 1.5), "iter_lim": 200}  # seconds would make a picture depend on the machine
STROKES, STROKE = ("|", "_", "x", "+"), 1.5  # markers without an area, width of their lines in points
BEHIND = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}  # text, legible on lines that it crosses
ROOM = 0.12  # for the figure at the end of the longest bar, over the length of the axis

Values = Sequence[float] | np.ndarray  # numbers [N]

Scale = Literal["linear", "log", "symlog"]
Better = Literal["lower", "higher"]

BEATEN = "×: dominated by another"
"""Title of a panel with crosses on points, where another one is as good on both axes and better on one."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rule:
    """A bound: a vertical line at `x`, a level line at `y`; with both, the corner that must be kept."""

    x: float | None = None  # in data coordinates, as y
    y: float | None = None
    name: str = ""  # in the legend; none by default
    line: str = ":"
    colour: str = "black"
    width: float = 1.0  # of the line, points
    keep: Literal["below", "above"] = "below"  # with x and y, the side of the level line that is inside


@dataclasses.dataclass(frozen=True)
class Series:
    """Points of a panel; a number that is missing is NaN."""

    name: str = ""  # in the legend; none by default
    _: dataclasses.KW_ONLY
    x: Values  # positions [N]; in a panel of rows, `y` defaults to the rows from the top
    y: Values = ()
    low: Values = ()  # ends of the interval of each y, in a panel of rows of each x; one alone reaches from the point
    high: Values = ()
    band: bool = False  # whether the intervals are one filled band
    bar: bool = False
    """In a panel of rows, bars from 0 to `x`; several series are side by side, on a `stacked` panel end to end."""
    line: Any = "-"  # matplotlib's style; "" for points alone, which panels of rows always have
    marker: str | None = None  # matplotlib's; `None` for the name's own, "" for none
    colour: Any = None  # one, or one per point; `None` for the name's own
    size: float | Values = 28.0  # area of a marker in points², one or one per point
    hollow: bool = False  # whether markers are outlines
    width: float = 1.5  # of the line, points
    alpha: float = 1.0
    shift: float = 0.0  # of all points across their rows, or along x, so that intervals do not cover each other
    labels: Sequence[str] = ()  # a name to write at each point


def estimates(name: str, found: Sequence[WithInterval], *, at: Values = (), **look: Any) -> Series:
    """A series of estimates with their intervals, over the positions `at`; without them in a panel of rows."""
    mean, low, high = np.array([(one.mean, one.low, one.high) for one in found]).reshape(-1, 3).T
    x, y = (at, mean) if len(at) else (mean, ())
    return Series(name, x=x, y=y, low=low, high=high, **look)


@dataclasses.dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    series: Sequence[Series]  # drawn in order
    _: dataclasses.KW_ONLY
    title: str = ""  # above the panel
    x_label: str = ""  # with units
    y_label: str = ""
    x_scale: Scale = "linear"  # "symlog" is linear up to `linear_to`, logarithmic beyond
    y_scale: Scale = "linear"
    x_limits: tuple[float | None, float | None] = (None, None)
    y_limits: tuple[float | None, float | None] = (None, None)
    """Ends of the axes; an end that is `None` follows the data."""
    x_ticks: Mapping[float, str] | None = None  # position → text; by default matplotlib's choice
    y_ticks: Mapping[float, str] | None = None
    y_format: str = ""  # of its ticks, such as "{x:.0%}"
    rules: Sequence[Rule] = ()
    rows: Sequence[str] = ()  # names of rows from the top, in place of a y axis
    stacked: bool = False  # whether bars of several series are put end to end
    written: str = ""  # format of the figure at the end of each bar, such as ".2g"; none by default
    linear_to: float = 1.0  # see `x_scale`
    better: tuple[Better, Better] | None = None
    """Which x and which y are better; points with markers that another one dominates are crossed."""


ROWS, ROW_IN = 3, 0.18
"""Rows of a legend for which figures have room, and the height of each further one, inches."""


def draw(
    panels: Sequence[Panel],
    *,
    columns: int = 3,
    size: tuple[float, float] | None = None,
    share_x: bool = False,
    share_y: bool = False,
    legend: bool = True,
) -> bytes:
    """Draw the panels in rows of `columns`, with one legend of the named series and rules above them, as SVG.

    The `size` is in inches and by default grows with panels and rows; a long legend adds to its height.  All panels may
    share an axis.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    columns = min(columns, len(panels))
    lines = math.ceil(len(panels) / columns)
    panels = _resolved([_crossed(panel) if panel.better else panel for panel in panels])
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=size or _size(panels, columns, lines), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False, sharex=share_x, sharey=share_y).ravel()
        for axes, panel in zip(grid, panels, strict=False):
            _draw_panel(axes, panel)
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        entries = _entries(panels) if legend else {}
        if entries:
            wide = max(1, int(figure.get_figwidth() * LETTERS) // (max(map(len, entries)) + 6))
            more = math.ceil(len(entries) / wide) - ROWS
            figure.set_figheight(figure.get_figheight() + ROW_IN * max(0, more))
            figure.legend(list(entries.values()), list(entries), loc="outside upper left", ncols=wide)
        if any(series.labels for panel in panels for series in panel.series):
            figure.draw_without_rendering()  # settles the layout, which ignores labels
            figure.set_layout_engine("none")
            for axes, panel in zip(grid, panels, strict=False):
                _write_labels(axes, panel)
        return svg(figure)


def bars(
    values: Mapping[str, float],
    label: str,
    *,
    written: str = ".2g",
    bounds: Sequence[float] = (),
    logarithmic: bool = False,
) -> bytes:
    """Draw one bar for each name, its figure written at its end in the format `written`; bounds are dotted lines."""
    figures = (*values.values(), *bounds)
    panel = Panel(
        [Series(x=list(values.values()), bar=True)],
        rows=list(values),
        x_label=label,
        x_scale="log" if logarithmic else "linear",
        x_limits=(min(figures) / 2, 2 * max(figures)) if logarithmic else (0.0, None),
        rules=[Rule(x=bound) for bound in bounds],
        written=written,
    )
    return draw([panel])


Point = tuple[str, float, float, float]  # name, ms a frame, median error, 95th percentile of the error


def speed_against_error(
    groups: Mapping[str, Sequence[Point]], error: str, goal: tuple[float, float] | None, *, legend: bool = True
) -> bytes:
    """Draw error over time a frame, logarithmic; each point's bar reaches from the median to the 95th percentile.

    Points of a kind are joined in the order given; a goal of time and error is drawn as a corner.  Crosses mark points
    that another one dominates.
    """
    series = []
    for kind, points in groups.items():
        names, ms, median, high = zip(*points, strict=True)
        series.append(Series(kind, x=ms, y=median, high=high, labels=names))
    rules = [] if goal is None else [Rule(x=goal[0], y=goal[1])]
    axes: dict[str, Any] = {"x_scale": "log", "y_scale": "log", "x_label": "time a frame, ms", "y_label": error}
    return draw([Panel(series, **axes, rules=rules, better=("lower", "lower"))], size=(7.4, 4.6), legend=legend)


def dominated(costs: Sequence[Sequence[float] | np.ndarray]) -> list[bool]:
    """For each choice, whether another one costs no more in any respect and less in one; NaN dominates nothing."""
    every = np.asarray(costs, float)
    return [bool(((every <= one).all(-1) & (every < one).any(-1)).any()) for one in every]


def _crossed(panel: Panel) -> Panel:
    """The panel with a cross on each dominated point."""
    points = [point for s in panel.series if s.marker != "" for point in zip(s.x, s.y, strict=True)]
    costs = [[x if better == "lower" else -x for x, better in zip(p, panel.better or (), strict=True)] for p in points]
    at = np.array([point for point, mark in zip(points, dominated(costs), strict=True) if mark]).reshape(-1, 2)
    cross = Series(x=at[:, 0], y=at[:, 1], line="", marker="x", colour="0.35", size=70.0)
    title = "\n".join(filter(None, (panel.title, BEATEN)))
    return dataclasses.replace(panel, series=[*panel.series, cross], title=title) if len(at) else panel


def _resolved(panels: Sequence[Panel]) -> list[Panel]:
    """Panels whose series state colour, marker and positions."""
    every = [series for panel in panels for series in panel.series if series.name]
    colour = colours(dict.fromkeys(s.name for s in every if s.colour is None)) | {"": PALETTE[0]}
    marker = dict(zip(dict.fromkeys(s.name for s in every), itertools.cycle(MARKERS), strict=False)) | {"": MARKERS[0]}

    def resolve(panel: Panel, s: Series) -> Series:
        y = np.asarray(s.y if len(s.y) else np.arange(len(panel.rows)), float)
        return dataclasses.replace(
            s,
            x=np.asarray(s.x, float) + (0 if panel.rows else s.shift),
            y=y + (s.shift if panel.rows else 0),
            colour=colour[s.name] if s.colour is None else s.colour,
            marker=marker[s.name] if s.marker is None else s.marker,
        )

    return [dataclasses.replace(panel, series=[resolve(panel, s) for s in panel.series]) for panel in panels]


def _size(panels: Sequence[Panel], columns: int, lines: int) -> tuple[float, float]:
    rows = max(len(panel.rows) for panel in panels)
    if len(panels) == 1:
        return (7.4, 0.9 + 0.34 * rows if rows else 4.2)
    return (3.3 * columns + (0.6 if rows else 0.2), 0.5 + lines * (0.6 + 0.34 * rows if rows else 2.5))


def _draw_panel(axes: "Axes", panel: Panel) -> None:
    axes.set_title(panel.title, fontsize=9.5, loc="left")
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    for set_scale, scale in ((axes.set_xscale, panel.x_scale), (axes.set_yscale, panel.y_scale)):
        set_scale(scale, **({"linthresh": panel.linear_to} if scale == "symlog" else {}))
    _draw_bars(axes, panel)
    for series in panel.series:
        if not series.bar:
            _draw_points(axes, panel, series)
    if panel.rows:
        axes.set_yticks(range(len(panel.rows)), panel.rows)
        axes.set_ylim(len(panel.rows) - 0.4, -0.6)
        axes.grid(axis="y", visible=False)
    for rule in panel.rules:
        _draw_rule(axes, rule)
    if panel.x_limits != (None, None):  # else it would end the autoscaling of an axis that panels share
        axes.set_xlim(*panel.x_limits)
    whole = not panel.rows and all(np.equal(np.mod(s.x, 1), 0).all() for s in panel.series)
    set_ticks(axes.xaxis, panel.x_scale, panel.x_ticks, whole=whole)
    if not panel.rows:
        if panel.y_limits != (None, None):
            axes.set_ylim(*panel.y_limits)
        set_ticks(axes.yaxis, panel.y_scale, panel.y_ticks, panel.y_format)


def _draw_bars(axes: "Axes", panel: Panel) -> None:
    """Bars of one series lie on its rows; of several, side by side or end to end."""
    every = [series for series in panel.series if series.bar]
    height = 0.6 if panel.stacked else 0.7 / max(len(every), 1)
    left = np.zeros(len(panel.rows))
    for i, series in enumerate(every):
        y = np.asarray(series.y) + (0.0 if panel.stacked else height * (i - (len(every) - 1) / 2))
        drawn = axes.barh(y, series.x, height, left=left, color=series.colour, alpha=series.alpha)
        _draw_intervals(axes, panel, dataclasses.replace(series, y=y, colour="black"))
        if panel.stacked:
            left = left + np.nan_to_num(series.x)
        if panel.written and (not panel.stacked or i == len(every) - 1):
            figures = [number(value, panel.written) for value in (left if panel.stacked else series.x)]
            axes.bar_label(drawn, figures, padding=3, fontsize=8, bbox=BEHIND)
            axes.margins(x=ROOM)


def _draw_points(axes: "Axes", panel: Panel, series: Series) -> None:
    _draw_intervals(axes, panel, series)
    if series.line and not panel.rows:
        axes.plot(series.x, series.y, ls=series.line, color=series.colour, lw=series.width, alpha=series.alpha)
    if series.marker:
        look = {"color": series.colour, "linewidths": STROKE if series.marker in STROKES else 0}
        if series.hollow:
            look = {"facecolors": "none", "edgecolors": series.colour}
        axes.scatter(series.x, series.y, series.size, marker=series.marker, alpha=series.alpha, zorder=3, **look)


def _draw_intervals(axes: "Axes", panel: Panel, series: Series) -> None:
    if not len(series.low) and not len(series.high):
        return
    middle = series.x if panel.rows else series.y
    low, high = (np.asarray(end if len(end) else middle, float) for end in (series.low, series.high))
    if panel.rows:
        axes.hlines(series.y, low, high, color=series.colour, lw=series.width, alpha=series.alpha)
    elif series.band:
        axes.fill_between(series.x, low, high, color=series.colour, alpha=0.2 * series.alpha, lw=0)
    else:
        axes.vlines(series.x, low, high, color=series.colour, lw=1, alpha=0.5 * series.alpha)


def _draw_rule(axes: "Axes", rule: Rule) -> None:
    look: dict[str, Any] = {"color": rule.colour, "ls": rule.line, "lw": rule.width}
    if rule.x is not None and rule.y is not None:
        left, ends = axes.get_xlim()[0], axes.get_ylim()
        axes.plot([rule.x, rule.x, left], [ends[rule.keep == "above"], rule.y, rule.y], **look)
    elif rule.x is not None:
        axes.axvline(rule.x, **look)
    elif rule.y is not None:
        axes.axhline(rule.y, **look)


def _entries(panels: Sequence[Panel]) -> "dict[str, Line2D | Patch]":
    """Name → handle of the legend, in order of appearance."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: dict[str, Line2D | Patch] = {}
    for panel in panels:
        for series in panel.series:
            colour = series.colour if isinstance(series.colour, str) else SHARED
            line = "" if panel.rows and not len(series.low) else series.line
            face = "none" if series.hollow else colour
            stroke: dict[str, Any] = {"ms": 8, "mew": STROKE} if series.marker in STROKES else {"ms": 5}
            handle = Line2D([], [], color=colour, lw=series.width, ls=line, marker=series.marker, mfc=face, **stroke)
            entries.setdefault(series.name, Patch(color=colour, alpha=series.alpha) if series.bar else handle)
        for rule in panel.rules:
            entries.setdefault(rule.name, Line2D([], [], color=rule.colour, ls=rule.line, lw=rule.width))
    entries.pop("", None)
    return entries


def _write_labels(axes: "Axes", panel: Panel) -> None:
    texts, points = [], []
    for series in panel.series:
        for i, (x, y) in enumerate(zip(series.x, series.y, strict=True)):
            if not np.isfinite((x, y)).all():
                continue
            points.append((x, y))
            if series.labels and series.labels[i]:
                colour = series.colour if isinstance(series.colour, str) else SHARED
                texts.append(axes.text(x, y, series.labels[i], fontsize=7.5, color=colour, bbox=BEHIND))
    if texts:
        from adjustText import adjust_text

        line = {"arrowstyle": "-", "color": SHARED, "lw": 0.5}
        adjust_text(texts, *zip(*points, strict=True), ax=axes, arrowprops=line, **PLACING)
