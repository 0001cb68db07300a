"""Circles that are found without labels, by known touches."""

import dataclasses

import numpy as np
import pytest

from sensors_io.calibration.circles import align_circles, find_circles
from sensors_io.calibration.presses import BallPresses
from tests.sensors_io.calibration.synthetic import press_ball, spread_touches

TOUCHES = spread_touches(14)


@pytest.fixture(scope="module")
def presses() -> BallPresses:
    return press_ball(TOUCHES)


@pytest.mark.long
def test_centres_and_radii_are_found(presses: BallPresses) -> None:
    found = find_circles(presses)
    np.testing.assert_allclose(found.touches.stacked(), TOUCHES, atol=0.4)
    assert found.misfit.max() < 0.2


def test_optics_of_some_presses_find_the_others(presses: BallPresses) -> None:
    train, rest = np.arange(10), np.arange(10, 14)
    optics = find_circles(presses.chosen(train)).optics
    found = align_circles(presses.chosen(rest), optics)
    np.testing.assert_allclose(found.touches.stacked(), TOUCHES[rest], atol=0.5)


@pytest.mark.slow
def test_neither_a_speck_nor_drifting_lamps_move_a_circle(presses: BallPresses) -> None:
    brighter = np.clip(presses.pictures.astype(int) + np.array([12, -8, 5]), 0, 255).astype(np.uint8)
    found = find_circles(dataclasses.replace(presses, pictures=brighter))
    np.testing.assert_allclose(found.touches.stacked(), TOUCHES, atol=0.5)
    specked = presses.pictures.copy()
    specked[:, 30:34, 60:64] = 255
    found = find_circles(dataclasses.replace(presses, pictures=specked))
    np.testing.assert_allclose(np.median(np.abs(found.touches.stacked() - TOUCHES), 0), 0, atol=0.4)
