"""The gallery, shrunk: every sheet is drawn, and what it shows is what was asked for."""

import numpy as np
import pytest

from experiments.scenes import scene_gallery
from sensors_io.scenes import objects


def test_arrows_point_along_the_displacement() -> None:
    still = np.zeros((4, 4))
    moved = np.zeros((4, 4, 2))
    moved[2, 1] = (0.5, 0.0)  # two cells to the right
    picture = scene_gallery.field_picture(still, moved, 1.0)  # 80 px a node
    assert picture[200, 130:270].min() > 200
    assert picture[200, 300].max() < 100


def test_letters_of_a_uniform_object_are_all_the_same() -> None:
    solid = objects.sample(np.random.default_rng(0), 0.0, 0.8)
    blank = np.zeros((120, 120, 3), np.uint8)
    marked = scene_gallery.mark_levels(blank, solid)[..., 0]
    corner, centre = marked[8:32, 10:34], marked[48:72, 50:74]
    assert corner.max() > 100
    assert marked.sum() == pytest.approx(9 * centre.sum(), rel=0.01)
