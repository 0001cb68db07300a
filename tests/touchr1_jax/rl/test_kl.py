"""Estimators of the reference KL: their values by hand, and whose gradient they are (arXiv 2510.01555)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.rl.kl import LOG_RATIO_CLAMP, estimated_kl, exact_kl

RNG = np.random.default_rng(0)
THETA = jnp.asarray(RNG.normal(size=6), jnp.float32)
REFERENCE = jax.nn.log_softmax(jnp.asarray(RNG.normal(size=6), jnp.float32))


def forward(theta: jax.Array) -> jax.Array:
    """KL(π ‖ ref)."""
    return exact_kl(jax.nn.log_softmax(theta), REFERENCE)


def reverse(theta: jax.Array) -> jax.Array:
    """KL(ref ‖ π)."""
    return exact_kl(REFERENCE, jax.nn.log_softmax(theta))


def expected_gradient(estimator: str) -> jax.Array:
    """E_{v ~ π} ∇ k(v), by enumerating the vocabulary; sampling itself carries no gradient."""
    p = jax.nn.softmax(THETA)
    gradients = jax.jacobian(lambda theta: estimated_kl(jax.nn.log_softmax(theta), REFERENCE, estimator))(THETA)
    return p @ gradients


def test_exact_kl_by_hand():
    """KL((½, ½) ‖ (¼, ¾)) = ½ log 2 + ½ log ⅔."""
    ours = exact_kl(jnp.log(jnp.array([0.5, 0.5])), jnp.log(jnp.array([0.25, 0.75])))
    np.testing.assert_allclose(ours, 0.5 * np.log(2) + 0.5 * np.log(2 / 3), rtol=1e-6)


def test_exact_kl_of_equal_distributions_is_zero_even_with_banned_tokens():
    log_p = jax.nn.log_softmax(jnp.array([1.0, 2.0, -1e9, -1e9]))
    value, gradient = jax.value_and_grad(lambda x: exact_kl(jax.nn.log_softmax(x), log_p))(
        jnp.array([1.0, 2, -1e9, -1e9])
    )
    assert value == 0
    np.testing.assert_allclose(gradient, 0, atol=1e-7)


@pytest.mark.parametrize(
    ("estimator", "value"), [("k1", np.log(2)), ("k2", np.log(2) ** 2 / 2), ("k3", 0.5 - 1 + np.log(2))]
)
def test_estimators_by_hand(estimator, value):
    """π = .5, ref = .25 at the sampled token: r = ½."""
    ours = estimated_kl(jnp.log(jnp.array(0.5)), jnp.log(jnp.array(0.25)), estimator)
    np.testing.assert_allclose(ours, value, rtol=1e-6)


@pytest.mark.parametrize("estimator", ["k1", "k3"])
def test_k1_and_k3_are_unbiased_values(estimator):
    log_p = jax.nn.log_softmax(THETA)
    np.testing.assert_allclose(jnp.exp(log_p) @ estimated_kl(log_p, REFERENCE, estimator), forward(THETA), rtol=1e-5)


def test_expected_gradient_of_k1_is_zero():
    np.testing.assert_allclose(expected_gradient("k1"), 0, atol=1e-6)


def test_expected_gradient_of_k2_is_that_of_the_kl():
    np.testing.assert_allclose(expected_gradient("k2"), jax.grad(forward)(THETA), atol=1e-6)
    assert jnp.abs(jax.grad(forward)(THETA)).max() > 0.05


def test_expected_gradient_of_k3_is_that_of_the_reverse_kl():
    np.testing.assert_allclose(expected_gradient("k3"), jax.grad(reverse)(THETA), atol=1e-6)
    assert jnp.abs(jax.grad(reverse)(THETA) - jax.grad(forward)(THETA)).max() > 0.05


@pytest.mark.parametrize("estimator", ["k1", "k2", "k3"])
@pytest.mark.parametrize("gap", [-1e9, -1e3, 1e3, 1e9])
def test_clamp_keeps_far_ratios_finite(estimator, gap):
    value, gradient = jax.value_and_grad(lambda x: estimated_kl(x, jnp.array(gap), estimator))(jnp.array(0.0))
    assert jnp.isfinite(value)
    assert jnp.isfinite(gradient)


def test_clamp_leaves_near_ratios_alone():
    near = LOG_RATIO_CLAMP - 1
    np.testing.assert_allclose(estimated_kl(jnp.array(0.0), jnp.array(-near), "k1"), near, rtol=1e-6)


def test_k3_keeps_its_digits_near_zero():
    """exp(x) − 1 − x would round x = 1e-3 to two digits."""
    np.testing.assert_allclose(estimated_kl(jnp.array(0.0), jnp.array(1e-3), "k3"), 5.0016671e-7, rtol=1e-3)
