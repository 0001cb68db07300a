"""What a press is."""

import dataclasses

import numpy as np
import pytest

from sensors_io.calibration.presses import indentation, shrink
from sensors_io.calibration.published import reduced
from sensors_io.fields.types import CalibrationError
from tests.sensors_io.calibration.synthetic import press_ball, spread_touches
from tests.sensors_io.checks import refused

RADIUS, CONTACT = 3.0, 1.2


def test_the_contact_is_a_cap_of_the_ball() -> None:
    r = np.linspace(0, CONTACT, 7)
    depth, slope, across = indentation(r, np.zeros(7), CONTACT, RADIUS)
    cap = np.sqrt(RADIUS**2 - r**2)
    np.testing.assert_allclose(depth - depth[0], cap - cap[0], atol=1e-12)
    np.testing.assert_allclose(slope, -r / cap, atol=1e-12)
    assert not across.any()


def test_the_edge_lies_at_half_the_approach_and_far_away_nothing_moves() -> None:
    """Hertz: the approach is a²/R, the edge sinks by a²/2R, and the displacement falls as a³/r: the load's 1/r."""
    contact = 0.05  # of which the paraboloid is the ball to second order
    centre, edge = indentation(np.array([0.0, contact]), np.zeros(2), contact, RADIUS)[0]
    assert (centre, edge) == pytest.approx((contact**2 / RADIUS, centre / 2), rel=1e-3)
    far = indentation(np.array([100.0, 200.0]), np.zeros(2), CONTACT, RADIUS)[0]
    assert far[0] / far[1] == pytest.approx(2, rel=1e-3)


def test_slopes_are_the_gradient_of_depth_across_the_edge() -> None:
    x = np.linspace(0.2, 4, 4001)
    depth, slope, _ = indentation(x, 0.3 + 0 * x, CONTACT, RADIUS)
    numeric = np.gradient(depth, x)
    edge = np.abs(np.hypot(x, 0.3) - CONTACT) < 0.01
    np.testing.assert_allclose(slope[~edge], numeric[~edge], atol=2e-3)
    assert np.abs(np.diff(slope)).max() < 0.05


def test_published_pictures_become_at_most_480_pixels_wide() -> None:
    assert reduced(np.zeros((90, 1000, 3), np.uint8)).shape == (30, 333, 3)
    assert reduced(np.zeros((90, 480, 3), np.uint8)).shape == (90, 480, 3)


def test_shrinking_takes_means() -> None:
    picture = np.arange(5 * 4 * 3, dtype=np.uint8).reshape(5, 4, 3)
    small = shrink(picture, 2)
    assert small.shape == (2, 2, 3)
    np.testing.assert_allclose(small[0, 0], picture[:2, :2].mean((0, 1)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius_mm": 0.0}, "radius_mm is 0.0: must be > 0"),
        ({"mm_per_px": -1.0}, r"mm_per_px is -1.0: must be > 0"),
        ({"radius_mm": 3000.0}, r"diameter is 6000 mm: must lie in \[0.3, 95.4\] mm for pictures of 106 × 80 px"),
        ({"radius_mm": 0.003}, "diameter is 0.006 mm: must lie in .*; give it in mm"),
        ({"background": np.zeros((80, 100, 3), np.uint8)}, "must be equal"),
        ({"pictures": np.zeros((2, 80, 106, 3), np.float32)}, "must be uint8"),
    ],
)
def test_bad_presses_are_refused(change: dict, message: str) -> None:
    refused(CalibrationError, message, lambda: dataclasses.replace(press_ball(spread_touches(2)), **change))
