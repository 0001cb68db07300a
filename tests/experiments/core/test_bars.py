"""Bars show every figure, each beside its name, in an axis that holds them and their bounds."""

import re

from experiments.core.bars import bars
from experiments.core.charts import PALETTE


def test_figures_are_written_beside_their_names() -> None:
    drawn = texts(bars({"first": 1.234, "second": 40.0}, "time, ms", written="{:.1f}"))
    assert {"first", "second", "1.2", "40.0", "time, ms"} <= drawn


def test_bars_are_as_long_as_their_figures() -> None:
    (_, one), (_, two), (_, four) = ends(bars({"a": 1.0, "b": 2.0, "c": 4.0}, "s"))
    assert abs((four - two) - 2 * (two - one)) < 0.01


def test_equal_ratios_are_equal_distances_on_a_logarithmic_axis() -> None:
    (_, one), (_, ten), (_, hundred) = ends(bars({"a": 1.0, "b": 10.0, "c": 100.0}, "cores", logarithmic=True))
    assert abs((hundred - ten) - (ten - one)) < 0.01
    assert ten - one > 10


def test_a_bound_beyond_all_figures_lies_in_the_picture() -> None:
    ((left, right),) = ends(bars({"a": 1.0}, "s", bounds=(10.0,)))
    ((left_alone, right_alone),) = ends(bars({"a": 1.0}, "s"))
    assert 9 < (right_alone - left_alone) / (right - left) < 11


def texts(svg: bytes) -> set[str]:
    """What is written: matplotlib leaves each text in a comment beside its outlines."""
    return {text.strip() for text in re.findall(r"<!-- (.*?) -->", svg.decode())}


def ends(svg: bytes) -> list[tuple[float, float]]:
    """Left and right end of every bar, in points, from the top."""
    paths = re.findall(rf'<path d="([^"]*)"[^>]*style="fill: {PALETTE[0]}', svg.decode())
    across = [[float(x) for x in re.findall(r"[ML] (-?[\d.]+) ", path)] for path in paths]
    return [(min(x), max(x)) for x in across]
