"""The blurred imprint of a ball, by closed forms and by a blur in two dimensions."""

import numpy as np
from scipy import ndimage

from sensors_io.calibration.imprint import Imprint
from sensors_io.calibration.presses import indentation

RADIUS, CONTACT = 3.0, 1.5


def test_blur_leaves_the_linear_inside_and_smooths_the_rim() -> None:
    x = np.array([0.3, 0.6, 0.9, 1.5])
    normal = Imprint(RADIUS, 0.2)(x, 0 * x, CONTACT)[0]
    np.testing.assert_allclose(normal[:3], -x[:3] / RADIUS, rtol=0.01)
    assert -normal[3] < 0.8 * x[3] / RADIUS


def test_it_is_the_gaussian_blur_of_the_field() -> None:
    step = 0.04
    axis = step * np.arange(-150, 151)
    x, y = np.meshgrid(axis, axis)
    depth, d_x, d_y = indentation(x, y, CONTACT, RADIUS)
    unit = d_x / np.sqrt(1 + d_x**2 + d_y**2)
    near = np.hypot(x, y) < 4
    n_x, _, u = Imprint(RADIUS, 0.2)(x[near], y[near], CONTACT)
    np.testing.assert_allclose(n_x, ndimage.gaussian_filter(unit, 0.2 / step)[near], atol=0.006)
    np.testing.assert_allclose(u, ndimage.gaussian_filter(depth, 0.2 / step)[near], atol=0.006)
