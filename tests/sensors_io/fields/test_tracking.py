"""Dots are followed through known motion; what cannot be followed is flagged."""

import numpy as np
import pytest

from sensors_io.fields.deformation import DeformationReader, NoPatternError
from sensors_io.fields.neighbours import Neighbours
from sensors_io.fields.patches import Patches
from sensors_io.fields.tracking import Tracker, TrackingConfig
from sensors_io.schema import Flag
from tests.sensors_io.checks import refused
from tests.sensors_io.fields import gels

POINTS = gels.lattice()
REST = gels.exposed(gels.dots(POINTS))
INNER = (POINTS > 12).all(1) & (POINTS[:, 0] < 188) & (POINTS[:, 1] < 148)


def moved(points, peak):
    """A contact that shears and spreads the gel."""
    away = (points - [95, 75]) / 45
    bell = np.exp(-(away**2).sum(1) / 2)[:, None]
    return points + peak * bell * (np.array([0.8, -0.4]) + 0.3 * away)


def follow(peak, tracker, seed=1):
    return tracker.track(gels.exposed(gels.dots(moved(POINTS, peak)), seed=seed))


@pytest.fixture
def tracker():
    return Tracker(REST, POINTS[INNER], 7)


@pytest.mark.parametrize("peak", [0.0, 0.3, 3.0, 7.0])
def test_points_are_found_to_a_tenth_of_a_pixel(tracker, peak):
    found = follow(peak, tracker)
    error = np.hypot(*(found.points_px - moved(POINTS, peak)[INNER]).T)
    assert found.found.all()
    assert np.median(error) < 0.05
    assert error.max() < 0.25


@pytest.mark.parametrize("peak", [18.0, 24.0])
def test_a_jump_past_half_a_pitch_is_caught(tracker, peak):
    """Half a pitch is 10 px: from rest, Lucas–Kanade takes some dots for their neighbours."""
    found = follow(peak, tracker)
    assert found.reseeded
    assert found.found.all()
    assert np.hypot(*(found.points_px - moved(POINTS, peak)[INNER]).T).max() < 1


def test_a_lattice_is_followed_though_a_start_a_pitch_away_explains_more_dots(tracker):
    """Five dots of the last column are gone: 58 of 63 are where the motion leads, 63 a pitch to the left of it."""
    gone = np.flatnonzero(INNER & (POINTS[:, 0] > 170))[:5]
    left = np.delete(POINTS, gone, axis=0)
    for shift_px in (9, 18):
        found = tracker.track(gels.exposed(gels.dots(left + np.array([shift_px, 0])), seed=2))
    assert (found.reseeded, found.found.sum()) == (True, 58)
    np.testing.assert_allclose(np.median(found.points_px - POINTS[INNER], 0), [18, 0], atol=0.05)


def test_the_border_of_a_set_of_points_is_outside_it():
    line = Neighbours(np.column_stack([np.arange(5.0), np.zeros(5)]))
    assert line.adjacent(np.array([False, True, True, False, False])).tolist() == [True, False, False, True, False]


def test_lost_dots_are_flagged_placed_and_found_again(tracker):
    gone, peak = np.flatnonzero(INNER)[[10, 11, 25]], 4.0
    found = tracker.track(gels.exposed(gels.dots(np.delete(moved(POINTS, peak), gone, axis=0)), seed=2))
    lost = np.isin(np.flatnonzero(INNER), gone)
    error = np.hypot(*(found.points_px - moved(POINTS, peak)[INNER]).T)
    assert np.array_equal(~found.found, lost)
    assert error[lost].max() < 1.0
    assert follow(peak, tracker).found.all()


@pytest.mark.parametrize(("px", "believed"), [(3.0, True), (5.0, False)])
def test_a_dot_that_moves_alone_by_a_fifth_of_a_pitch_is_not_believed(tracker, px, believed):
    points, alone = POINTS.copy(), np.flatnonzero(INNER)[25]
    points[alone, 0] += px
    found = tracker.track(gels.exposed(gels.dots(points), seed=2)).found
    assert (bool(found[25]), found.sum()) == (believed, len(found) - (not believed))


def test_the_spread_follows_the_noise_as_documented():
    """√(1/ρ² − 1) times what the window itself allows, which is once to three times the error."""
    patches, rest = Patches(REST, POINTS[INNER], 7), gels.dots(POINTS)
    per_noise = []
    for level in (3.0, 20.0):
        found = patches.find(gels.exposed(rest, noise=level, seed=1), POINTS[INNER])
        per_noise.append(found.spread_px / np.sqrt(1 / found.likeness.astype(float) ** 2 - 1))
    np.testing.assert_allclose(*per_noise, rtol=0.02)
    error = np.hypot(*(found.points_px - POINTS[INNER]).T)
    assert 1 < np.sqrt(np.mean(found.spread_px**2) / np.mean(error**2)) < 3


def test_a_picture_turned_over_gives_the_points_turned_over():
    start, picture = POINTS[INNER], gels.exposed(gels.dots(moved(POINTS, 1.0)), noise=20.0, seed=1)
    turned = Patches(np.ascontiguousarray(REST.T), start[:, ::-1], 7)
    found, other = (
        Patches(REST, start, 7).find(picture, start),
        turned.find(np.ascontiguousarray(picture.T), start[:, ::-1]),
    )
    np.testing.assert_allclose(found.points_px, other.points_px[:, ::-1], atol=1e-3)


def test_wrong_pictures_are_refused(tracker):
    refused(ValueError, r"must be uint8\[160, 200\]", tracker.track, REST[:-1])
    refused(ValueError, "must lie inside the picture", lambda: Patches(REST, np.array([[3.0, 50.0]]), 7))
    refused(ValueError, "must lie inside the picture", lambda: Patches(REST, np.array([[150.0, 153.0]]), 7))
    corner = Patches(REST, np.array([[192.0, 152.0]]), 7)  # the last window inside
    assert corner.find(np.zeros_like(REST), np.array([[192.0, 152.0]])).likeness.tolist() == [0.0]
    refused(ValueError, "back_px is 0", TrackingConfig, back_px=0)


def test_light_does_not_move_the_points(tracker):
    """Gain, offset and a slope of brightness are fitted with the motion; Lucas–Kanade alone follows the light."""
    plain = Tracker(REST, POINTS[INNER], 7, TrackingConfig(affine=False))
    picture = gels.exposed(0.7 * gels.dots(POINTS) + 0.3 * np.arange(200))
    errors = [np.hypot(*(t.track(picture).points_px - POINTS[INNER]).T) for t in (tracker, plain)]
    assert errors[0].max() < 0.08
    assert errors[0].mean() < 0.7 * errors[1].mean()


def test_a_dot_at_the_border_is_not_followed():
    """Windows of 17 px are kept a pixel inside: a dot at 8.4 px is left out, the next one at 28.4 px is not."""
    reader = DeformationReader(gels.rgb(gels.exposed(gels.dots(POINTS - [6.9, 0]))), mm_per_px=0.1)
    assert (reader.tracker.half_px, round(float(reader.tracker.points_px[:, 0].min()))) == (8, 28)


def test_every_pixel_when_no_shape_is_given_else_means_of_cells():
    every, coarse = (DeformationReader(gels.rgb(REST), mm_per_px=0.1, shape=shape) for shape in (None, (16, 20)))
    picture = gels.rgb(gels.exposed(gels.dots(moved(POINTS, 5.0))))
    read = every.read(picture)
    found = read.displacement_mm
    pixels = np.stack(np.meshgrid(np.arange(40, 160), np.arange(30, 130)), -1).reshape(-1, 2).astype(float)
    true = 0.1 * (moved(pixels, 5.0) - pixels)
    assert (found.shape, read.flags, bool(read.valid.all())) == ((160, 200, 2), Flag.NONE, True)
    assert np.hypot(*(found[30:130, 40:160].reshape(-1, 2) - true).T).mean() < 0.008
    cells = found.reshape(16, 10, 20, 10, 2).mean((1, 3))
    np.testing.assert_allclose(coarse.read(picture).displacement_mm, cells, atol=0.005)


def test_lost_markers_flag_the_frame_and_their_nodes():
    reader = DeformationReader(gels.rgb(REST), mm_per_px=0.1, shape=(16, 20))
    left = gels.exposed(gels.dots(POINTS[POINTS[:, 0] < 100]))
    read = reader.read(gels.rgb(left))
    assert read.flags == Flag.MARKER_LOSS
    assert read.valid[:, :8].all()
    assert not read.valid[:, 15:].any()


def test_a_dense_pattern_is_read_too():
    rest = gels.speckle()
    reader = DeformationReader(gels.rgb(gels.exposed(rest)), mm_per_px=0.1, shape=(16, 20))
    x, y = (np.unique(side) for side in reader.tracker.points_px.T)  # windows of 17 px, 12 px apart, a pixel inside
    np.testing.assert_allclose([*x[[0, -1]], *y[[0, -1]], len(x), len(y)], [9, 190, 9, 150, 16, 13])
    read = reader.read(gels.rgb(gels.exposed(np.roll(rest, (3, -2), (0, 1)), seed=1)))
    inner = read.displacement_mm[2:-2, 2:-2]
    np.testing.assert_allclose(inner, np.broadcast_to([-0.2, 0.3], inner.shape), atol=0.01)


@pytest.mark.parametrize("rest", [gels.skin(), gels.loaded()], ids=["at rest", "under a load"])
def test_a_bare_gel_is_refused(rest):
    with pytest.raises(NoPatternError, match="neither dots nor a dense pattern"):
        DeformationReader(gels.rgb(gels.exposed(rest)), mm_per_px=0.1)
