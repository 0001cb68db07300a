"""Differences of frames: exact in both directions, by hand, and chosen as the frames want them."""

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

from sensors_io.deltas import FILTERS, accumulate, choose_filter, difference

RNG = np.random.default_rng(0)
SCENE = RNG.integers(0, 256, (40, 50, 3), dtype=np.uint8)


def column(*values):
    """Frames of one pixel in a row: values[n][y]."""
    return np.array(values, np.uint8)[:, :, None, None].repeat(3, -1)


@hypothesis.given(
    shape=st.tuples(st.integers(0, 5), st.integers(0, 6), st.integers(0, 6)),
    name=st.sampled_from([*FILTERS]),
    seed=st.integers(0, 2**31),
)
def test_every_filter_gives_the_frames_back(shape, name, seed):
    frames = np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)
    frames.flags.writeable = False  # as a view of an entry's bytes is
    residual = difference(frames, name)
    residual.flags.writeable = False
    np.testing.assert_array_equal(accumulate(residual, name), frames)


@pytest.mark.parametrize(
    ("name", "residual"),
    [
        ("none", [[10, 12, 5], [11, 250, 5]]),
        ("time", [[10, 12, 5], [1, 238, 0]]),
        ("rows", [[10, 2, 249], [11, 239, 11]]),
        ("time+rows", [[10, 2, 249], [1, 237, 18]]),
    ],
)
def test_residuals_by_hand(name, residual):
    np.testing.assert_array_equal(difference(column([10, 12, 5], [11, 250, 5]), name), column(*residual))


def ramps(slope):
    """Frame n rises by slope[n] from row to row."""
    return (np.array(slope)[:, None, None, None] * np.arange(40)[:, None, None] % 256).repeat(50, 2).repeat(3, 3)


@pytest.mark.parametrize(
    ("frames", "name"),
    [
        (np.repeat(SCENE[None].astype(int), 9, 0), "time"),  # nothing moves
        (ramps([5, -5, 5, -5, 5, -5]), "rows"),  # smooth, and another picture every time
        (ramps([5] * 6) + 37 * np.arange(6)[:, None, None, None], "time+rows"),  # smooth, and flickers as a whole
        (RNG.integers(-3, 4, (9, 40, 50, 3)), "none"),  # noise about zero
    ],
)
def test_the_filter_with_the_smallest_residual_is_chosen(frames, name):
    assert choose_filter((frames % 256).astype(np.uint8)) == name
