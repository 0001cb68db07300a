"""Charts hold every figure that they are given; the same data give the same bytes."""

import re

import cv2
import numpy as np
import pytest

from experiments.core.charts import Panel, Rule, Series, bars, draw, speed_against_error
from experiments.core.look import PALETTE, colours
from experiments.core.pictures import Heatmap, heatmaps, image_grid

NUMBER = r"-?[\d.]+"


def texts(svg: bytes) -> list[str]:
    """All text: matplotlib leaves each one in a comment next to its outlines."""
    return [text.strip() for text in re.findall(r"<!-- (.*?) -->", svg.decode())]


def ends(svg: bytes, colour: str = PALETTE[0]) -> list[tuple[float, float]]:
    """Left and right end of every bar of a colour, in points, from the top."""
    paths = re.findall(rf'<path d="([^"]*)"[^>]*style="fill: {colour}', svg.decode())
    across = [[float(x) for x in re.findall(rf"[ML] ({NUMBER}) ", path)] for path in paths]
    return [(min(x), max(x)) for x in across]


def lines(svg: bytes, colour: str = PALETTE[0]) -> list[list[tuple[float, float]]]:
    """Corners of every line of a colour, in points; y points down."""
    paths = re.findall(rf'<path d="([^"]*)"[^>]*style="fill: none; stroke: {colour}', svg.decode())
    return [[(float(x), float(y)) for x, y in re.findall(rf"[ML] ({NUMBER}) ({NUMBER})", path)] for path in paths]


def test_figures_are_written_next_to_their_names():
    assert {"first", "second", "1.2", "40.0", "time, ms"} <= set(
        texts(bars({"first": 1.234, "second": 40.0}, "time, ms", written=".1f"))
    )


def test_bars_are_as_long_as_their_figures():
    (_, one), (_, two), (_, four) = ends(bars({"a": 1.0, "b": 2.0, "c": 4.0}, "s"))
    assert four - two == pytest.approx(2 * (two - one), abs=0.01)


def test_equal_ratios_are_equal_distances_on_a_logarithmic_axis():
    (_, one), (_, ten), (_, hundred) = ends(bars({"a": 1.0, "b": 10.0, "c": 100.0}, "cores", logarithmic=True))
    assert hundred - ten == pytest.approx(ten - one, abs=0.01)
    assert ten - one > 10


def test_a_bound_beyond_all_figures_lies_in_the_picture():
    ((left, right),) = ends(bars({"a": 1.0}, "s", bounds=(10.0,)))
    ((left_alone, right_alone),) = ends(bars({"a": 1.0}, "s"))
    assert 9 < (right_alone - left_alone) / (right - left) < 11


def test_stacked_bars_lie_end_to_end_and_grouped_ones_begin_together():
    of = [Series("a", x=[1.0, 2.0], bar=True), Series("b", x=[3.0, 1.0], bar=True)]
    stacked = draw([Panel(of, rows=["one", "two"], stacked=True, written=".0f")], legend=False)
    (_, end), _ = ends(stacked)
    (begin, _), _ = ends(stacked, PALETTE[1])
    assert begin == pytest.approx(end, abs=0.01)
    assert {"4", "3"} <= set(texts(stacked))
    grouped = draw([Panel(of, rows=["one", "two"])], legend=False)
    assert ends(grouped)[0][0] == pytest.approx(ends(grouped, PALETTE[1])[0][0], abs=0.01)


def test_a_name_has_one_colour_and_one_entry_in_all_panels():
    series = [Series("first", x=[0, 1], y=[0, 1], marker=""), Series("second", x=[0, 1], y=[1, 0], marker="")]
    drawn = draw([Panel(series), Panel(series[1:], rules=[Rule(y=0.5, name="bound")])])
    assert sorted(text for text in texts(drawn) if text in ("first", "second", "bound")) == ["bound", "first", "second"]
    assert len(lines(drawn, PALETTE[1])) == 3  # one in each panel, one in the legend


def test_lines_pass_through_their_points_and_rows_stand_from_the_top():
    ((a, b, c),) = lines(draw([Panel([Series(x=[0, 1, 2], y=[0, 1, 4], marker="")])]))
    assert (a[1] - c[1]) == pytest.approx(4 * (a[1] - b[1]), abs=0.01)
    spans = lines(draw([Panel([Series(x=[1, 5], low=[0, 4], high=[2, 8], marker="")], rows=["one", "two"])]))
    assert spans[0][0][1] < spans[1][0][1]
    assert spans[1][1][0] - spans[1][0][0] == pytest.approx(2 * (spans[0][1][0] - spans[0][0][0]), abs=0.01)


def test_points_are_named_and_the_same_data_give_the_same_bytes():
    points = [(f"method {i}", 1.0 + i % 3, 0.1 + i % 2, 0.5) for i in range(6)]  # some of them in one place
    drawn = speed_against_error({"kind": points}, "error", (2.0, 0.3))
    assert {name for name, *_ in points} <= set(texts(drawn))
    assert drawn == speed_against_error({"kind": points}, "error", (2.0, 0.3))


def test_a_missing_point_is_left_out():
    assert lines(draw([Panel([Series(x=[0, 1, 2], y=[0, np.nan, 4], marker="", labels=["a", "b", "c"])])]))
    assert "b" not in texts(draw([Panel([Series(x=[0, 1, 2], y=[0, np.nan, 4], labels=["a", "b", "c"])])]))


def test_another_name_does_not_recolour_the_others():
    assert colours("abc").items() <= colours("abcd").items()


def test_a_heatmap_names_its_rows_columns_and_cells():
    shown = Heatmap(
        np.eye(2), rows=["low", "high"], columns=["left", "right"], title="t", cells=[["1", "2"], ["3", "4"]]
    )
    assert {"low", "high", "left", "right", "t", "1", "4", "share"} <= set(texts(heatmaps([shown], colour_bar="share")))


def test_a_grid_of_images_is_as_large_as_its_cells():
    picture = np.zeros((8, 8, 3), np.uint8)
    sizes = [np.frombuffer(image_grid(rows)[16:24], ">u4") for rows in ({"a": [picture]}, {"a": [picture] * 3})]
    assert sizes[1][0] - sizes[0][0] == pytest.approx(2 * 1.25 * 150, abs=1)
    assert sizes[1][1] == sizes[0][1]


def test_an_image_grid_places_pictures_by_row_and_column():
    red, blue = (np.full((8, 8, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 0, 255)))
    png = image_grid({"a": [red, red], "b": [blue]}, ["one", "two"], cell_inch=0.5)
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(image.shape, (150 * 1.25, 150 * 2.05, 3), atol=1)
    half = round(150 * 0.25)
    first, second = half + half, 3 * half + half
    left, right = round(150 * 1.3), round(150 * 1.8)
    assert tuple(image[first, left]) == tuple(image[first, right]) == (255, 0, 0)
    assert tuple(image[second, left]) == (0, 0, 255)
    assert tuple(image[second, right]) == (255, 255, 255)
