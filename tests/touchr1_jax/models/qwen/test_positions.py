"""Position ids by hand; the reference's own are in `test_parity`."""

import numpy as np
import pytest

from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.positions import picture, position_ids, tactile, video


def test_text_counts():
    np.testing.assert_array_equal(position_ids([2, 3]), [list(range(5))] * 3)
    assert position_ids([]).shape == (3, 0)


def test_picture_between_words_by_hand():
    """2 × 3 tokens at 2: the next word stands after the largest id, 4."""
    ids = position_ids([2, picture(Grid(1, 4, 6), 2), 1])
    np.testing.assert_array_equal(ids[0], [0, 1, *[2] * 6, 5])
    np.testing.assert_array_equal(ids[1], [0, 1, 2, 2, 2, 3, 3, 3, 5])
    np.testing.assert_array_equal(ids[2], [0, 1, 2, 3, 4, 2, 3, 4, 5])


def test_long_video_pushes_the_text_behind_its_last_step():
    """Steps of one second at two ids a second, one token each: 0, 2, 4, then the text at 5."""
    ids = position_ids([1, video(Grid(3, 2, 2), 2, 1.0, 2), 1])
    np.testing.assert_array_equal(ids[0], [0, 1, 3, 5, 6])
    np.testing.assert_array_equal(ids[1:], [[0, 1, 1, 1, 6]] * 2)


@pytest.mark.parametrize(
    ("fps", "times"),
    [(1.0, [0, 4, 8, 12]), (4.0, [0, 1, 2, 3]), (8.0, [0, 0, 1, 1]), (120.0, [0, 0, 0, 0])],
)
def test_the_product_is_rounded_down_and_fast_video_stands_still(fps, times):
    """Two frames a step; at 4 frames a second, seconds cast to an integer alone would give 0 for all."""
    np.testing.assert_array_equal(video(Grid(4, 2, 2), 2, 2 / fps, 2).times, times)


def test_touch_never_stands_still():
    """Frame indices of a 120 Hz stream; a second stream starts behind the first, frames keep their distance."""
    ids = position_ids([1, tactile(np.array([0, 1, 6]), 2), 1, tactile(np.array([2, 7]), 2)])
    np.testing.assert_array_equal(ids[0], [0, 1, 1, 2, 2, 7, 7, 8, 11, 11, 16, 16])
    np.testing.assert_array_equal(ids[1], [0, *[1] * 6, 8, *[9] * 4])
    np.testing.assert_array_equal(ids[2], [0, 1, 2, 1, 2, 1, 2, 8, 9, 10, 9, 10])


@pytest.mark.parametrize("index", [[0, 0], [3, 2], [-1, 0]])
def test_frames_must_rise(index):
    with pytest.raises(ValueError, match=r"frame_index is .*: must rise"):
        tactile(np.array(index), 2)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan")])
def test_time_must_pass(seconds):
    with pytest.raises(ValueError, match=r"seconds_per_step is .*: must be positive"):
        video(Grid(2, 2, 2), 2, seconds, 2)
