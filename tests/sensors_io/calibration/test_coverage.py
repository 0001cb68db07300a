"""Coverage of the window, and the next place."""

import numpy as np
import pytest

from sensors_io.calibration.coverage import coverage
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


def test_presses_all_over_cover_everything() -> None:
    grid = np.array([[x, y, 10.0] for x in range(5, 90, 10) for y in range(5, 60, 10)])
    assert coverage(Touches.of(grid), (60, 90)).share == 1.0
