"""The schedule and what it multiplies."""

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from touchr1_jax.training.optimizer import OptimizerConfig, falling_adamw, make_optimizer

CONFIG = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0, warmup_steps=4, max_grad_norm=1e9)


def step_sizes(config: OptimizerConfig, steps: int) -> np.ndarray:
    return update_sizes(make_optimizer(config, steps), steps)


def update_sizes(optimizer: optax.GradientTransformation, steps: int) -> np.ndarray:
    """Length of each update of one parameter under a constant gradient: Adam makes it the learning rate."""
    params = jnp.array(1.0)
    state, sizes = optimizer.init(params), []
    for _ in range(steps):
        update, state = optimizer.update(jnp.array(0.5), state, params)
        sizes.append(-float(update))
    return np.array(sizes)


def test_rate_warms_up_to_the_scaled_rate_and_decays_to_its_share():
    sizes = step_sizes(CONFIG, 12)
    assert CONFIG.peak == pytest.approx(1e-3)
    np.testing.assert_allclose(sizes[:5], np.arange(5) / 4 * 1e-3, rtol=1e-3, atol=1e-9)
    assert (np.diff(sizes[4:]) < 0).all()
    cosine = 0.05 + 0.95 * (1 + np.cos(np.pi * 7 / 8)) / 2
    np.testing.assert_allclose(sizes[11], 1e-3 * cosine, rtol=1e-3)


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_the_rate_of_grpo_falls_on_a_line(share):
    sizes = update_sizes(falling_adamw(1e-4, share, 4, max_grad_norm=1e9), 4)
    np.testing.assert_allclose(sizes, 1e-4 * (1 - (1 - share) * np.arange(4) / 4), rtol=1e-3)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_short_runs_get_a_schedule_that_is_not_all_zero(steps):
    sizes = step_sizes(CONFIG, steps)
    assert np.isfinite(sizes).all()
    assert sizes.max() > 0


def test_gradients_are_clipped_together():
    optimizer = make_optimizer(OptimizerConfig(learning_rate=1.0, lr_scale=1.0, warmup_steps=0, max_grad_norm=1.0), 10)
    params = {"a": jnp.array(0.0), "b": jnp.array(0.0)}
    gradient = {"a": jnp.array(30.0), "b": jnp.array(40.0)}
    state = optimizer.init(params)
    _, state = optimizer.update(gradient, state, params)
    moments = optax.tree.get(state, "mu")  # (1 − b1) · clipped gradient
    np.testing.assert_allclose([moments["a"], moments["b"]], [0.06, 0.08], rtol=1e-5)
