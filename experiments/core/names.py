"""Names beside the points of a chart, where they hide neither each other nor a point."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

ANGLES = (45, -45, 135, -135, 90, -90, 0, 180)
"""Directions in which a name may stand from its point, degrees, the better ones first."""

DISTANCES_PT = (6.0, 14.0, 24.0, 36.0, 50.0)
"""How far from its point a name may begin; the nearest free place is taken."""

MARKER_PT = 4.0
"""Half of a marker's side."""

AXIS = 0.3  # a direction within 17 degrees of an axis centres the name on it


@dataclasses.dataclass(frozen=True, kw_only=True)
class Named:
    """A point in data coordinates, its name and colour."""

    name: str
    x: float
    y: float
    colour: str


class Box(NamedTuple):
    """A rectangle in pixels."""

    left: float
    low: float
    right: float
    high: float

    @property
    def area(self) -> float:
        """Its area, 0 where it is turned inside out."""
        return max(0.0, self.right - self.left) * max(0.0, self.high - self.low)

    def common(self, other: "Box") -> float:
        """Area that two rectangles share."""
        low, high = map(max, self[:2], other[:2]), map(min, self[2:], other[2:])
        return Box(*low, *high).area


@dataclasses.dataclass(frozen=True, kw_only=True)
class Place:
    """Where a name stands: offset from its point in points of 1/72 inch, and alignment to that spot."""

    right_pt: float
    up_pt: float
    horizontal: str
    vertical: str

    def box(self, x: float, y: float, width: float, height: float, px_per_pt: float) -> Box:
        """What a name of a size covers, beside a point at (x, y), all in pixels."""
        left = x + px_per_pt * self.right_pt - width * {"left": 0.0, "center": 0.5, "right": 1.0}[self.horizontal]
        low = y + px_per_pt * self.up_pt - height * {"bottom": 0.0, "center": 0.5, "top": 1.0}[self.vertical]
        return Box(left, low, left + width, low + height)


def _place(distance: float, degrees: float) -> Place:
    right, up = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return Place(
        right_pt=distance * right,
        up_pt=distance * up,
        horizontal="center" if abs(right) < AXIS else "left" if right > 0 else "right",
        vertical="center" if abs(up) < AXIS else "bottom" if up > 0 else "top",
    )


PLACES = tuple(_place(distance, degrees) for distance in DISTANCES_PT for degrees in ANGLES)


def name_points(axes: Axes, points: Sequence[Named], *, size_pt: float = 7.5) -> list[Text]:
    """Write every name at the place around its point that hides least, the nearest of those; a line ties it to it.

    What counts as hidden is the area that it shares with points, with the legend of the axes and with names that stand
    already, and what of it leaves the axes.  Call it last, when limits and scales are final.

    Args:
      axes: of the chart, on a figure.
      points: what to name.
      size_pt: font size.

    Returns:
      the names in the order of the points.

    Raises:
      ValueError: axes without a figure.
    """
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("axes belong to no figure: names need its size; make them by Figure().subplots()")
    figure.draw_without_rendering()  # settles the layout, which the names are then left out of
    px_per_pt = figure.dpi / 72
    inside = Box(*axes.get_window_extent().extents)
    centre = {point: axes.transData.transform((point.x, point.y)) for point in points}
    side = MARKER_PT * px_per_pt
    taken = [Box(x - side, y - side, x + side, y + side) for x, y in centre.values()]
    if (legend := axes.get_legend()) is not None:
        taken.append(Box(*legend.get_window_extent().extents))
    names = {}
    for point in sorted(points, key=lambda p: -centre[p][1]):
        names[point] = text = _write(axes, point, size_pt)
        extent, (x, y) = Text.get_window_extent(text), centre[point]
        boxes = [place.box(x, y, extent.width, extent.height, px_per_pt) for place in PLACES]
        hidden = [sum(box.common(other) for other in taken) + box.area - box.common(inside) for box in boxes]
        best = hidden.index(min(hidden))
        taken.append(boxes[best])
        text.set_position((PLACES[best].right_pt, PLACES[best].up_pt))
        text.set(ha=PLACES[best].horizontal, va=PLACES[best].vertical)
    return [names[point] for point in points]


def _write(axes: Axes, point: Named, size_pt: float) -> Text:
    """The name on its point, with a line between them once it has moved away."""
    line = {"arrowstyle": "-", "color": point.colour, "lw": 0.5, "shrinkA": 0.0, "shrinkB": MARKER_PT}
    look: dict[str, Any] = {"fontsize": size_pt, "color": point.colour, "arrowprops": line}
    text = axes.annotate(point.name, (point.x, point.y), (0.0, 0.0), textcoords="offset points", **look)
    text.set_in_layout(False)
    text.set_path_effects([withStroke(linewidth=2.0, foreground="white")])  # legible on lines that it crosses
    return text
