"""The gel at rest, the frames in contact, and their description."""

import numpy as np
import pytest

from sensors_io.touches import PROBE_PX, SIZE_PX, describe, families, find_touch, touch_of_scene
from tests.experiments.recordings.presses import press


@pytest.fixture(scope="module")
def touch():
    return find_touch(press(), 4)


def test_the_frames_in_contact_are_those_of_the_press(touch):
    assert (touch.frames.shape, touch.change.shape) == ((4, *SIZE_PX, 3), (12, *PROBE_PX))
    assert (np.diff(touch.position) >= 0).all()
    assert touch.change.mean((1, 2)).argmax() in touch.position
    assert 3 <= touch.position.min() <= touch.position.max() <= 8
    np.testing.assert_allclose(touch.rest, 100, atol=1)


def test_the_gel_at_rest_is_that_before_anything_slides_over_it():
    """The first half second, though the gel is as quiet afterwards and half a grey level brighter."""
    frames = press(90)
    frames[-15:] += (np.indices(frames.shape[1:]).sum(0) % 2).astype(np.uint8)
    np.testing.assert_allclose(find_touch(frames, 4).rest.mean(), frames[0].mean(), atol=0.02)


def test_a_scene_leaves_out_its_first_and_its_last_frame():
    frames = press(8)
    frames[-1] += 1
    touch = touch_of_scene(frames)
    assert touch.position.tolist() == [3, 4, 5, 6]
    np.testing.assert_allclose(touch.rest.mean(), frames[0].mean(), atol=0.1)


def test_energies_grow_with_the_press_and_texture_with_roughness(touch):
    family, octaves = np.array(families()), slice(0, 3)
    strong = describe(find_touch(press(depth=80.0), 4))
    rough = describe(find_touch(press(texture=0.5), 4))
    spread = lambda x: x[family == "spread"]
    assert (spread(strong)[:15] > spread(describe(touch))[:15]).sum() >= 12
    assert (spread(rough)[octaves] > spread(describe(touch))[octaves] + 0.5).all()
