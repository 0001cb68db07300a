"""Objectives of stage 1: values by hand, what must have no influence, and that a step of each learns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.training.dynamics import DynamicsConfig, MeasuredTouch, make_dynamics_step, start_dynamics
from touchr1_jax.training.objectives import (
    contrast_loss,
    hidden_loss,
    hide_patches,
    measured_loss,
    measured_targets,
    random_patches,
)

pytestmark = pytest.mark.long

P, S = 4, tiny.S


def test_contrast_by_hand():
    """Two contacts on two axes: by cosine 1 for the own and 0 for the other contact, at τ = .5."""
    embedding = jnp.array([[[3.0, 0.0], [1.0, 0.0]], [[0.0, 2.0], [0.0, 5.0]]])
    everything = jnp.ones((2, 2), bool)
    np.testing.assert_allclose(contrast_loss(embedding, everything, 0.5), np.log1p(np.exp(-2.0)), rtol=1e-5)
    same = jnp.ones((2, 2, 2))  # nothing distinguishes contacts: chance among two
    np.testing.assert_allclose(contrast_loss(same, everything, 0.5), np.log(2), rtol=1e-5)


def test_contrast_leaves_out_what_was_not_recorded():
    embedding = jnp.asarray(np.random.default_rng(0).normal(size=(3, 2, 4)), jnp.float32)
    exists = jnp.array([[True, True], [True, True], [True, False]])
    changed = embedding.at[2, 1].set(99.0)
    np.testing.assert_allclose(contrast_loss(embedding, exists), contrast_loss(changed, exists), rtol=1e-6)
    alone = jnp.array([[True, False], [False, True], [True, False]])
    assert contrast_loss(embedding, alone) == 0  # no contact was recorded by both sensors
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(jax.grad(contrast_loss)(0 * embedding, exists)))


def test_contrast_compares_a_contact_with_those_of_the_other_sensor_alone():
    """Contact 2 has sensor 0 only: for finding contacts among those of sensor 0 it is one more candidate."""
    z = jnp.zeros((3, 2, 2)).at[..., 0].set(1.0)
    exists = jnp.array([[True, True], [True, True], [True, False]])
    np.testing.assert_allclose(contrast_loss(z, exists), (np.log(3) + np.log(2)) / 2, rtol=1e-5)


def test_hidden_loss_by_hand_and_without_gradient_to_its_goal():
    predicted, goal = jnp.array([[1.0, 2.0], [5.0, 5.0]]), jnp.array([[0.0, 4.0], [9.0, 9.0]])
    hidden = jnp.array([True, False])
    assert hidden_loss(predicted, goal, hidden) == 1.5
    assert not jax.grad(lambda g: hidden_loss(predicted, g, hidden))(goal).any()


def test_measured_loss_by_hand():
    predicted, measured = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.0, jnp.nan, 5.0])
    known = jnp.array([True, False, True])
    assert measured_loss(predicted, measured, known) == 2.5
    assert np.isfinite(jax.grad(measured_loss)(predicted, measured, known)).all()


def test_targets_of_force_and_depth_by_hand():
    """1 N sideways and −9.9 N down at .01 mm; then nothing measured."""
    force = jnp.array([[1.0, 0.0, -9.9], [0.0, 0.0, 0.0]])
    depth = jnp.array([[0.01, 0.0], [jnp.nan, jnp.nan]])
    value, known = measured_targets(force, depth)
    np.testing.assert_allclose(value[0], [0.1, 0, -0.99, np.log(100) - 2, np.log(2), 0], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(known, [[True] * 6, [False] * 6])
    assert np.isfinite(value).all()


def test_hidden_patches_are_grey_in_every_frame_and_the_others_unchanged():
    frames = np.zeros((2, 4, 4, 3), np.uint8)
    hidden = np.array([False, True, False, False])
    found = np.asarray(hide_patches(jnp.asarray(frames), jnp.asarray(hidden)))
    assert (found[:, :2, 2:] == 128).all()
    assert found.sum() == found[:, :2, 2:].sum()
    with pytest.raises(ValueError, match="square"):
        hide_patches(jnp.asarray(frames), jnp.ones(3, bool))


@pytest.mark.parametrize(("share", "count"), [(0.5, 2), (0.1, 1), (1.0, 4)])
def test_the_share_of_patches_is_exact(share, count):
    assert (np.asarray(random_patches(jax.random.key(0), (5, 4), share)).sum(-1) == count).all()


ENCODER = dataclasses.replace(tiny.CONFIG.tactile, causal=True, frames_per_step=1)


@pytest.fixture(scope="module")
def contacts() -> MeasuredTouch:
    """Contacts with square pictures; the second measure of depth is missing."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (P, S, tiny.FRAMES, 56, 56, 3), dtype=np.uint8)
    depth = rng.uniform(0, 0.5, (P, S, tiny.FRAMES, 2)).astype(np.float32)
    depth[..., 1] = np.nan
    touch = tiny.touch_batch(0, P).replace(frames=frames)
    return jax.tree.map(jnp.asarray, MeasuredTouch(touch=touch, depth_mm=depth))


@pytest.mark.parametrize("objective", ["contrast", "masked", "physics"])
def test_each_objective_is_learned(contacts, objective):
    config = DynamicsConfig(encoder=ENCODER, objective=objective)
    optimizer = optax.adam(3e-3)
    state = jax.jit(lambda key, b: start_dynamics(config, optimizer, key, b))(jax.random.key(0), contacts)
    step = make_dynamics_step(config, optimizer)
    before = jax.tree.map(np.array, state.params["encoder"])
    losses = []
    for _ in range(25):
        state, metrics = step(state, contacts)
        losses.append(float(metrics[objective]))
    assert np.mean(losses[-3:]) < 0.8 * np.mean(losses[:3])
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), before, jax.device_get(state.params["encoder"]))
    assert moved["layer_0"]["up"]["kernel"] > 1e-3


def test_options_that_contradict_an_objective_are_refused(contacts):
    with pytest.raises(ValueError, match="causal"):
        DynamicsConfig(encoder=dataclasses.replace(ENCODER, causal=False))
    with pytest.raises(ValueError, match="frames_kept"):
        DynamicsConfig(encoder=ENCODER, objective="masked", frames_kept=2)
    config, sgd = DynamicsConfig(encoder=ENCODER, objective="physics"), optax.sgd(0.1)
    begin = lambda: start_dynamics(config, sgd, jax.random.key(0), contacts)
    with pytest.raises(ValueError, match="depth_mm"):
        jax.eval_shape(lambda: make_dynamics_step(config, sgd)(begin(), contacts.touch))
