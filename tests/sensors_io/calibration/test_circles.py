"""Circles that are found without labels, by known touches."""

import numpy as np
import pytest

from sensors_io.calibration.circles import align_circles, find_circles
from sensors_io.calibration.presses import BallPresses
from tests.sensors_io.calibration.synthetic import press_ball, spread_touches

TOUCHES = spread_touches(14)


@pytest.fixture(scope="module")
def presses() -> BallPresses:
    return press_ball(TOUCHES)


def test_centres_and_radii_are_found(presses: BallPresses) -> None:
    found = find_circles(presses)
    np.testing.assert_allclose(found.touches.stacked(), TOUCHES, atol=0.4)
    assert found.misfit.max() < 0.2


def test_optics_of_some_presses_find_the_others(presses: BallPresses) -> None:
    train, rest = np.arange(10), np.arange(10, 14)
    optics = find_circles(presses.chosen(train)).optics
    found = align_circles(presses.chosen(rest), optics)
    np.testing.assert_allclose(found.touches.stacked(), TOUCHES[rest], atol=0.5)
