"""From the last frame to a later one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.frame_decoder import FrameDecoder, FrameDecoderConfig, from_cells, to_cells

pytestmark = pytest.mark.long

CONFIG = FrameDecoderConfig(cell_px=2, width=4, num_layers=1)


@pytest.fixture(scope="module")
def inputs():
    rng = np.random.default_rng(0)
    frames = jnp.asarray(rng.random((2, 2, 8, 12, 3)), jnp.float32)
    patches = jnp.asarray(rng.normal(size=(2, 6, 5)), jnp.float32)
    return frames[0], frames[1], patches, jnp.ones((2, 3))


def test_cells_are_squares_and_come_back():
    x = jnp.arange(2 * 4 * 6 * 3).reshape(2, 4, 6, 3)
    cells = to_cells(x, 2)
    np.testing.assert_array_equal(cells[1, 1, 2], x[1, 2:4, 4:6].ravel())
    np.testing.assert_array_equal(from_cells(cells, 2), x)


def test_a_fresh_decoder_answers_the_last_frame(inputs):
    module = FrameDecoder(CONFIG)
    run = jax.jit(lambda key, *x: module.apply(module.init(key, *x), *x))
    np.testing.assert_array_equal(run(jax.random.key(0), *inputs), inputs[0])


def test_a_patch_speaks_where_it_lies(inputs):
    """2 × 3 patches of 4 px; without convolutions patch 4 reaches rows 4–7, columns 4–7 and no others."""
    module = FrameDecoder(FrameDecoderConfig(cell_px=2, width=4, num_layers=0))
    params = draw_params(jax.eval_shape(module.init, jax.random.key(0), *inputs))["params"]
    run = jax.jit(lambda patches: module.apply({"params": params}, inputs[0], inputs[1], patches, inputs[3]))
    moved = np.any(np.asarray(run(inputs[2]) != run(inputs[2].at[:, 4].add(1.0))), (0, 3))
    expected = np.zeros((8, 12), bool)
    expected[4:8, 4:8] = True
    np.testing.assert_array_equal(moved, expected)


def test_cells_must_fill_the_patches(inputs):
    with pytest.raises(ValueError, match="frames of 8×12 px, 6 patches: cells of 3 px must fill every patch"):
        FrameDecoder(FrameDecoderConfig(cell_px=3)).init(jax.random.key(0), *inputs)
