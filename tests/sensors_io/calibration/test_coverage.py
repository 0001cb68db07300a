"""Coverage of the window, and the next place."""

import numpy as np
import pytest

from sensors_io.calibration.coverage import Coverage, coverage
from sensors_io.calibration.presses import Touches


def test_without_presses_the_centre_comes_first() -> None:
    seen = coverage(Touches.of(np.zeros((0, 3))), (60, 90))
    assert (seen.share, seen.next_px, seen.where()) == (0.0, (44.5, 29.5), "the middle")


def test_the_next_place_is_the_empty_corner_within_the_margin() -> None:
    rows = np.array([[15.0, 15.0, 10.0], [75.0, 15.0, 10.0], [15.0, 45.0, 10.0], [45.0, 30.0, 10.0]])
    seen = coverage(Touches.of(rows), (60, 90))
    assert seen.where() == "the lower right"
    assert seen.next_px == pytest.approx((83, 53), abs=1.0)
    assert seen.covered[15, 15]
    assert not seen.covered[55, 85]


def test_places_have_the_names_of_thirds() -> None:
    named = {(29, 19): "upper left", (30, 19): "upper middle", (60, 0): "upper right", (29, 20): "middle left"}
    named |= {(30, 39): "middle", (0, 40): "lower left", (59, 40): "lower middle", (90, 60): "lower right"}
    for place, name in named.items():
        assert Coverage(covered=np.zeros((60, 90), bool), share=0.0, next_px=place).where() == f"the {name}"


def test_presses_all_over_cover_everything() -> None:
    grid = np.array([[x, y, 10.0] for x in range(5, 90, 10) for y in range(5, 60, 10)])
    assert coverage(Touches.of(grid), (60, 90)).share == 1.0
