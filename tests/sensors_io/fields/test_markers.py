"""Dots are found where they were drawn, and judged."""

import numpy as np
import pytest

from sensors_io.fields.evidence import Pattern, examine, texture_of
from sensors_io.fields.markers import find_markers, inside
from tests.sensors_io.fields import gels


@pytest.mark.parametrize("radius", [2.5, 4.0, 6.0])
@pytest.mark.parametrize("missing", [[], [3, 11, 12, 20]])
def test_every_dot_is_found_to_a_tenth_of_a_pixel(radius, missing):
    points = np.delete(gels.lattice(24), missing, axis=0)
    found = find_markers(gels.exposed(gels.dots(points, radius)))
    apart = np.hypot(*(points[:, None] - found.points_px[None]).transpose(2, 0, 1))
    assert len(found) == len(points)
    assert apart.min(1).max() < 0.15
    assert found.pitch_px == pytest.approx(24, abs=0.2)
    assert found.radius_px == pytest.approx(radius, rel=0.35)


def test_scatter_is_the_quartile_range_of_the_gaps_over_their_median():
    """Three pairs of dots each 20, 25 and 30 pixels apart, in nine of the sixteen parts of the picture or more."""
    at = np.array([[x, y] for y in (40, 120, 200) for x in (40, 120, 200)], float)
    gap = np.repeat([20.0, 25.0, 30.0], 3)
    points = np.concatenate([at, at + np.column_stack([gap, np.zeros(9)])])
    found = find_markers(gels.dots(points, 3.0, shape=(240, 260)))
    assert len(found) == 18
    assert (found.pitch_px, found.scatter) == (pytest.approx(25, abs=0.2), pytest.approx(0.4, abs=0.02))
    assert found.spread == len({(4 * x // 260, 4 * y // 240) for x, y in points}) / 16


def test_dots_that_touch_count_once():
    """The maxima of two, of 4 px radius and 7 px apart, lie within 2 σ of each other."""
    points = gels.lattice(24)
    touching = np.append(points, [points[10] + [7, 0]], 0)
    assert len(find_markers(gels.dots(touching))) == len(points)


def test_contrast_is_that_of_the_dots():
    assert find_markers(gels.dots(gels.lattice(24), 5.0, contrast=60.0)).contrast == pytest.approx(60, rel=0.15)


@pytest.mark.parametrize("picture", [np.full(gels.SIDE, 100, np.uint8), gels.dots(gels.lattice(48), 14.0)])
def test_nothing_is_found_on_a_flat_picture_nor_dots_of_a_sixth_of_it(picture):
    assert find_markers(picture) is None


def test_inside_leaves_a_margin():
    points = np.array([[0, 0], [5, 5], [194, 154], [195, 154]], np.float32)
    assert inside(points, gels.SIDE, 5).tolist() == [False, True, True, False]


LATTICE = gels.lattice()
GELS = {
    "dots": (gels.dots(LATTICE), Pattern.MARKERS),
    "faint dots": (gels.dots(LATTICE, contrast=8.0), Pattern.BARE),
    "few dots": (gels.dots(LATTICE[:5]), Pattern.BARE),
    "dots in a corner": (gels.dots(LATTICE[(LATTICE < 100).all(1)]), Pattern.BARE),
    "half": (gels.dots(LATTICE[LATTICE[:, 0] < 105]), Pattern.BARE),
    "skin": (gels.skin(), Pattern.BARE),
    "loaded": (gels.loaded(), Pattern.BARE),
    "85 %": (np.where(np.arange(200) < 170, gels.speckle(), 128), Pattern.DENSE),
    "70 %": (np.where(np.arange(200) < 140, gels.speckle(), 128), Pattern.BARE),
}


@pytest.mark.parametrize("name", GELS)
def test_gels_are_told_apart(name):
    """A dense pattern fills nine windows in ten."""
    picture, pattern = GELS[name]
    assert examine(gels.exposed(picture)).pattern is pattern


def test_texture_is_that_of_the_weaker_direction_and_scales_with_contrast():
    """Stripes have a gradient across them and none along."""
    stripes = np.broadcast_to(128 + 50 * np.sin(2 * np.pi * np.arange(gels.SIDE[1]) / 8), gels.SIDE)
    full, half = (texture_of((128 + share * (gels.speckle() - 128)).astype(np.float32)) for share in (1, 0.5))
    assert texture_of(stripes.astype(np.float32)) < 1e-3
    assert full == pytest.approx(2 * half, rel=1e-4)
    assert texture_of(gels.speckle().T.astype(np.float32)) == pytest.approx(full, rel=1e-3)
    assert full > 3
