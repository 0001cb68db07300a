"""Known motion, the errors that are measured under it, and their lower bound."""

import numpy as np
import pytest

from experiments.core.results import assemble
from experiments.fields.known_motion import NOISE_GREY, GelCamera, MarkerGel, gels, pressed
from experiments.fields.marker_drift import bound_px, drift_section


def test_known_motion_is_exact():
    """The picture at p + f(p) shows what lay at p; a camera without noise reproduces a gel at rest."""
    motion = pressed((120, 160), 6.0, np.random.default_rng(1))
    points = np.random.default_rng(2).uniform(20, 100, (50, 2))
    moved = points + motion.forward(points)
    np.testing.assert_allclose(moved - motion.backward(moved), points, atol=1e-9)
    y, x = np.mgrid[:120, :160].astype(float)
    smooth = np.stack([100 + 0.5 * x, 80 + 0.4 * y, 0 * x + 90], -1).round().astype(np.uint8)
    still = GelCamera(smooth, 0.0, 0)
    assert np.abs(still.under(motion.times(0.0), 0.0).astype(int) - smooth).max() == 0


def test_the_bound_of_a_window_is_that_of_its_gradient():
    """On g (|x − c| + |y − c|): Σ I_x² = Σ I_y² = g² 2h (2h + 1), Σ I_x I_y = 0; both pictures are noisy."""
    slope, half = 2, 8
    y, x = np.mgrid[:48, :320]
    grey = 40 + slope * (np.minimum(np.abs(x - 24), 20) + np.minimum(np.abs(y - 24), 20))
    picture, centre = np.repeat(grey[..., None], 3, -1).astype(np.uint8), np.array([[24.0, 24.0]])
    roof = MarkerGel(name="roof", picture=picture, real=False, points_px=centre, half_px=half, dot_radius_px=8.0)
    noise = (NOISE_GREY**2 + 1 / 12) * (0.299**2 + 0.587**2 + 0.114**2) + 1 / 12
    expected = np.sqrt(np.log(2) * 2 * 2 * noise / (slope**2 * 2 * half * (2 * half + 1)))
    assert bound_px(roof, light_and_strain=False) == pytest.approx(expected, rel=1e-3)
    assert bound_px(roof, light_and_strain=True) > expected


@pytest.mark.long
def test_points_anchored_to_the_picture_at_rest_do_not_drift():
    section = assemble(drift_section(gels(None, 1), cycles=(1, 10), pairs=3, period=6), {})
    assert section.requirements[1].met
    ours, alone, *_, frame_to_frame = section.tables[0].rows
    assert ours[2] < alone[2]
    assert frame_to_frame[2] - frame_to_frame[1] > 3 * abs(ours[2] - ours[1])
