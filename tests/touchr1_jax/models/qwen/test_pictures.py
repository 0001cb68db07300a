"""Sizes, resizing and patches, against the released processor, Pillow and loops."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from PIL import Image

from tests.touchr1_jax.models.qwen import cases
from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.pictures import (
    CLIP_MEAN,
    CLIP_STD,
    PICTURE_BUDGET,
    fitting_size,
    grid_of,
    patchify,
    resize,
)

CONFIG = QwenVisionConfig(out_size=8)


def pixels(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_picture_becomes_the_patches_of_the_released_processor():
    """Resizing included; the golden array is in whole levels."""
    picture = cases.picture_pixels()
    height, width = fitting_size(*picture.shape[:2], CONFIG.cell_px, PICTURE_BUDGET)
    ours = np.asarray(patchify(resize(picture, height, width)[None], CONFIG)).reshape(-1, 3, 2 * 14**2)
    levels = (ours * np.array(CLIP_STD)[:, None] + np.array(CLIP_MEAN)[:, None]) * 255
    with np.load(cases.GOLDEN) as golden:
        theirs = golden["picture.levels"]
    np.testing.assert_allclose(levels.reshape(theirs.shape), theirs, atol=1.01)
    assert np.mean(np.abs(levels.reshape(theirs.shape) - theirs) > 0.01) < 0.01  # ties of rounding alone


@pytest.mark.parametrize("size", [(84, 28), (56, 84), (112, 140)])
def test_resizing_is_pillows(size):
    """Sizes at which every version of Pillow takes the columns first."""
    picture = pixels(0, 64, 90, 3)
    theirs = np.asarray(Image.fromarray(picture).resize(size[::-1], Image.Resampling.BICUBIC), np.float32)
    ours = np.asarray(resize(picture, *size))
    assert np.abs(ours - theirs).max() <= 1
    assert np.mean(ours != theirs) < 0.01


def test_resizing_to_the_same_size_changes_nothing():
    picture = pixels(0, 2, 28, 56, 3)
    np.testing.assert_array_equal(resize(picture, 28, 56), picture)


@pytest.mark.parametrize(
    ("size", "fitted"),
    [
        ((64, 64), (56, 56)),
        ((240, 320), (252, 308)),
        ((20, 20), (56, 56)),
        ((4000, 3000), (1148, 840)),
        ((28, 5600), None),
    ],
)
def test_sizes_by_hand(size, fitted):
    """By the released rule; the last one is at the bound of the aspect and is shrunk to one row."""
    ours = fitting_size(*size, 28, PICTURE_BUDGET)
    assert ours == (fitted or (28, 5600))


@given(st.integers(1, 4000), st.integers(1, 4000))
def test_fitted_sizes_are_whole_tokens_within_the_budget(height, width):
    if max(height, width) > 200 * min(height, width):
        with pytest.raises(ValueError, match="differ ≤ 200-fold"):
            fitting_size(height, width, 28, PICTURE_BUDGET)
        return
    h, w = fitting_size(height, width, 28, PICTURE_BUDGET)
    assert h % 28 == w % 28 == 0
    assert h * w >= PICTURE_BUDGET.least
    assert h * w <= PICTURE_BUDGET.most or min(h, w) == 28


def test_patches_are_those_of_loops():
    """Three frames make two steps, the last frame twice."""
    c = QwenVisionConfig(out_size=8, hidden_size=16, num_heads=2, patch_px=2, merge=2, window_px=8)
    frames = pixels(1, 3, 4, 8, 3)
    ours = np.asarray(patchify(frames, c))
    padded = np.concatenate([frames, frames[-1:]]) / 255.0
    normal = (padded - np.array(CLIP_MEAN)) / np.array(CLIP_STD)
    rows = [
        [normal[2 * t + f, 2 * (2 * big_r + r) + y, 2 * (2 * big_c + c_) + x, ch]
         for ch in range(3) for f in range(2) for y in range(2) for x in range(2)]
        for t in range(2) for big_r in range(1) for big_c in range(2) for r in range(2) for c_ in range(2)
    ]  # fmt: skip
    assert grid_of(frames.shape, c) == Grid(2, 2, 4)
    np.testing.assert_allclose(ours, rows, rtol=1e-5, atol=1e-6)


def test_pictures_are_cut_alike_one_by_one():
    many = pixels(2, 2, 1, 56, 28, 3)
    np.testing.assert_array_equal(patchify(many, CONFIG)[1], patchify(many[1], CONFIG))


@pytest.mark.parametrize("shape", [(1, 30, 28, 3), (0, 28, 28, 3), (1, 28, 0, 3)])
def test_sides_must_be_whole_tokens(shape):
    with pytest.raises(ValueError, match="sides in multiples of 28 px"):
        patchify(np.zeros(shape, np.uint8), CONFIG)


def test_empty_picture_is_refused():
    with pytest.raises(ValueError, match="picture is 0×5 px"):
        fitting_size(0, 5, 28, PICTURE_BUDGET)
