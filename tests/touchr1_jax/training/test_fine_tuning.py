"""Fine-tuning an encoder with a linear head: the loss by hand, missing levels, and that the encoder is trained."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.tactile_vit import TactileViT
from touchr1_jax.training.fine_tuning import (
    FineTuned,
    label_loss,
    level_log_probs,
    make_fine_tune_step,
    start_fine_tuning,
)

CONFIG = FineTuned(encoder=dataclasses.replace(tiny.CONFIG.tactile, frames_per_step=1), levels=(3, 2))
OPTIMIZER = optax.adam(3e-3)


def test_loss_is_the_mean_over_known_labels():
    log_p = jnp.log(jnp.array([[[0.5, 0.25, 0.25], [0.9, 0.1, 0.0]], [[0.1, 0.8, 0.1], [0.5, 0.5, 0.0]]]))
    label = jnp.array([[1, 0], [-1, -1]])
    np.testing.assert_allclose(label_loss(log_p, label), -(np.log(0.25) + np.log(0.9)) / 2, rtol=1e-6)


@pytest.fixture(scope="module")
def started():
    """State before training, and the contacts."""
    batch = jax.tree.map(jnp.asarray, tiny.touch_batch(0, 4))
    batch = batch.replace(label=batch.label % jnp.array([3, 2, 3, 3]))
    sensors = jnp.broadcast_to(jnp.arange(tiny.S), (4, tiny.S))
    streams = (batch.frames, batch.force_n, batch.frame_index, batch.frame_mask, sensors)
    encoder = jax.jit(TactileViT(CONFIG.encoder).init)(jax.random.key(0), *streams)["params"]
    return start_fine_tuning(CONFIG, OPTIMIZER, encoder, batch), batch


@pytest.mark.long
def test_an_untrained_head_is_even_and_gives_no_level_that_is_not_there(started):
    state, batch = started
    p = np.exp(level_log_probs(CONFIG, state.params, batch))
    np.testing.assert_allclose(p, np.broadcast_to([[1 / 3] * 3, [0.5, 0.5, 0.0]], p.shape), rtol=1e-5)


@pytest.mark.long
def test_labels_are_learned_by_encoder_and_head(started):
    state, batch = started
    before = jax.tree.map(np.array, state.params["encoder"])
    step = make_fine_tune_step(CONFIG, OPTIMIZER)
    losses = []
    for _ in range(40):
        state, metrics = step(state, batch)
        losses.append(float(metrics["loss"]))
    assert losses[0] == pytest.approx((np.log(3) + np.log(2)) / 2, rel=1e-5)
    assert losses[-1] < 0.3 * losses[0]
    moved = np.abs(before["layer_0"]["up"]["kernel"] - np.asarray(state.params["encoder"]["layer_0"]["up"]["kernel"]))
    assert moved.max() > 1e-3
