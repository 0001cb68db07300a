"""The predictor sees the past of the streams that are shown, and nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.predictor import LatentPredictor, PredictorConfig, layer_norm

pytestmark = pytest.mark.long

P, S, T, N, D = 1, 2, 3, 2, 4
CONFIG = PredictorConfig(width=8, num_layers=1, num_heads=2)


@pytest.fixture(scope="module")
def inputs():
    rng = np.random.default_rng(0)
    latent = jnp.asarray(rng.normal(size=(P, S, T, N, D)), jnp.float32)
    shown = jnp.ones((P, S, T), bool)
    index = jnp.asarray(np.tile([3, 5, 9], (P, S, 1)), jnp.int32)
    force = jnp.asarray(rng.normal(size=(P, S, T, 3)), jnp.float32)
    return latent, shown, index, force


@pytest.fixture(scope="module")
def predict(inputs):
    """A predictor whose output layer says something; a fresh one copies."""
    module = LatentPredictor(CONFIG, S)
    params = draw_params(jax.eval_shape(module.init, jax.random.key(0), *inputs))["params"]
    return jax.jit(lambda *x: module.apply({"params": params}, *x))


def changed(a, b) -> np.ndarray:
    """Which (stream, step) differ, bool [S, T]."""
    return np.any(np.asarray(a != b), (0, 3, 4))


def test_no_step_looks_ahead(predict, inputs):
    latent, *rest = inputs
    before = predict(latent, *rest)
    assert before.shape == latent.shape
    after = predict(latent.at[:, 0, 1].add(1.0), *rest)
    np.testing.assert_array_equal(changed(before, after), [[False, True, True], [False, True, True]])


def test_hidden_streams_say_nothing_and_are_asked_about(predict, inputs):
    latent, shown, *rest = inputs
    hidden = shown.at[:, 1].set(False)
    before = predict(latent, hidden, *rest)
    np.testing.assert_array_equal(predict(latent.at[:, 1].add(1.0), hidden, *rest), before)
    after = predict(latent.at[:, 0].add(1.0), hidden, *rest)
    assert changed(before, after).all()


def test_it_is_told_when_and_how_hard(predict, inputs):
    latent, shown, index, force = inputs
    before = predict(*inputs)
    assert changed(before, predict(latent, shown, index.at[:, :, 2].add(4), force))[:, 2].all()
    assert changed(before, predict(latent, shown, index, force.at[:, :, 2].add(4)))[:, 2].all()


def test_a_fresh_predictor_copies_what_is_shown(inputs):
    latent, shown, *rest = inputs
    module = LatentPredictor(CONFIG, S)
    params = module.init(jax.random.key(0), *inputs)
    out = module.apply(params, latent, shown.at[:, 1].set(False), *rest)
    np.testing.assert_array_equal(out[:, 0], layer_norm(latent[:, 0]))
    np.testing.assert_array_equal(out[:, 1], 0)


def test_layer_norm_by_hand():
    np.testing.assert_allclose(layer_norm(jnp.array([1.0, 3.0])), [-1, 1], rtol=1e-5)
