"""The schedule and what it multiplies, and what is left out."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from touchr1_jax.skipping import count_skipped, skip_nonfinite
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


@pytest.mark.long
def test_rate_warms_up_to_the_scaled_rate_and_decays_to_its_share():
    sizes = step_sizes(CONFIG, 12)
    assert CONFIG.peak == pytest.approx(1e-3)
    np.testing.assert_allclose(sizes[:4], np.arange(1, 5) / 4 * 1e-3, rtol=1e-3)  # none is spent at rate 0
    assert (np.diff(sizes[3:]) < 0).all()
    cosine = 0.05 + 0.95 * (1 + np.cos(np.pi * 7 / 8)) / 2
    np.testing.assert_allclose(sizes[10:], [1e-3 * cosine, 1e-3 * 0.05], rtol=1e-3)


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


PARAMS = {"a": jnp.arange(3.0), "b": jnp.ones((2, 2))}


class TestSkipping:
    def gradients(self, bad: float | None = None):
        grads = jax.tree.map(lambda x: 0.5 * jnp.ones_like(x), PARAMS)
        return grads if bad is None else {**grads, "a": grads["a"].at[1].set(bad)}

    def test_finite_gradients_are_the_inner_optimizers_business(self):
        inner = optax.adam(0.1)
        outer, a, b = skip_nonfinite(inner), inner.init(PARAMS), skip_nonfinite(inner).init(PARAMS)
        for _ in range(3):
            update, a = inner.update(self.gradients(), a, PARAMS)
            same, b = outer.update(self.gradients(), b, PARAMS)
            jax.tree.map(np.testing.assert_array_equal, (same, b.inner), (update, a))
        assert count_skipped(b).tolist() == [0, 0]

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38])
    def test_an_update_that_is_not_finite_moves_nothing_and_is_counted(self, bad):
        """Of 3e38 the square is infinite, and so is the norm: clipping would leave nothing of the other gradients."""
        optimizer = make_optimizer(CONFIG, 9)
        _, before = optimizer.update(self.gradients(), optimizer.init(PARAMS), PARAMS)
        state = before
        for n in (1, 2):
            update, state = jax.jit(optimizer.update)(self.gradients(bad), state, PARAMS)
            assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(update))
            jax.tree.map(np.testing.assert_array_equal, state.inner, before.inner)
            assert count_skipped({"anywhere": state}).tolist() == [n, n]
        update, state = optimizer.update(self.gradients(), state, PARAMS)
        assert any((np.asarray(leaf) != 0).any() for leaf in jax.tree.leaves(update))
        assert count_skipped(state).tolist() == [2, 0]

    def test_nothing_is_counted_where_nobody_counts(self):
        assert count_skipped({"opt_state": optax.adam(0.1).init(PARAMS)}) is None

    @pytest.mark.long
    def test_every_run_of_a_batch_skips_for_itself(self):
        optimizer = falling_adamw(0.1, 1.0, 4, max_grad_norm=1.0)
        grads = jnp.array([[1.0, 2.0], [jnp.nan, 2.0]])
        state = jax.vmap(optimizer.init)(jnp.zeros((2, 2)))
        update, state = jax.vmap(optimizer.update)(grads, state, jnp.zeros((2, 2)))
        assert (np.asarray(update[0]) != 0).all()
        assert (np.asarray(update[1]) == 0).all()
        assert state.skipped.tolist() == [0, 1]
