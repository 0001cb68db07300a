"""Which frames and patches are read."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.touchr1_jax import tiny
from touchr1_jax.models.salience import busiest_patches, fewer_frames, patch_change, rest_mean, salient_frames

pytestmark = pytest.mark.long


def test_change_is_told_by_patch():
    """Patch (row 1, column 2) of 8 px brightens by 10 in frame 1: nothing else changes."""
    frames = np.full((3, 16, 24, 3), 100, np.uint8)
    frames[1, 8:, 16:] += 10
    expected = np.zeros((3, 6))
    expected[1, 5] = 10
    np.testing.assert_allclose(patch_change(jnp.asarray(frames), 8), expected, atol=1e-6)


def test_patches_must_divide():
    with pytest.raises(ValueError, match="16×20 px must divide into patches of 8 px; resize them"):
        patch_change(jnp.zeros((2, 16, 20, 3)), 8)


def test_the_busiest_patches_are_those_of_the_frames_that_exist():
    change = jnp.array([[0.0, 0, 0, 0], [1, 5, 2, 0], [9, 0, 0, 8]])
    every, two = jnp.array([True, True, True]), jnp.array([True, True, False])
    np.testing.assert_array_equal(busiest_patches(change, every, 2), [0, 3])
    np.testing.assert_array_equal(busiest_patches(change, two, 2), [1, 2])
    np.testing.assert_array_equal(busiest_patches(change, jnp.zeros(3, bool), 2), [0, 1])


def test_the_rest_becomes_its_mean():
    x = jnp.arange(8.0).reshape(4, 2)
    np.testing.assert_allclose(rest_mean(x, jnp.array([1])), [[2, 3], [10 / 3, 13 / 3]], rtol=1e-6)
    np.testing.assert_array_equal(rest_mean(x, jnp.arange(4)), x)
    batched = rest_mean(jnp.stack([x, -x]), jnp.array([[1], [0]]))
    np.testing.assert_allclose(batched[1], [[0, -1], [-4, -5]], rtol=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0, 9), min_size=6, max_size=6), st.integers(3, 6), st.integers(1, 3))
def test_chosen_frames_lie_nearest_to_the_levels(change, exist, count):
    """Against all choices, one by one, in float64."""
    mask = np.arange(6) < exist
    chosen = np.asarray(salient_frames(jnp.asarray(change, jnp.float32), jnp.asarray(mask), count))
    total = np.cumsum(np.where(mask, change, 0.0))
    level = np.linspace(total[0], total[-1], count)
    cost = lambda rows: np.abs(total[list(rows)] - level).sum()
    assert mask[chosen].all()
    assert (np.diff(chosen) > 0).all()
    best = min(cost(rows) for rows in itertools.combinations(range(exist), count))
    assert cost(chosen) <= best + 1e-4


def test_frames_that_do_not_exist_are_chosen_last():
    chosen = salient_frames(jnp.array([0.0, 3, 0, 0]), jnp.array([True, True, False, False]), 3)
    np.testing.assert_array_equal(chosen[:2], [0, 1])


@pytest.mark.parametrize(("frames", "count"), [(4, 5), (4, 0), (13, 2)])
def test_impossible_choices_are_refused(frames, count):
    with pytest.raises(ValueError, match=f"count is {count} of {frames} frames"):
        salient_frames(jnp.zeros(frames), jnp.ones(frames, bool), count)


def test_a_batch_loses_its_dull_frames_together_with_all_that_is_said_of_them():
    batch = jax.tree.map(jnp.asarray, tiny.touch_batch(0))
    frames = np.zeros(batch.frames.shape, np.uint8)
    frames[:, 0, 2:], frames[:, 1, 3:] = 50, 50  # stream 0 changes at frame 2 and stays, stream 1 at frame 3
    short = fewer_frames(batch.replace(frames=jnp.asarray(frames)), 2)
    for s, kept in ((0, [0, 3]), (1, [0, 3])):
        assert short.frames[0, s, 0].max() == 0
        assert short.frames[0, s, 1].min() == 50
        rows = [
            int(np.flatnonzero(np.asarray(batch.frame_index[0, s]) == i)[0])
            for i in np.asarray(short.frame_index[0, s])
        ]
        np.testing.assert_array_equal(short.force_n[0, s], batch.force_n[0, s, np.array(rows)])
        assert rows[1] <= kept[1]
    assert short.frame_mask.shape == (1, 2, 2)
