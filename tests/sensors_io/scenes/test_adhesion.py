"""Adhesion: the closed forms of JKR and DMT, when it may be left out, and any shape from its press."""

import dataclasses

import numpy as np
import pytest

from sensors_io.layer import Layer
from sensors_io.scenes.adhesion import Adhesion, adhesive_ramp, plane_modulus_mpa, work_left
from tests.sensors_io.checks import refused

GEL_MODULUS = 0.3 / (1 - 0.48**2)
SOFT = Adhesion(radius_mm=8.0, plane_modulus_mpa=GEL_MODULUS, work_n_per_mm=5e-5)  # 0.05 J/m²
PULL_OFF_N = 1.5 * np.pi * 5e-5 * 8.0
STIFF = Adhesion(radius_mm=1e-4, plane_modulus_mpa=1e5, work_n_per_mm=5e-5)


def same_width_n(sphere: Adhesion, force_n: float) -> float:
    """F₁ of an equally wide contact without adhesion: JKR F + 3πwR + √(6πwRF + (3πwR)²), DMT F + 2πwR."""
    unit = np.pi * sphere.work_n_per_mm * sphere.radius_mm
    if sphere.tabor < 1:
        return force_n + 2 * unit
    return force_n + 3 * unit + float(np.sqrt(6 * unit * force_n + 9 * unit**2))


def test_tabor_by_hand() -> None:
    """A gel is far in the JKR limit, which holds above 5 (Johnson & Greenwood 1997), a small stiff tip in DMT's."""
    assert SOFT.tabor == pytest.approx((8.0 * 5e-5**2 / (GEL_MODULUS**2 * 3e-7**3)) ** (1 / 3))
    assert SOFT.tabor > 500
    assert STIFF.tabor < 0.1
    assert dataclasses.replace(SOFT, work_n_per_mm=0.0).least_force_n(0.1) == 0


def widening(sphere: Adhesion, force_n: float) -> float:
    """By how much adhesion widens the contact: a³ goes with the force of a contact without it."""
    return (same_width_n(sphere, force_n) / force_n) ** (1 / 3) - 1


@pytest.mark.parametrize("of", [SOFT, STIFF], ids=["JKR", "DMT"])
@pytest.mark.parametrize("tolerance", [0.01, 0.1, 0.5])
def test_from_the_least_force_on_the_change_is_within_the_tolerance(of: Adhesion, tolerance: float) -> None:
    least = of.least_force_n(tolerance)
    assert widening(of, least) == pytest.approx(tolerance)
    assert widening(of, 1.01 * least) < tolerance < widening(of, 0.99 * least)


def test_half_spaces_in_series() -> None:
    gel, body = (Layer(modulus_mpa=e, poisson=nu, thickness_mm=4.0) for e, nu in ((0.3, 0.48), (1.0, 0.4)))
    assert plane_modulus_mpa(gel) == pytest.approx(GEL_MODULUS)
    assert plane_modulus_mpa(gel, body) == pytest.approx(1 / ((1 - 0.48**2) / 0.3 + (1 - 0.4**2) / 1.0))


def test_roughness_pays_for_its_flattening_from_the_work() -> None:
    """Pressure E*ka/2 cos flattens a wave a cos: half of their product, averaged, is E*ka²/8."""
    waves = np.array([[3.0, 4.0], [0.0, 2.0]])
    assert work_left(5e-5, 0.4, waves, np.array([0.01, 0.0])) == pytest.approx(5e-5 - 0.4 * 5 * 1e-4 / 8)
    assert work_left(5e-5, 0.4, waves, np.zeros(2)) == 5e-5
    assert work_left(5e-5, 0.4, waves, np.array([0.02, 0.05])) == 0


def test_the_ramp_of_a_sphere_becomes_jkr() -> None:
    hertz, depth, area = _sphere_ramp(np.linspace(0.005, 0.5, 4000))
    force, approach = adhesive_ramp(hertz, depth, area, SOFT.work_n_per_mm)
    radius = np.sqrt(area / np.pi)
    stretch = np.sqrt(2 * np.pi * SOFT.work_n_per_mm * radius / GEL_MODULUS)
    inner = (hertz > 2 * PULL_OFF_N) & (depth < 0.499)  # stable; differences are one-sided at the end
    np.testing.assert_allclose(approach[inner], (radius**2 / SOFT.radius_mm - stretch)[inner], rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose([same_width_n(SOFT, f) for f in force[inner]], hertz[inner], rtol=2e-3)


def _sphere_ramp(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return 4 / 3 * GEL_MODULUS * np.sqrt(SOFT.radius_mm) * depth**1.5, depth, np.pi * SOFT.radius_mm * depth


def test_the_ramp_finds_the_pull_off() -> None:
    force, _ = adhesive_ramp(*_sphere_ramp(np.geomspace(1e-3, 0.2, 4000)), SOFT.work_n_per_mm)
    assert force.min() == pytest.approx(-PULL_OFF_N, rel=1e-3)


def test_impossible_input_is_refused() -> None:
    refused(ValueError, "radius_mm is 0", dataclasses.replace, SOFT, radius_mm=0)
    refused(ValueError, "work_n_per_mm is -1", dataclasses.replace, SOFT, work_n_per_mm=-1)
    refused(ValueError, r"tolerance is 0\.0: must be > 0", SOFT.least_force_n, 0.0)
    hertz, depth, area = _sphere_ramp(np.linspace(0.005, 0.5, 50))
    refused(ValueError, "must stiffen", lambda: adhesive_ramp(np.sqrt(hertz), depth, area, 5e-5))
    refused(ValueError, "must not shrink", adhesive_ramp, hertz, depth, area[::-1], 5e-5)
