"""Random changes: the group of the square by hand and by its laws, exposure, dropout."""

import dataclasses
import itertools
import types

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from sensors_io.augment import AugmentConfig, Symmetry, apply_symmetry, draw_kept, draw_symmetry, jitter_exposure
from sensors_io.schema import SchemaError
from tests.sensors_io.checks import refused
from tests.sensors_io.fakes import sequence

ELEMENTS = [Symmetry(mirrored=m, quarters=q) for m, q in itertools.product((False, True), range(4))]
MIRROR, TURN = Symmetry(mirrored=True), Symmetry(quarters=1)


def pushed(rows=5, columns=6):
    """One frame, pressed and dragged in the upper left corner, with the moment of its force about the centre."""
    vectors = np.zeros((1, rows, columns, 2), np.float32)
    vectors[0, 0, 0] = (0.5, 0.25)
    depth = np.zeros((1, rows, columns), np.float32)
    depth[0, 0, 0] = 1.0
    corner = np.array([-(columns - 1) / 2, -(rows - 1) / 2, 0])
    force = np.array([1.0, 0.5, -4.0])
    moment = np.cross(corner, force)[None].astype(np.float32)
    fields = {"deformation_mm": vectors, "shear_mm": 2 * vectors, "depth_mm": depth, "valid": depth > 0}
    loads = {"force_n": force[None].astype(np.float32), "moment_nmm": moment}
    frames = np.repeat((255 * depth).astype(np.uint8)[..., None], 3, -1)
    return sequence(length=1, calibration="abc", frames=frames, **fields, **loads)


def where(image):
    """Row and column of the pressed pixel."""
    size = np.abs(image[0]).reshape(*image.shape[1:3], -1).sum(-1)
    return tuple(map(int, np.unravel_index(size.argmax(), size.shape)))


@pytest.mark.parametrize(
    ("element", "place", "vector", "force"),
    [
        (MIRROR, (0, 5), (-0.5, 0.25), (-1, 0.5, -4)),
        (TURN, (0, 4), (-0.25, 0.5), (-0.5, 1, -4)),  # clockwise: upper left to upper right, x to y
        (Symmetry(quarters=2), (4, 5), (-0.5, -0.25), (-1, -0.5, -4)),
        (Symmetry(quarters=3), (5, 0), (0.25, -0.5), (0.5, -1, -4)),
        (Symmetry(mirrored=True, quarters=1), (5, 4), (-0.25, -0.5), (-0.5, -1, -4)),
    ],
)
def test_a_push_lands_where_it_must_and_drags_where_it_must(element, place, vector, force):
    after = apply_symmetry(pushed(), element)
    for image in (after.frames, after.depth_mm[..., None], after.valid[..., None].astype(float), after.deformation_mm):
        assert where(image) == place
    np.testing.assert_allclose(after.deformation_mm[0][place], vector)
    np.testing.assert_allclose(after.shear_mm[0][place], 2 * np.array(vector))
    np.testing.assert_allclose(after.force_n[0], force)


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_moment_stays_that_of_the_force_at_its_place(element):
    """r × F of the moved place and the changed force: an axial vector."""
    after = apply_symmetry(pushed(), element)
    row, column = where(after.frames)
    rows, columns = after.frames.shape[1:3]
    place = np.array([column - (columns - 1) / 2, row - (rows - 1) / 2, 0])
    np.testing.assert_allclose(after.moment_nmm[0], np.cross(place, after.force_n[0]), atol=1e-5)


@pytest.mark.parametrize(("first", "second"), [*itertools.product(ELEMENTS, (MIRROR, TURN))])
def test_a_change_behind_another_is_one_of_the_group(first, second):
    """The action is the product of the matrices; mirror and turn generate the group."""
    twice = apply_symmetry(apply_symmetry(pushed(5, 5), first), second)
    product = second.matrix @ first.matrix
    (same,) = [element for element in ELEMENTS if np.array_equal(element.matrix, product)]
    once = apply_symmetry(pushed(5, 5), same)
    for name in ("frames", "depth_mm", "valid", "deformation_mm", "shear_mm", "force_n", "moment_nmm"):
        np.testing.assert_allclose(getattr(twice, name), getattr(once, name), atol=1e-6)


def test_a_changed_picture_has_no_calibration_and_the_identity_changes_nothing():
    made = pushed()
    assert apply_symmetry(made, Symmetry()) is made
    assert apply_symmetry(made, MIRROR).calibration == ""
    bare = sequence(length=1, frames=made.frames, deformation_mm=None, depth_mm=None, valid=None, force_n=None)
    assert where(apply_symmetry(bare, MIRROR).frames) == (0, 5)


def test_elements_are_drawn_as_often_as_is_asked():
    rng = np.random.default_rng(0)
    drawn = [draw_symmetry(AugmentConfig(mirror=0.5, turn=0.75), rng) for _ in range(4000)]
    for element in ELEMENTS:
        assert drawn.count(element) / 4000 == pytest.approx(1 / 8, abs=0.02)
    assert {draw_symmetry(AugmentConfig(), rng) for _ in range(50)} == {Symmetry()}


def test_a_stop_doubles_and_white_stays_white():
    highest = types.SimpleNamespace(uniform=lambda low, high, size=None: np.full(size or (), high))
    image = np.array([10, 100, 200, 0], np.uint8)[None, None, :, None].repeat(3, -1)
    assert jitter_exposure(image, AugmentConfig(), highest) is image
    brighter = jitter_exposure(image, AugmentConfig(exposure_stops=1), highest)
    np.testing.assert_array_equal(brighter[0, 0, :, 0], [20, 200, 255, 0])


@hypothesis.given(
    st.lists(st.lists(st.booleans(), min_size=5, max_size=5), min_size=1), st.floats(0, 1), st.integers(0, 99)
)
def test_some_of_the_present_frames_stay_and_the_first_one_always(present, share, seed):
    present = np.array(present)
    kept = draw_kept(present, AugmentConfig(frame_dropout=share), np.random.default_rng(seed))
    assert not (kept & ~present).any()
    rows = np.flatnonzero(present.any(1))
    assert kept[rows, present[rows].argmax(1)].all()  # what the change of all others is measured against


@pytest.mark.parametrize(("share", "kept", "error"), [(0.3, 0.7, 0.02), (1, 1 / 5000, 0)])
def test_the_share_is_dropped_but_for_one_frame(share, kept, error):
    found = draw_kept(np.ones((4, 5000), bool), AugmentConfig(frame_dropout=share), np.random.default_rng(0))
    assert found.mean() == pytest.approx(kept, abs=error)


def test_bad_options_are_named():
    refused(SchemaError, "mirror is 1.5: must lie in 0..1; it is a probability", AugmentConfig, mirror=1.5)
    refused(SchemaError, "frame_dropout is -1", AugmentConfig, frame_dropout=-1)
    refused(SchemaError, "exposure_stops is 9: must lie in 0..4 stops; lower it", AugmentConfig, exposure_stops=9)
    assert (AugmentConfig(mirror=1.0).mirror, AugmentConfig(exposure_stops=4).exposure_stops) == (1, 4)


def test_off_by_default():
    assert not AugmentConfig().active
    for field in dataclasses.fields(AugmentConfig):
        assert AugmentConfig(**{field.name: 0.5}).active
