"""Charts hold every figure that they are given; the same data give the same bytes."""

import re

import cv2
import numpy as np
import pytest

from experiments.core.charts import BEATEN, Panel, Rule, Series, bars, dominated, draw, speed_against_error
from experiments.core.curves import curves_by_phase, running_mean, training_curves
from experiments.core.look import MARKERS, PALETTE, colours, marks
from experiments.core.pictures import Heatmap, heatmaps, image_grid

NUMBER = r"-?[\d.]+"


def texts(svg: bytes) -> set[str]:
    """All text: matplotlib leaves each one in a comment next to its outlines."""
    return {text.strip() for text in re.findall(r"<!-- (.*?) -->", svg.decode())}


def ends(svg: bytes, colour: str = PALETTE[0]) -> list[tuple[float, float]]:
    """Left and right end of every bar of a colour, in points, from the top."""
    paths = re.findall(rf'<path d="([^"]*)"[^>]*style="fill: {colour}', svg.decode())
    across = [[float(x) for x in re.findall(rf"[ML] ({NUMBER}) ", path)] for path in paths]
    return [(min(x), max(x)) for x in across]


def lines(svg: bytes, colour: str = PALETTE[0]) -> list[list[tuple[float, float]]]:
    """Corners of every line of a colour, in points; y points down."""
    paths = re.findall(rf'<path d="([^"]*)"[^>]*style="fill: none; stroke: {colour}', svg.decode())
    return [[(float(x), float(y)) for x, y in re.findall(rf"[ML] ({NUMBER}) ({NUMBER})", path)] for path in paths]


def test_bars_are_as_long_as_their_figures_which_stand_at_their_ends():
    drawn = bars({"a": 1.0, "b": 2.0, "c": 4.0}, "time, ms", written=".1f")
    (_, one), (_, two), (_, four) = ends(drawn)
    assert four - two == pytest.approx(2 * (two - one), abs=0.01)
    assert {"a", "b", "c", "1.0", "4.0", "time, ms"} <= texts(drawn)
    (_, one), (_, ten), (_, hundred) = ends(bars({"a": 1.0, "b": 10.0, "c": 100.0}, "cores", logarithmic=True))
    assert hundred - ten == pytest.approx(ten - one, abs=0.01)
    assert ten - one > 10


def test_stacked_bars_lie_end_to_end_and_grouped_ones_begin_together():
    of = [Series("a", x=[1.0, 2.0], bar=True), Series("b", x=[3.0, 1.0], bar=True)]
    stacked = draw([Panel(of, rows=["one", "two"], stacked=True, written=".0f")], legend=False)
    assert ends(stacked, PALETTE[1])[0][0] == pytest.approx(ends(stacked)[0][1], abs=0.01)
    assert {"4", "3"} <= texts(stacked)
    bare = draw([Panel(of, rows=["one", "two"], stacked=True)], legend=False)
    assert ends(stacked, PALETTE[1])[0][1] < 0.95 * ends(bare, PALETTE[1])[0][1]  # leaves room for its figure
    grouped = draw([Panel(of, rows=["one", "two"])], legend=False)
    assert ends(grouped)[0][0] == pytest.approx(ends(grouped, PALETTE[1])[0][0], abs=0.01)


def test_a_name_has_one_colour_and_one_entry_in_all_panels():
    series = [Series("first", x=[0, 1], y=[0, 1], marker=""), Series("second", x=[0, 1], y=[1, 0], marker="")]
    drawn = draw([Panel(series), Panel(series[1:], rules=[Rule(y=0.5, name="bound")])])
    shown = re.findall(r"<!-- (first|second|bound) -->", drawn.decode())
    assert sorted(shown) == ["bound", "first", "second"]
    assert len(lines(drawn, PALETTE[1])) == 3  # one in each panel, one in the legend
    assert colours("abc").items() <= colours("abcd").items()


def test_fifty_names_look_different_in_tables_and_as_lines_and_a_control_keeps_its_colour():
    found = marks([*map(str, range(25)), "sft", *map(str, range(25, 50))])
    assert len({(one.colour, one.symbol) for one in found.values()}) == len(found)
    assert len({(one.colour, one.line) for one in found.values()}) == len(found)
    assert found["sft"].marker == MARKERS[0]


def test_lines_pass_through_their_points_and_rows_stand_from_the_top():
    ((a, b, c),) = lines(draw([Panel([Series(x=[0, 1, 2], y=[0, 1, 4], marker="")])]))
    assert (a[1] - c[1]) == pytest.approx(4 * (a[1] - b[1]), abs=0.01)
    spans = lines(draw([Panel([Series(x=[1, 5], low=[0, 4], high=[2, 8], marker="")], rows=["one", "two"])]))
    assert spans[0][0][1] < spans[1][0][1]
    assert spans[1][1][0] - spans[1][0][0] == pytest.approx(2 * (spans[0][1][0] - spans[0][0][0]), abs=0.01)


@pytest.mark.long
def test_points_are_named_unless_missing_and_the_same_data_give_the_same_bytes():
    points = [(f"method {i}", 1.0 + i % 3, 0.1 + i % 2, 0.5) for i in range(6)]  # some of them in one place
    drawn = speed_against_error({"kind": points}, "error", (2.0, 0.3))
    assert {name for name, *_ in points} <= texts(drawn)
    assert drawn == speed_against_error({"kind": points}, "error", (2.0, 0.3))
    assert "b" not in texts(draw([Panel([Series(x=[0, 1, 2], y=[0, np.nan, 4], labels=["a", "b", "c"])])]))


def test_dominated_choices_are_crossed():
    points = [(1.0, 2.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0), (np.nan, 0.0)]
    assert dominated(points) == [False, False, True, False, False]
    named = [(str(i), *point, point[1]) for i, point in enumerate(points[:3])]
    assert BEATEN in texts(speed_against_error({"kind": named}, "error", None))
    assert BEATEN not in texts(speed_against_error({"kind": named[:2]}, "error", None))
    higher = Panel([Series("kind", x=[1, 2, 2], y=[2, 1, 2])], better=("lower", "higher"))
    assert BEATEN in texts(draw([higher]))  # (2, 1) is slower and worse than (1, 2)
    line = Panel([Series(x=[1, 2], y=[2, 1], marker="")], better=("lower", "higher"))
    assert BEATEN not in texts(draw([line]))


@pytest.mark.long
def test_ticks_are_whole_where_numbers_are_and_do_not_overlap_on_a_narrow_axis():
    assert "0.5" not in texts(draw([Panel([Series(x=[0, 1, 2, 3], y=[0, 10, 20, 30])])]))
    assert "0.5" in texts(draw([Panel([Series(x=[0, 1.5, 3], y=[0, 10, 20])])]))
    logarithmic = Panel([Series(x=[0.0015, 0.15], y=[0, 1])], x_scale="log")
    assert "0.002" in texts(draw([logarithmic]))
    narrow = texts(draw([logarithmic] * 5, columns=5, size=(11.0, 3.0)))
    assert narrow & {"0.002", "0.01", "0.1"} == {"0.01", "0.1"}
    linear = texts(draw([Panel([Series(x=[0.0025, 0.0175], y=[0, 1])])] * 3))
    assert linear & {"0.0025", "0.005"} == {"0.005"}


def test_a_heatmap_names_its_rows_columns_and_cells():
    shown = Heatmap(
        np.eye(2), rows=["low", "high"], columns=["left", "right"], title="t", cells=[["1", "2"], ["3", "4"]]
    )
    assert {"low", "high", "left", "right", "t", "1", "4", "share"} <= texts(heatmaps([shown], colour_bar="share"))


def test_a_rule_of_both_axes_is_a_corner_and_labels_stand_at_the_left():
    both = Rule(x=1, y=2, keep="above", line="-", colour=PALETTE[3])
    ((top, corner, end),) = lines(draw([Panel([Series(x=[0, 4], y=[0, 4], marker="")], rules=[both])]), PALETTE[3])
    assert (top[0], corner[1]) == pytest.approx((corner[0], end[1]), abs=0.01)
    assert top[1] < corner[1]
    assert end[0] < corner[0]
    three = heatmaps([Heatmap(np.eye(2), rows="ab", columns="cd", title="t")] * 3, columns=2, y_label="down")
    assert three.count(b"<!-- down -->") == 2


def test_an_image_grid_places_pictures_by_row_and_column():
    red, blue = (np.full((8, 8, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 0, 255)))
    png = image_grid({"a": [red, red], "b": [blue]}, ["one", "two"], cell_inch=0.5)
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_allclose(image.shape, (150 * 1.25, 150 * 2.05, 3), atol=1)
    first, second = (round(150 * (0.25 + 0.5 * row + 0.25)) for row in (0, 1))
    left, right = (round(150 * (1.05 + 0.5 * column + 0.25)) for column in (0, 1))
    found = [tuple(image[row, column]) for row in (first, second) for column in (left, right)]
    assert found == [(255, 0, 0), (255, 0, 0), (0, 0, 255), (255, 255, 255)]


def test_curves_are_sorted_by_phase_arm_and_seed():
    logged = [
        {"stage": "grpo/paid/1", "step": 1, "reward": 0.75},
        {"stage": "grpo/paid/1", "step": 0, "reward": 0.25, "note": "text"},
        {"stage": "grpo/paid/1", "step": 1, "reward": 0.5},  # the last of one step counts
        {"stage": "sft/0", "step": 0, "loss": 1},
    ]
    found = curves_by_phase(logged)
    steps, values = found["grpo"]["reward"]["paid", "1"]
    assert (steps.tolist(), values.tolist()) == ([0, 1], [0.25, 0.5])
    assert {phase: list(scalars) for phase, scalars in found.items()} == {"grpo": ["reward"], "sft": ["loss"]}
    assert list(found["sft"]["loss"]) == [("", "0")]


def test_running_mean_is_over_a_twentieth_of_the_points():
    """Of 40 points three, and of those at the ends the two that there are."""
    assert running_mean(np.eye(100)[50])[47:54].tolist() == pytest.approx([0, 0.2, 0.2, 0.2, 0.2, 0.2, 0])
    assert running_mean(np.arange(40.0)).tolist() == pytest.approx([0.5, *range(1, 39), 38.5])


@pytest.mark.long
def test_a_chart_of_many_lines_stays_small():
    """Twenty arms of ten seeds and 1,000 steps in three panels, whose points would be some 4 MB."""
    curve = np.arange(1000), np.random.default_rng(0).normal(size=1000)
    series = {(f"arm {i}", f"{seed}"): curve for i in range(20) for seed in range(10)}
    scalars = {f"scalar {i}": series for i in range(3)}
    assert len(training_curves(scalars, {})) < 750_000
    assert len(training_curves({"loss": {("", "0"): curve}}, {})) > 2_000
