"""Pitch of the pixels from presses of a ball: closed forms of contact, and pictures of known presses."""

import numpy as np
import pytest

from sensors_io.calibration.geometry import GeometryError
from sensors_io.calibration.scale import approach_mm, contact_radius_mm, measure_scale, scale_from_presses
from sensors_io.layer import Layer
from tests.sensors_io.calibration.synthetic import press_ball, spread_touches
from tests.sensors_io.checks import refused

THICK = Layer(modulus_mpa=1.0, poisson=0.48, thickness_mm=1e4)
GEL = Layer(modulus_mpa=1.0, poisson=0.48, thickness_mm=4.5)


@pytest.mark.parametrize("contact", [0.3, 1.8, 2.5])
def test_thick_gel_is_a_half_space(contact: float) -> None:
    """δ = (a/2) ln((R + a)/(R − a)), Sneddon 1965, of a true sphere."""
    assert approach_mm(contact, 3.0, THICK) == pytest.approx(contact / 2 * np.log((3 + contact) / (3 - contact)), 2e-3)


def test_a_layer_stiffens_to_first_order_as_published() -> None:
    """δ = (a²/R) (1 − 0.755 a/t) for ν = ½: from 1.133 of eq. 13 of Dimitriadis et al., Biophys. J. 82, 2798, 2002."""
    soft = Layer(modulus_mpa=1.0, poisson=0.5, thickness_mm=4.5)
    assert (1 - approach_mm(0.09, 30.0, soft) * 30 / 0.09**2) / (0.09 / 4.5) == pytest.approx(0.755, abs=0.03)


def test_thin_gel_lies_between_clinging_and_sinking() -> None:
    contact = contact_radius_mm(0.5, 3.0, GEL)
    assert approach_mm(contact, 3.0, GEL) == pytest.approx(0.5, abs=1e-4)
    assert contact_radius_mm(0.5, 3.0, THICK) < contact < np.sqrt(2 * 3 * 0.5 - 0.5**2)
    refused(GeometryError, "measure it from first touch", contact_radius_mm, 9.0, 3.0, GEL)


def test_contact_circles_at_known_depths_give_the_scale() -> None:
    depth = np.array([0.25, 0.5, 0.75, 1.0])
    radius = np.array([contact_radius_mm(d, 3.0, GEL) for d in depth]) / 0.05
    exact = scale_from_presses(radius, depth, ball_diameter_mm=6.0, gel=GEL)
    assert exact.mm_per_px == pytest.approx(0.05)
    assert exact.error < 1e-12
    noise = np.array([0.5, -0.5, 0.5, -0.5])
    noisy = scale_from_presses(radius + noise, depth, ball_diameter_mm=6.0, gel=GEL)
    assert noisy.mm_per_px == pytest.approx(0.05, abs=3 * noisy.error)
    with pytest.raises(GeometryError, match="3 circles and 4 depths"):
        scale_from_presses(radius[:3], depth, ball_diameter_mm=6.0, gel=GEL)


@pytest.mark.slow
def test_pictures_give_the_scale() -> None:
    """A pitch of 0.11 mm, looked for from 0.151."""
    touches = spread_touches(8)
    presses = press_ball(touches, mm_per_px=0.11)
    depth = np.array([approach_mm(0.11 * radius, 3.0, THICK) for radius in touches[:, 2]])
    scale, circles = measure_scale(presses.pictures, presses.background, depth, ball_diameter_mm=6.0, gel=THICK)
    assert scale.mm_per_px == pytest.approx(0.11, rel=0.03)
    assert np.median(np.abs(circles.touches.radius_px / touches[:, 2] - 1)) < 0.05
