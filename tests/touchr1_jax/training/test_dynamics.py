"""Stage 1: what the loss consists of, what the step keeps, and that prediction is learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.predictor import PredictorConfig
from touchr1_jax.models.salience import fewer_frames
from touchr1_jax.training.dynamics import (
    DynamicsConfig,
    Guards,
    Steps,
    covariance_of,
    dynamics_loss,
    encode_batch,
    encode_each,
    make_dynamics_step,
    prediction_errors,
    random_shown,
    read_frames,
    spread_of,
    start_dynamics,
    steps_of,
)

ENCODER = dataclasses.replace(tiny.CONFIG.tactile, causal=True, frames_per_step=1)
CONFIG = DynamicsConfig(encoder=ENCODER, predictor=PredictorConfig(width=8, num_layers=1, num_heads=2))
OPTIMIZER = optax.adam(3e-3)
P, S, T = 3, tiny.S, tiny.FRAMES
SHOWN = jnp.ones((P, S), bool)


@pytest.fixture(scope="module")
def batch():
    return jax.tree.map(jnp.asarray, tiny.touch_batch(0, P))


@pytest.fixture(scope="module")
def state(batch):
    return jax.jit(lambda key, b: start_dynamics(CONFIG, OPTIMIZER, key, b))(jax.random.key(0), batch)


@pytest.fixture(scope="module")
def graded():
    """(params, target, batch, shown, guards) → (loss, metrics), gradients by params."""
    loss = lambda p, t, b, s, g: dynamics_loss(CONFIG, p, t, b, s, g)
    return jax.jit(jax.value_and_grad(loss, has_aux=True))


def test_steps_take_the_first_index_and_the_last_force(batch):
    mask = np.ones((P, S, T), bool)
    mask[0, 0, 2:] = False
    present = np.ones((P, S), bool)
    present[1, 1] = False
    steps = steps_of(batch.replace(frame_mask=mask, stream_mask=present), 2)
    np.testing.assert_array_equal(steps.index[2, 0], batch.frame_index[2, 0, ::2])
    np.testing.assert_array_equal(steps.force_n[2, 0], batch.force_n[2, 0, 1::2])
    np.testing.assert_array_equal(steps.exists[:, :, 1], [[False, True], [True, False], [True, True]])
    np.testing.assert_array_equal(steps.force_n[0, 0, 1], [0, 0, 0])


def test_errors_by_hand():
    """One contact, one stream, three steps of which the last does not exist: only the pair (0, 1) counts."""
    goal = jnp.array([0.0, 2.0, 50.0]).reshape(1, 1, 3, 1, 1)
    predicted = jnp.array([1.5, 90.0]).reshape(1, 1, 2, 1, 1)
    exists = jnp.array([[[True, True, False]]])
    steps = Steps(index=jnp.zeros((1, 1, 3), int), force_n=jnp.zeros((1, 1, 3, 3)), exists=exists)
    assert prediction_errors(predicted, goal, steps) == (0.5, 2.0)


@pytest.mark.long
def test_spread_is_between_contacts_of_one_sensor_at_one_step():
    """Dimension 0 differs between sensors and steps alone, dimension 1 between contacts alone by ±2."""
    latent = np.zeros((2, 2, 3, 1, 2), np.float32)
    latent[..., 0] = np.arange(6).reshape(1, 2, 3, 1)
    latent[0, ..., 1], latent[1, ..., 1] = -2, 2
    exists = jnp.ones((2, 2, 3), bool)
    np.testing.assert_allclose(spread_of(jnp.asarray(latent), exists), [0.01, np.sqrt(4 + 1e-4)], rtol=1e-6)
    lonely = exists.at[1, 0].set(False)  # one contact has no spread: that sensor does not count
    np.testing.assert_allclose(spread_of(jnp.asarray(latent), lonely)[1], np.sqrt(4 + 1e-4), rtol=1e-6)


@pytest.mark.long
def test_covariance_by_hand():
    """Rows ±(1, 2) twice: cov_01 = 2, so 2 · 2² / D."""
    latent = jnp.array([[1.0, 2.0], [-1.0, -2.0]]).reshape(2, 1, 1, 1, 2)
    np.testing.assert_allclose(covariance_of(latent, jnp.ones((2, 1, 1), bool)), 4.0, rtol=1e-6)
    padded = jnp.concatenate([latent, 99.0 * latent[:1]])
    exists = jnp.array([True, True, False]).reshape(3, 1, 1)
    np.testing.assert_allclose(covariance_of(padded, exists), 4.0, rtol=1e-6)


@pytest.mark.long
def test_loss_is_the_sum_of_its_terms(state, batch, graded):
    guards = Guards(variance=2.0, covariance=0.5)
    (value, m), _ = graded(state.params, state.target, batch, SHOWN, guards)
    np.testing.assert_allclose(value, m["prediction"] + 2 * m["variance_term"] + 0.5 * m["covariance_term"], rtol=1e-6)


@pytest.mark.long
def test_the_target_gets_no_gradient_unless_it_leaks(state, batch, graded):
    """The gradient through a leak of one is that of a target that is the encoder itself."""
    bare = Guards(variance=0.0, covariance=0.0)
    still = graded(state.params, state.target, batch, SHOWN, bare)[1]
    leaking = graded(state.params, state.target, batch, SHOWN, bare.replace(leak=1.0))[1]
    own = jax.jit(
        jax.grad(lambda p: dynamics_loss(CONFIG, p, p["encoder"], batch, SHOWN, bare)[0])  # target = encoder
    )(state.params)
    gap = lambda a, b: max(
        float(np.abs(np.subtract(x, y)).max()) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)
    )
    assert gap(still, leaking) > 1e-4
    assert gap(own, leaking) < 1e-5


@pytest.mark.long
def test_what_is_missing_has_no_influence(state, batch, graded):
    """Pixels of padding, and of a stream that is absent."""
    mask = np.ones((P, S, T), bool)
    mask[0, 0, 3] = False
    present = np.ones((P, S), bool)
    present[1, 1] = False
    short = batch.replace(frame_mask=jnp.asarray(mask), stream_mask=jnp.asarray(present))
    frames = np.array(short.frames)
    frames[0, 0, 3], frames[1, 1] = 7, 9
    shown = jnp.asarray(present)
    before = graded(state.params, state.target, short, shown, Guards())
    after = graded(state.params, state.target, short.replace(frames=jnp.asarray(frames)), shown, Guards())
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(a, b)


def test_shown_streams_are_present_and_never_none():
    present = jnp.array([[True, True, False, True], [False, False, True, False]] * 50)
    shown = np.asarray(random_shown(jax.random.key(0), present, 0.5))
    assert not (shown & ~np.asarray(present)).any()
    assert shown.any(1).all()
    full = (shown == np.asarray(present)).all(1)[::2]
    assert 0.4 < full.mean() < 0.9  # one half, and those whose random subset is everything
    np.testing.assert_array_equal(random_shown(jax.random.key(0), present, 1.0), present)


@pytest.mark.long
def test_prediction_is_learned_in_one_trace(state, batch):
    step = make_dynamics_step(CONFIG, OPTIMIZER)
    state = jax.tree.map(jnp.array, state)  # the step gives its buffers away
    before = jax.tree.map(np.array, state.target)
    metrics = []
    for _ in range(60):
        state, found = step(state, batch)
        metrics.append(found)
    assert metrics[-1]["prediction"] < 0.6 * metrics[0]["prediction"]
    assert metrics[-1]["skill"] > 0.3
    assert int(state.step) == 60
    assert step._cache_size() == 1
    changed = [
        np.abs(np.asarray(a) - b).max() for a, b in zip(*map(jax.tree.leaves, (state.target, before)), strict=True)
    ]
    assert max(changed) > 1e-3


@pytest.mark.long
def test_the_target_is_the_moving_average(state, batch):
    step = make_dynamics_step(CONFIG, OPTIMIZER, Guards(ema=0.75))
    copy = jax.tree.map(jnp.array, state)
    end, _ = step(copy, batch)
    old, new = state.params["encoder"]["stem"]["kernel"], end.params["encoder"]["stem"]["kernel"]
    np.testing.assert_allclose(end.target["stem"]["kernel"], 0.75 * old + 0.25 * new, rtol=1e-5, atol=1e-7)


@pytest.mark.long
def test_contacts_are_encoded_alike_one_by_one(state, batch):
    both = jax.jit(lambda p, b: (encode_batch(ENCODER, p, b), encode_each(ENCODER, p, b)))(state.target, batch)
    np.testing.assert_allclose(both[1], both[0], rtol=1e-4, atol=1e-5)


@pytest.mark.long
def test_fewer_frames_are_read(batch):
    assert read_frames(CONFIG, batch) is batch
    short = read_frames(dataclasses.replace(CONFIG, frames_kept=2), batch)
    np.testing.assert_array_equal(short.frames, fewer_frames(batch, 2).frames)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"encoder": dataclasses.replace(ENCODER, causal=False)}, "encoder.causal is False"),
    ],
)
def test_bad_configs_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        dataclasses.replace(CONFIG, **change)
