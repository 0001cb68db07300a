"""The vision tower: which pixels a merged token holds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.vision import VisionConfig, VisionTower

CONFIG = dataclasses.replace(VisionConfig(), image_px=16, patch_px=4, width=8, num_layers=0)
TOWER = VisionTower(CONFIG, 12)


def test_a_token_is_one_block_of_two_by_two_patches_row_by_row():
    params = draw_params(jax.eval_shape(TOWER.init, jax.random.key(0), jnp.zeros((16, 16, 3), jnp.uint8)))
    run = jax.jit(lambda x: TOWER.apply(params, x))
    view = np.random.default_rng(0).integers(0, 200, (16, 16, 3), dtype=np.uint8)
    before = run(view)
    assert before.shape == (4, 12)
    for y, x, token in [(0, 0, 0), (7, 7, 0), (3, 8, 1), (15, 7, 2), (8, 15, 3)]:
        touched = view.copy()
        touched[y, x] += 50
        changed = np.any(np.asarray(run(touched) != before), -1)
        np.testing.assert_array_equal(changed, np.arange(4) == token)


def test_pixels_keep_their_place_inside_a_patch():
    """A patch is rows of pixels: the embedding of one bright pixel is the kernel's row (y · 4 + x) · 3 + channel."""
    params = draw_params(jax.eval_shape(TOWER.init, jax.random.key(0), jnp.zeros((16, 16, 3), jnp.uint8)))["params"]
    kernel = params["patch"]["kernel"]

    @jax.jit
    def patch_of(view):
        _, state = TOWER.apply(
            {"params": params}, jnp.asarray(view), capture_intermediates=lambda m, _: m.name == "patch"
        )
        return state["intermediates"]["patch"]["__call__"][0]

    view = np.zeros((16, 16, 3), np.uint8)
    lit = view.copy()
    lit[4 + 2, 8 + 1, 1] = 255  # block row 0, patch row 1; block column 1, patch column 0
    difference = patch_of(lit) - patch_of(view)
    row = 4 * 1 + 2 * 1 + 0
    np.testing.assert_allclose(difference[row], 2 * kernel[(2 * 4 + 1) * 3 + 1], rtol=1e-5, atol=1e-6)
    assert not jnp.delete(difference, row, axis=0).any()


def test_statistics_see_where_a_pixel_is_by_its_cell_alone():
    tower = VisionTower(dataclasses.replace(CONFIG, stem="statistics"), 12)
    params = draw_params(jax.eval_shape(tower.init, jax.random.key(0), jnp.zeros((16, 16, 3), jnp.uint8)))
    run = jax.jit(lambda x: tower.apply(params, x))
    view = np.full((16, 16, 3), 100, np.uint8)
    seen = [view.copy() for _ in range(3)]
    for one, (y, x) in zip(seen, [(2, 2), (5, 5), (10, 2)], strict=True):
        one[y, x] += 50
    same, moved, other = (np.asarray(run(one)) for one in seen)
    assert same.shape == (4, 12)
    np.testing.assert_allclose(same, moved, atol=1e-5)
    assert not np.allclose(same, other, atol=1e-3)


def test_grid_is_the_tokens_along_one_side():
    assert VisionConfig().grid == 2
    assert VisionConfig(image_px=112, patch_px=14).grid == 4


def test_a_view_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"view is 8×16 px, the vision config says 16²; resize it"):
        TOWER.init(jax.random.key(0), jnp.zeros((8, 16, 3), jnp.uint8))
