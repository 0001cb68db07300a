"""Who sees whom in the vision tower; its numbers are held by `test_parity`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.vision import QwenVision

CONFIG = QwenVisionConfig(
    out_size=6, depth=2, hidden_size=16, num_heads=2, intermediate_size=20, patch_px=2, window_px=8, full_layers=()
)
GRID = Grid(1, 4, 8)  # 2 × 4 tokens, two windows of 2 × 2


@pytest.fixture(scope="module")
def params():
    """Loud enough that attention is not uniform."""
    drawn = jax.jit(lambda x: QwenVision(CONFIG).init(jax.random.key(0), x, (GRID,))["params"])(patches(GRID))
    return jax.tree.map(lambda x: 3 * x if x.ndim == 2 else x, drawn)


def patches(*grids: Grid, seed: int = 0) -> jax.Array:
    n = sum(g.patches for g in grids)
    return jnp.asarray(np.random.default_rng(seed).normal(size=(n, CONFIG.patch_size)), jnp.float32)


def encode(params, x, *grids, config=CONFIG):
    return jax.jit(lambda p, x: QwenVision(config).apply({"params": p}, x, grids))(params, x)


def influence(params, grids, config) -> np.ndarray:
    """Whether token i depends on token j's patches, bool [i, j]."""
    x = patches(*grids)
    weights = jnp.arange(1.0, CONFIG.out_size + 1)
    forward = lambda x: QwenVision(config).apply({"params": params}, x, grids) @ weights
    jacobian = jax.jit(jax.jacobian(forward))(x)
    return np.asarray(jnp.any(jacobian.reshape(jacobian.shape[0], -1, 4 * CONFIG.patch_size) != 0, -1))


@pytest.mark.long
def test_windows_see_themselves_alone(params):
    """Token columns 0–1 and 2–3 of both rows; gradients elsewhere are exactly 0."""
    window = np.array([0, 0, 1, 1] * 2)
    np.testing.assert_array_equal(influence(params, (GRID,), CONFIG), window[:, None] == window)


@pytest.mark.long
def test_full_layers_see_the_frame_and_no_other(params):
    """Two steps of a video and a picture behind it."""
    config = dataclasses.replace(CONFIG, full_layers=(1,))
    frame = np.repeat([0, 1, 2], [8, 8, 4])
    seen = influence(params, (Grid(2, 4, 8), Grid(1, 4, 4)), config)
    np.testing.assert_array_equal(seen, frame[:, None] == frame)


@pytest.mark.long
def test_pictures_together_are_pictures_apart(params):
    """Sizes differ, so that windows and frames are padded."""
    config = dataclasses.replace(CONFIG, full_layers=(1,))
    grids = (Grid(1, 6, 10), Grid(2, 4, 4), Grid(1, 2, 2))
    x = patches(*grids)
    cut = np.cumsum([g.patches for g in grids])[:-1]
    apart = [encode(params, part, grid, config=config) for part, grid in zip(np.split(x, cut), grids, strict=True)]
    wanted = np.concatenate(apart)
    rounding = 2e-5 * np.abs(wanted).max()  # of sums over widths that differ: it goes by their largest terms
    np.testing.assert_allclose(encode(params, x, *grids, config=config), wanted, rtol=0, atol=rounding)


@pytest.mark.long
def test_parameters_fix_the_precision(params):
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), params)
    ours = encode(half, patches(GRID), GRID)
    assert ours.dtype == jnp.bfloat16
    whole = encode(params, patches(GRID), GRID)
    assert jnp.linalg.norm(ours.astype(jnp.float32) - whole) < 0.1 * jnp.linalg.norm(whole)


@pytest.mark.long
def test_patches_must_be_those_of_the_grids(params):
    with pytest.raises(ValueError, match=r"patches are \(32, 24\), grids \(\(1, 4, 4\),\) have \(16, 24\)"):
        QwenVision(CONFIG).apply({"params": params}, patches(GRID), (Grid(1, 4, 4),))
