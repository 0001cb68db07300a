"""Window order and groups against counting, and hand values."""

import itertools

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.qwen.geometry import Grid, geometry, group, patch_places

CONFIG = QwenVisionConfig(out_size=8, hidden_size=16, num_heads=2, patch_px=2, merge=2, window_px=8)
SIDE = 4  # patches along a window

grids = st.lists(
    st.builds(Grid, st.integers(1, 3), *[st.integers(1, 6).map(lambda x: 2 * x)] * 2), min_size=1, max_size=3
).map(tuple)


def test_patch_places_by_hand():
    """Two rows of three squares."""
    place = patch_places(Grid(1, 2, 6), 2)
    np.testing.assert_array_equal(place[0], [0, 0, 1, 1] * 3)
    np.testing.assert_array_equal(place[1], [0, 1, 0, 1, 2, 3, 2, 3, 4, 5, 4, 5])


def test_window_order_by_hand():
    """One frame of 2 × 3 tokens under windows of 2 × 2 tokens: the third column is a window of its own."""
    place = geometry((Grid(1, 4, 6),), CONFIG)
    tokens = place.order.reshape(-1, 4)[:, 0] // 4
    np.testing.assert_array_equal(tokens, [0, 1, 3, 4, 2, 5])
    np.testing.assert_array_equal(place.windows.length, [16, 8])
    np.testing.assert_array_equal(place.frames.length, [24])


@given(grids)
@settings(max_examples=40)
def test_groups_are_those_of_a_count(many):
    """Patches share a window exactly where picture, frame, row // 4 and column // 4 agree, and a frame likewise."""
    place = geometry(many, CONFIG)
    frame = [np.repeat(np.arange(g.steps), g.rows * g.columns) + 100 * i for i, g in enumerate(many)]
    frame = np.concatenate(frame)[place.order]
    window = list(zip(frame, place.row // SIDE, place.column // SIDE, strict=True))
    for groups, key in ((place.windows, window), (place.frames, list(frame))):
        runs = [len(list(run)) for _, run in itertools.groupby(key)]
        assert len(runs) == len(set(key))  # every window in one piece
        np.testing.assert_array_equal(groups.length, runs)
    np.testing.assert_array_equal(np.sort(place.order), np.arange(sum(g.patches for g in many)))
    tokens = place.order.reshape(-1, 4)[:, 0] // 4
    np.testing.assert_array_equal(tokens[place.token_order], np.arange(len(tokens)))


@given(st.lists(st.integers(1, 7), min_size=1, max_size=6))
def test_grouping_and_back_is_nothing(sizes):
    groups, x = group(sizes), np.arange(sum(sizes))
    np.testing.assert_array_equal(x[groups.patch].ravel()[groups.back], x)
    assert groups.even == (len(set(sizes)) == 1)


@pytest.mark.parametrize("grid", [Grid(1, 3, 4), Grid(1, 4, 3), Grid(0, 4, 4)])
def test_grids_hold_whole_tokens(grid):
    with pytest.raises(ValueError, match=r"multiples of merge = 2; resize the picture to multiples of 4 px"):
        geometry((grid,), CONFIG)


def test_no_grid_is_refused():
    with pytest.raises(ValueError, match="grids is empty"):
        geometry((), CONFIG)
