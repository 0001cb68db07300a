"""Methods of depth against closed forms, and the optics that they are tried on."""

import numpy as np
import pytest

from experiments.fields.depth_accuracy import analytic_surfaces, scale_error
from experiments.fields.depth_methods import INTEGRATORS, MAPS
from experiments.fields.stressed_readings import depth_outcome
from sensors_io.calibration.circles import find_circles
from sensors_io.calibration.generated_presses import AXIS_MM, fitted_optics, generated_presses, near_lamps
from sensors_io.calibration.published import known_truth
from sensors_io.schema import Flag


def test_published_integrators_get_the_scale_wrong():
    """The eigenvalues' index alone makes an error of tens of per cent."""
    worst = {
        name: max(abs(scale_error(integrate, *surface)[0]) for surface in analytic_surfaces().values())
        for name, integrate in INTEGRATORS.items()
    }
    assert worst["this, Neumann"] < 2
    assert worst["as gs_sdk and gsrobotics"] > 20


class BallCap:
    """A sphere's cap of 3.155 mm radius, flat outside: profiles that need no solving."""

    def field(self, touch, x, y):
        square = np.minimum((x - touch[0]) ** 2 + (y - touch[1]) ** 2, touch[2] ** 2)
        height = np.sqrt(3.155**2 - square)
        inside = square < touch[2] ** 2
        slopes = [np.where(inside, -(c - at) / height, 0.0) for c, at in ((x, touch[0]), (y, touch[1]))]
        return height - np.sqrt(3.155**2 - touch[2] ** 2), *slopes


def test_near_lamps_are_no_polynomial_of_the_normal():
    """The assumed optics change by a linear function of (n, n², u); lamps next to the window leave a remainder."""
    profiles, touch = BallCap(), np.array([1.0, -2.0, 1.6])
    depth, d_x, d_y = profiles.field(touch, AXIS_MM[None, :], AXIS_MM[:, None])
    inside = depth > 0.02
    up = 1 / np.sqrt(1 + d_x**2 + d_y**2)
    n_x, n_y = (d_x * up)[inside], (d_y * up)[inside]
    features = np.stack([np.ones_like(n_x), n_x, n_y, n_x**2, n_x * n_y, n_y**2, depth[inside]], -1)
    left = {}
    for optics in (fitted_optics, near_lamps):
        change = (optics(profiles, touch, AXIS_MM) - optics(profiles, None, AXIS_MM))[inside]
        rest = change - features @ np.linalg.lstsq(features, change, rcond=None)[0]
        left[optics.__name__] = float(rest.std() / change.std())
    assert left["near_lamps"] > 2 * left["fitted_optics"]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name == "polynomial, varying" else pytest.mark.slow)
        for name in MAPS
    ],
)
def test_every_map_reads_a_press(name):
    presses = generated_presses(6.31, 8, 0)
    touches = find_circles(presses).touches
    slope_x, _ = MAPS[name](presses, touches, 0)(presses.pictures[0])
    x, y, radius = touches.stacked()[0]
    rows, columns = np.mgrid[: presses.shape[0], : presses.shape[1]]
    inner = np.hypot(columns - x, rows - y) < 0.8 * radius
    expected = (x - columns[inner]) * presses.mm_per_px / presses.radius_mm
    assert np.corrcoef(slope_x[inner], expected)[0, 1] > 0.9


def test_truth_at_known_depth_is_the_indenter():
    depth, mask = known_truth("sphere", 0.5, (320, 320))
    assert depth.max() == pytest.approx(0.5, abs=1e-3)
    assert depth[mask].min() > 0.1
    flat, inside = known_truth("prism", 0.25, (320, 320))
    assert np.unique(flat).tolist() == [0.25]
    assert inside.sum() == 71 * 107


def test_depth_is_wrong_from_a_fifth_of_the_press():
    truth, inside = np.array([[0.0, 1.0]]), np.array([[False, True]])
    near, far = (depth_outcome(truth - off, Flag.NONE, truth, inside) for off in (0.19, 0.21))
    assert (near.broken, far.broken) == (False, True)
