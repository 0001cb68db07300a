"""Statistics of patches against a plain computation, pixel by pixel."""

import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.models.frame_statistics import (
    TINY,
    VIEW_CENTRE,
    VIEW_SPREAD,
    WIDTH,
    frame_statistics,
    scaled_statistics,
    view_statistics,
)

pytestmark = pytest.mark.long

FRAMES = np.random.default_rng(0).integers(0, 256, (2, 3, 16, 24, 3), np.uint8)
"""Two streams of three frames of 16 × 24 px: six patches of 8 px."""


def by_hand(stream: np.ndarray, row: int, column: int, side: tuple[int, int]) -> np.ndarray:
    """Statistics [F, 21] of one patch, with loops over frames and channels."""
    cut = stream[:, row : row + side[0], column : column + side[1]].astype(np.float64) / 255
    found = []
    for frame in cut:
        change = frame - cut[0]
        coarse = frame.reshape(side[0] // 4, 4, side[1] // 4, 4, 3).mean((1, 3))
        energy = [
            np.log(np.abs(np.diff(x, axis=0)).mean((0, 1)) + np.abs(np.diff(x, axis=1)).mean((0, 1)) + TINY)
            for x in (frame, coarse)
        ]
        size = np.log(np.abs(change).mean((0, 1)) + TINY)
        found.append([change.mean((0, 1)), size, np.log(change.std((0, 1)) + TINY), *energy])
    return np.array([np.concatenate([*one, one[3] - found[0][3], one[4] - found[0][4]]) for one in found])


def test_statistics_equal_a_plain_computation():
    found = np.asarray(frame_statistics(jnp.asarray(FRAMES), 8))
    assert found.shape == (2, 3, 6, 21)
    for patch in range(6):
        expected = by_hand(FRAMES[1], 8 * (patch // 3), 8 * (patch % 3), (8, 8))
        np.testing.assert_allclose(found[1, :, patch], expected, atol=2e-4)
    whole = np.asarray(frame_statistics(jnp.asarray(FRAMES)))
    np.testing.assert_allclose(whole[0, :, 0], by_hand(FRAMES[0], 0, 0, (16, 24)), atol=2e-4)


def test_scaled_statistics_hold_the_patch_and_the_mean_patch():
    found = np.asarray(scaled_statistics(jnp.asarray(FRAMES), 8))
    assert found.shape[-1] == WIDTH
    np.testing.assert_array_equal(found[:, :, 0, 21:], found[:, :, 5, 21:])
    change = (FRAMES[1, 2].astype(np.float64) - FRAMES[1, 0]).mean((0, 1)) / 255
    np.testing.assert_allclose(found[1, 2, 0, 21:24], change / 0.03, atol=1e-4)


def test_statistics_of_a_view_are_colour_and_gradients_of_the_cell_and_the_mean_cell():
    view = FRAMES[0, 1]
    found = np.asarray(view_statistics(jnp.asarray(view), 8))
    assert found.shape == (6, 18)
    gradients = by_hand(FRAMES[0, 1:2], 8, 16, (8, 8))[0, 9:15]
    expected = np.concatenate([view[8:, 16:].mean((0, 1)) / 255, gradients])
    np.testing.assert_allclose(found[5, :9], (expected - VIEW_CENTRE) / VIEW_SPREAD, atol=2e-4)
    np.testing.assert_allclose(found[2, 9:12], (view.mean((0, 1)) / 255 - VIEW_CENTRE[:3]) / VIEW_SPREAD[:3], atol=2e-4)


@pytest.mark.parametrize("patch_px", [6, 4, 10])
def test_patches_that_do_not_fit_are_refused(patch_px):
    with pytest.raises(ValueError, match="multiples of 4 px"):
        frame_statistics(jnp.asarray(FRAMES), patch_px)
