"""The thin-plate spline against SciPy's, its leave-out formulas against fits without the points."""

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from sensors_io.fields.neighbours import Neighbours
from sensors_io.fields.spline import Densifier, ThinPlate
from tests.sensors_io.checks import refused
from tests.sensors_io.fields import gels

RNG = np.random.default_rng(0)
POINTS = gels.lattice(22) + RNG.normal(0, 2, gels.lattice(22).shape)
DISPLACEMENT = RNG.normal(0, 3, (len(POINTS), 2)).astype(np.float32)
PLACES = RNG.uniform(10, 150, (30, 2))
EVERY = np.ones(len(POINTS), bool)


def test_equals_scipy():
    spline = ThinPlate(POINTS, smoothing=0.0)
    wanted = RBFInterpolator(POINTS, DISPLACEMENT, kernel="thin_plate_spline")(PLACES)
    np.testing.assert_allclose(spline.matrix(PLACES) @ DISPLACEMENT, wanted, atol=1e-3)
    np.testing.assert_allclose(spline.matrix(POINTS) @ DISPLACEMENT, DISPLACEMENT, atol=1e-3)


@pytest.mark.parametrize("smoothing", [1e-4, 1e-2])
def test_lost_points_are_what_the_spline_of_the_others_says(smoothing):
    found = EVERY.copy()
    found[[2, 7, 8]] = False
    filled = ThinPlate(POINTS, smoothing).filled(np.where(found[:, None], DISPLACEMENT, np.nan), found)
    pitch = ThinPlate(POINTS, smoothing).pitch_px
    # the same spline of the found points alone, in SciPy's units: K = r² ln r is twice ours
    fit = RBFInterpolator(POINTS[found] / pitch, DISPLACEMENT[found], smoothing=smoothing, kernel="thin_plate_spline")
    np.testing.assert_allclose(filled[~found], fit(POINTS[~found] / pitch), atol=2e-3)
    np.testing.assert_array_equal(filled[found], DISPLACEMENT[found])


def test_contradicting_points_are_taken_out_and_no_others():
    field = (POINTS @ np.array([[0.05, -0.02], [0.01, 0.04]])).astype(np.float32)
    field[[4, 20]] += [6, -5]
    assert np.flatnonzero(ThinPlate(POINTS).inconsistent(field, EVERY, 2.0)).tolist() == [4, 20]


def test_too_few_points_contradict_nothing():
    """Noise in place of markers: of five one is taken out, of four none; fewer than three have no inverse energy."""
    square = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0], [4.0, 5.0]])
    for count in range(6):
        found = np.arange(5) < count
        assert ThinPlate(square, 1e-3).inconsistent(DISPLACEMENT[:5], found, 0.0).sum() == max(count - 4, 0)


def test_leave_one_out_is_that_of_a_fit_without_the_point():
    spline, lost = ThinPlate(POINTS), EVERY.copy()
    lost[9] = False
    field = np.zeros_like(DISPLACEMENT)
    field[9] = DISPLACEMENT[9] - spline.filled(DISPLACEMENT, lost)[9]
    error = np.hypot(*field[9])
    assert spline.inconsistent(field, EVERY, 0.99 * error)[9]
    assert not spline.inconsistent(field, EVERY, 1.01 * error)[9]


def test_dense_field_is_the_spline_at_every_pixel():
    spline = ThinPlate(POINTS)
    smooth = np.column_stack([np.sin(POINTS[:, 0] / 40), np.cos(POINTS[:, 1] / 50)]).astype(np.float32)
    dense = Densifier(spline, gels.SIDE)(smooth)
    y, x = np.mgrid[15:145:7, 15:185:9]
    exact = spline.matrix(np.column_stack([x.ravel(), y.ravel()])) @ smooth
    assert dense.shape == (*gels.SIDE, 2)
    np.testing.assert_allclose(dense[y.ravel(), x.ravel()], exact, atol=5e-3)


def test_points_on_a_line_are_refused():
    refused(ValueError, "not on a line", lambda: ThinPlate(np.column_stack([np.arange(9), 2 * np.arange(9)])))
    refused(ValueError, "needs four", lambda: ThinPlate(POINTS).filled(DISPLACEMENT, np.arange(len(POINTS)) < 3))


def test_a_lattice_shifted_in_part_is_torn_at_the_border():
    points = gels.lattice()
    shifted = np.zeros_like(points)
    shifted[points[:, 0] > 100] = [20, 0]  # one pitch: a dot taken for the next
    neighbours = Neighbours(points)
    every = np.ones(len(points), bool)
    pieces = neighbours.pieces(shifted, every, 0.5)
    assert neighbours.torn(shifted, every, 0.5)
    assert not neighbours.torn(0.3 * shifted, every, 0.5)
    assert [p.sum() for p in pieces] == sorted((np.sum(points[:, 0] <= 100), np.sum(points[:, 0] > 100)), reverse=True)
