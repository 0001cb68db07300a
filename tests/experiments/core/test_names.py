"""Names that hide nothing."""

import itertools

import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from experiments.core.names import Box, Named, name_points


@pytest.fixture
def figure() -> Figure:
    return Figure(figsize=(6, 4), layout="constrained")


@pytest.fixture
def axes(figure) -> Axes:
    drawn: Axes = figure.subplots()
    drawn.set(xlim=(0, 10), ylim=(0, 10))
    return drawn


def point(name: str, x: float, y: float) -> Named:
    return Named(name=name, x=x, y=y, colour="k")


def boxes(figure: Figure, points: list[Named]) -> list[Box]:
    """What the names cover once the chart is drawn."""
    names = name_points(figure.axes[0], points)
    figure.draw_without_rendering()
    return [Box(*Text.get_window_extent(name).extents) for name in names]


def test_a_lone_point_has_its_name_above_to_the_right(axes):
    (name,) = name_points(axes, [point("alone", 5, 5)])
    assert min(name.get_position()) > 0
    assert (name.get_horizontalalignment(), name.get_verticalalignment()) == ("left", "bottom")


@pytest.mark.usefixtures("axes")
def test_crowded_names_share_no_pixel(figure):
    crowd = [point(f"a rather long name {i}", 5 + 0.02 * i, 5 + 0.05 * (i % 3)) for i in range(8)]
    for a, b in itertools.combinations(boxes(figure, crowd), 2):
        assert a.common(b) == 0


def test_no_name_covers_a_point(figure, axes):
    row = [point(f"name {i}", 1 + i, 5) for i in range(9)]
    covered = boxes(figure, row)
    for p in row:
        x, y = axes.transData.transform((p.x, p.y))
        assert not any(b.left < x < b.right and b.low < y < b.high for b in covered)


def test_names_stay_inside(figure, axes):
    for corner in ((0, 0), (0, 10), (10, 0), (10, 10)):
        (box,) = boxes(figure, [point("at the corner", *corner)])
        inside = axes.get_window_extent()
        assert inside.x0 <= box.left
        assert box.right <= inside.x1
        assert inside.y0 <= box.low
        assert box.high <= inside.y1


def test_names_come_back_in_the_order_of_their_points(axes):
    named = name_points(axes, [point("low", 3, 1), point("high", 3, 9)])
    assert [text.get_text() for text in named] == ["low", "high"]


@pytest.mark.parametrize(("other", "area"), [(Box(1, 1, 3, 3), 1), (Box(2, 0, 3, 1), 0), (Box(-1, -1, 9, 9), 4)])
def test_shared_area_by_hand(other, area):
    assert Box(0, 0, 2, 2).common(other) == area
