"""The gel at rest, the frames in contact, and their description."""

import dataclasses

import numpy as np
import pytest

from sensors_io.importers.video import VideoError
from sensors_io.touches import PROBE_PX, SIZE_PX, describe, families, find_touch, touch_of_scene
from tests.experiments.recordings.presses import press


@pytest.fixture(scope="module")
def touch():
    return find_touch(press(), 4)


def test_the_frames_in_contact_are_those_of_the_press(touch):
    assert touch.frames.shape == (4, *SIZE_PX, 3)
    assert touch.change.shape == (12, *PROBE_PX)
    assert (np.diff(touch.position) >= 0).all()
    assert touch.change.mean((1, 2)).argmax() in touch.position
    assert touch.position.min() >= 3
    assert touch.position.max() <= 8
    np.testing.assert_allclose(touch.rest, 100, atol=1)


def test_a_short_video_repeats_frames_and_a_shorter_one_is_refused():
    assert find_touch(press(4), 8).frames.shape[0] == 8
    with pytest.raises(VideoError, match="holds 2 frames"):
        find_touch(press(4)[:2], 8)


def test_a_scene_leaves_out_its_first_and_its_last_frame():
    frames = press(8)
    touch = touch_of_scene(frames)
    assert touch.position.tolist() == [3, 4, 5, 6]
    np.testing.assert_allclose(touch.rest.mean(), frames[0].mean(), atol=0.1)


def test_each_number_has_a_family_and_is_finite(touch):
    x = describe(touch)
    assert x.shape == (len(families()),)
    assert set(families()) == {"spread", "patches", "edges", "contact", "course"}
    assert np.isfinite(x).all()


def test_energies_grow_with_the_press_and_texture_with_roughness(touch):
    family, octaves = np.array(families()), slice(0, 3)
    strong = describe(find_touch(press(depth=80.0), 4))
    rough = describe(find_touch(press(texture=0.5), 4))
    spread = lambda x: x[family == "spread"]
    assert (spread(strong)[:15] > spread(describe(touch))[:15]).sum() >= 12
    assert (spread(rough)[octaves] > spread(describe(touch))[octaves] + 0.5).all()


def test_twice_the_change_shifts_the_energies_by_log_2(touch):
    coarse = np.flatnonzero(np.array(families()) == "spread")[12:18]  # far above the floor
    one = dataclasses.replace(touch, frames=touch.frames[1:2])
    double = dataclasses.replace(one, rest=2 * one.rest - one.frames[0])
    np.testing.assert_allclose(describe(double)[coarse] - describe(one)[coarse], np.log(2), atol=0.1)


def test_an_untouched_gel_is_described_by_the_floor():
    still = np.full((6, 120, 160, 3), 90, np.uint8)
    x = describe(find_touch(still, 3))
    np.testing.assert_allclose(x[np.array(families()) == "spread"], np.log(0.05), atol=1e-4)
