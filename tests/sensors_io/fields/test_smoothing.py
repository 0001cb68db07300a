"""Smoothing takes noise and leaves motion."""

import numpy as np
import pytest

from sensors_io.fields.smoothing import Smoother
from sensors_io.fields.spline import ThinPlate
from tests.sensors_io.fields import gels

POINTS = gels.lattice()
SPLINE = ThinPlate(POINTS)
SMOOTH = Smoother(SPLINE)


def noise(size: float, seed: int) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal(POINTS.shape)


def test_an_affine_motion_stays() -> None:
    affine = POINTS @ np.array([[0.01, -0.02], [0.03, 0.005]]) + [3.0, -1.0]
    np.testing.assert_allclose(SMOOTH(affine), affine, atol=1e-5)


def test_gel_at_rest_is_read_three_times_as_precisely() -> None:
    ratio = [np.square(SMOOTH(d)).mean() / np.square(d).mean() for d in (noise(0.02, seed) for seed in range(20))]
    assert np.sqrt(np.median(ratio)) < 1 / 3


@pytest.mark.parametrize("peak", [0.1, 1.0, 10.0])
def test_a_contact_is_never_read_worse(peak: float) -> None:
    """A bump of the width of two pitches, whatever its height over the noise."""
    bump = peak * np.exp(-(((POINTS - [95, 75]) / 40) ** 2).sum(1) / 2)[:, None] * [0.8, -0.6]
    errors = [[np.square(f - bump).mean() for f in (SMOOTH(d), d)] for d in (bump + noise(0.02, s) for s in range(20))]
    smoothed, raw = np.sqrt(np.mean(errors, 0))
    assert smoothed < 1.02 * raw


def test_it_is_the_minimum_of_misfit_and_bending() -> None:
    """f + λ B f = d for one λ."""
    d = noise(0.02, 3) + 0.1 * np.sin(POINTS / 30)
    f = SMOOTH(d).astype(np.float64)
    bent = SPLINE.roughness @ f
    strength = np.sum(bent * (d - f)) / np.sum(bent**2)
    assert strength > 0
    np.testing.assert_allclose(f + strength * bent, d, atol=2e-5)
