"""Photometric optics: the formula, its symmetries, and that the stored constants are those of a Mini."""

import dataclasses
import zlib

import jax
import numpy as np
import pytest

from sensors_io.scenes import mini_optics, photometric
from sensors_io.scenes.photometric import MINI, PhotometricOptics
from tests.sensors_io.checks import refused
from tests.sensors_io.scenes.references import deformed, light

PX, WINDOW_MM = 56, 15.2
X = (np.arange(PX) + 0.5) * WINDOW_MM / PX - WINDOW_MM / 2


def test_a_picture_is_the_formula() -> None:
    rng, slope_x, slope_y = np.random.default_rng(0), 0.2, -0.1
    rows = lambda n, scale: tuple(map(tuple, (scale * rng.standard_normal((n, 3))).tolist()))
    flat = ((0.5, 0.6, 0.7), *rows(44, 0.01))
    model = PhotometricOptics(half_window_mm=7.6, flat=flat, slope=rows(30, 0.03), depth=rows(1, 0.02), max_tilt=0.5)
    depth = 1.0 + slope_x * X[None] + slope_y * X[:, None]
    up = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    n_x, n_y = slope_x * up, slope_y * up
    at_y, at_x = 11, 40
    place = X[[at_x]] / 7.6, X[[at_y]] / 7.6
    flat = photometric.basis(*place, 8)[:, 0, 0] @ np.array(model.flat)
    local = photometric.basis(*place, 2)[:, 0, 0] @ np.array(model.slope).reshape(5, 6, 3)
    phi = np.array([n_x, n_y, n_x**2, n_x * n_y, n_y**2])
    want = flat + phi @ local + depth[at_y, at_x] * np.array(model.depth[0])
    seen = deformed(WINDOW_MM, depth), light(np.zeros((2, 2), np.float32), gain=(1.0, 0.5, 2.0))
    shade = jax.jit(photometric.shade, static_argnums=2)
    np.testing.assert_allclose(shade(*seen, model)[at_y, at_x], want * (1.0, 0.5, 2.0), rtol=1e-4)
    np.testing.assert_array_equal(jax.jit(photometric.gelsight_mini)(*seen), shade(*seen, MINI))


def test_terms_are_legendre_products_in_a_stable_order() -> None:
    assert photometric.terms(1) == [(0, 0), (0, 1), (1, 0)]
    grid = photometric.basis(np.array([0.3]), np.array([-0.5]), 2)[:, 0, 0]
    np.testing.assert_allclose(grid, [1, -0.5, -0.125, 0.3, -0.15, -0.365], atol=1e-12)
    said = r"slope has shape \(29, 3\): must be \(30, 3\)"
    refused(ValueError, said, dataclasses.replace, MINI, slope=MINI.slope[1:])


@pytest.mark.parametrize(("slope", "tilt"), [(0.0, 0.0), (0.5, 0.5 / np.sqrt(1.25)), (40.0, 0.5)])
def test_gel_steeper_than_the_fit_is_shown_as_steep_as_the_fit(slope: float, tilt: float) -> None:
    np.testing.assert_allclose(jax.jit(photometric.tilt)(slope, 0.0, 0.5), [tilt, 0], atol=1e-6)


def test_the_constants_are_those_that_were_fitted_to_a_real_mini() -> None:
    """Of the fit recorded by `scene_realism`; fitted anew, they have another checksum, and so have the records."""
    constants = {name: value for name, value in vars(mini_optics).items() if name.isupper()}
    assert zlib.crc32(repr(constants).encode()) == 1793279860


def test_grain_has_its_deviation_and_its_correlations() -> None:
    grain = photometric.grain(np.random.default_rng(0), 200, (0.01, 0.02, 0.005), 0.6)
    np.testing.assert_allclose(grain.std((1, 2)), (0.01, 0.02, 0.005), rtol=0.05)
    assert np.corrcoef(grain[0].ravel(), grain[1].ravel())[0, 1] == pytest.approx(0.6, abs=0.05)
    assert np.corrcoef(grain[0, 1:].ravel(), grain[0, :-1].ravel())[0, 1] == pytest.approx(0.5, abs=0.05)
