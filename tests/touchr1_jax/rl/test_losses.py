"""The terms of the objective by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.rl import reference
from touchr1_jax.rl.config import Average, Paper, Surrogate
from touchr1_jax.rl.kl import exact_kl
from touchr1_jax.rl.losses import (
    cispo_surrogate,
    clipped_surrogate,
    entropy,
    entropy_bonus,
    grounding_kl,
    group_mean,
    importance_weight,
    sequence_surrogate,
    surrogate,
    token_log_probs,
)

RATIO = np.array([0.5, 0.9, 1.0, 1.1, 2.0])


def clipped_at(advantage: float, low: float = 0.2, high: float = 0.3):
    """Value, clip flag and d value / d log π of each ratio."""
    run = lambda x: clipped_surrogate(x, jnp.zeros(5), jnp.array(advantage), low, high)
    log_prob = jnp.log(jnp.asarray(RATIO, jnp.float32))
    return *run(log_prob), jax.grad(lambda x: run(x)[0].sum())(log_prob)


def test_positive_advantage_is_clipped_above_alone():
    value, clipped, gradient = clipped_at(2.0)
    np.testing.assert_allclose(value, 2 * np.minimum(RATIO, 1.3), rtol=1e-6)
    np.testing.assert_array_equal(clipped, RATIO > 1.3)
    np.testing.assert_allclose(gradient, np.where(RATIO > 1.3, 0, 2 * RATIO), rtol=1e-5)


def test_negative_advantage_is_clipped_below_alone():
    value, clipped, gradient = clipped_at(-2.0)
    np.testing.assert_allclose(value, -2 * np.maximum(RATIO, 0.8), rtol=1e-6)
    np.testing.assert_array_equal(clipped, RATIO < 0.8)
    np.testing.assert_allclose(gradient, np.where(RATIO < 0.8, 0, -2 * RATIO), rtol=1e-5)


def test_zero_advantage_has_no_gradient():
    value, clipped, gradient = clipped_at(0.0)
    assert not value.any()
    assert not clipped.any()
    assert not gradient.any()


def test_on_policy_gradient_is_the_policy_gradient():
    gradient = jax.grad(lambda x: clipped_surrogate(x, jnp.array([-3.0]), jnp.array(1.5), 0.2, 0.2)[0].sum())
    np.testing.assert_allclose(gradient(jnp.array([-3.0])), [1.5], rtol=1e-6)


def test_far_ratios_stay_finite():
    """A padding token has a log-probability of −1e9; it is masked later, but 0 · ∞ would be NaN."""
    for gap in (-1e9, 1e9):
        run = lambda x: clipped_surrogate(x, jnp.array([0.0]), jnp.array(-1.0), 0.2, 0.2)[0].sum()
        value, gradient = jax.value_and_grad(run)(jnp.array([gap]))
        assert jnp.isfinite(value)
        assert jnp.isfinite(gradient).all()


@pytest.fixture
def branches():
    """Scores [T, V] under the true and the perturbed touch."""
    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.normal(0, 2, (4, 6)), jnp.float32) for _ in range(2)]


def grounding(p, q, **kwargs):
    return grounding_kl(jax.nn.log_softmax(p), jax.nn.log_softmax(q), **kwargs).sum()


def test_grounding_is_the_exact_kl_and_zero_when_nothing_is_perturbed(branches):
    p, q = (np.asarray(jax.nn.softmax(x), np.float64) for x in branches)
    ours = grounding_kl(*map(jax.nn.log_softmax, branches), stop_masked=False, cap=None)
    np.testing.assert_allclose(ours, (p * np.log(p / q)).sum(-1), rtol=1e-5)
    assert not grounding_kl(*[jax.nn.log_softmax(branches[0])] * 2, stop_masked=False, cap=None).any()


def test_cap_bounds_each_token_and_cuts_its_gradient(branches):
    free = grounding_kl(*map(jax.nn.log_softmax, branches), stop_masked=False, cap=None)
    cap = float(jnp.median(free))
    ours = grounding_kl(*map(jax.nn.log_softmax, branches), stop_masked=False, cap=cap)
    np.testing.assert_allclose(ours, np.minimum(free, cap), rtol=1e-6)
    gradient = jax.grad(grounding)(*branches, stop_masked=False, cap=cap)
    np.testing.assert_array_equal(jnp.any(gradient != 0, -1), free < cap)


def test_stopped_branch_has_no_gradient_and_the_free_one_has(branches):
    gradient = lambda stop: jax.grad(grounding, (0, 1))(*branches, stop_masked=stop, cap=None)
    (true_free, masked_free), (true_stopped, masked_stopped) = gradient(False), gradient(True)
    np.testing.assert_array_equal(true_free, true_stopped)
    assert not masked_stopped.any()
    q, p = jax.nn.softmax(branches[1]), jax.nn.softmax(branches[0])
    np.testing.assert_allclose(masked_free, q - p, atol=1e-5)  # ∇_q KL(p ‖ softmax q)


def test_token_log_probs_and_entropy_by_hand():
    log_p = jnp.log(jnp.array([[0.5, 0.25, 0.25], [1.0, 0.0, 0.0]]).clip(1e-30))
    np.testing.assert_allclose(token_log_probs(log_p, jnp.array([1, 0])), [np.log(0.25), 0], rtol=1e-6)
    np.testing.assert_allclose(entropy(log_p), [1.5 * np.log(2), 0], atol=1e-6)


def test_entropy_of_the_uniform_is_its_distance_from_nothing():
    """H(p) = log V − KL(p ‖ uniform), with banned tokens as the decoder writes them."""
    log_p = jax.nn.log_softmax(jnp.array([1.0, 0.3, -2, -1e9]))
    uniform = jax.nn.log_softmax(jnp.array([0.0, 0, 0, -1e9]))
    np.testing.assert_allclose(entropy(log_p), np.log(3) - exact_kl(log_p, uniform), rtol=1e-5)


RNG = np.random.default_rng(3)
LOG_PROB = RNG.normal(-1, 0.4, (4, 7))
LEAD = np.array([[0.4], [-0.4], [0.01], [-0.4]])  # of log π over log π_old, rollout by rollout
OLD = LOG_PROB - LEAD - RNG.normal(0, 0.05, (4, 7)) * (np.arange(7) > 0)
OLD[2, :2] = LOG_PROB[2, :2]
MASK = np.arange(7) < np.array([[7], [3], [5], [1]])
ADVANTAGE = np.array([1.2, -0.7, 0.3, -2.0])


def batched(kind: Surrogate, low: float, high: float):
    """Objective [G, T], clip flags and the gradient of its group mean by rollout, under the configured surrogate."""
    algorithm = Paper(surrogate=kind, clip_low=low, clip_high=high)
    rollouts = jax.vmap(lambda *x: surrogate(algorithm, *x))
    args = [jnp.asarray(x, jnp.float32) if x.dtype != bool else jnp.asarray(x) for x in (OLD, MASK, ADVANTAGE)]
    value, clipped = rollouts(jnp.asarray(LOG_PROB, jnp.float32), *args)
    mean = lambda x: group_mean(Average.ROLLOUT, rollouts(x, *args)[0], args[1], 7)
    return value, clipped, jax.grad(mean)(jnp.asarray(LOG_PROB, jnp.float32))


@pytest.mark.parametrize("kind", list(Surrogate))
@pytest.mark.parametrize(("low", "high"), [(0.2, 0.28), (0.05, 0.1)])
def test_every_surrogate_equals_an_independent_reference(kind, low, high):
    value, clipped, gradient = batched(kind, low, high)
    expected = reference.surrogate(kind.value, LOG_PROB, OLD, MASK, ADVANTAGE, low, high)
    np.testing.assert_allclose(np.where(MASK, value, 0), np.where(MASK, expected["value"], 0), rtol=2e-5, atol=1e-6)
    np.testing.assert_array_equal(np.where(MASK, clipped, False), np.where(MASK, expected["clipped"], False))
    np.testing.assert_allclose(gradient, expected["gradient"], rtol=2e-4, atol=1e-6)
    assert np.asarray(clipped)[MASK].any()
    assert not np.asarray(clipped)[MASK].all()


def test_sequence_ratio_by_hand():
    """Two tokens, ratios e^.2 and 1: s = e^.1, clipped at 1.05 for a good answer, free for a bad one."""
    run = lambda a: sequence_surrogate(
        jnp.array([0.2, 0.0, 9.0]), jnp.zeros(3), jnp.array([True, True, False]), jnp.array(a), 0.05, 0.05
    )
    np.testing.assert_allclose(run(2.0)[0][:2], [2.1, 2.1], rtol=1e-6)
    assert run(2.0)[1][:2].all()
    np.testing.assert_allclose(run(-2.0)[0][:2], -2 * np.exp(0.1), rtol=1e-6)


def test_cispo_keeps_the_gradient_of_clipped_tokens():
    run = lambda x: cispo_surrogate(x, jnp.zeros(3), jnp.array(1.5), 1.0, 0.5)
    log_prob = jnp.log(jnp.array([0.5, 1.0, 4.0]))
    np.testing.assert_allclose(jax.grad(lambda x: run(x)[0].sum())(log_prob), 1.5 * np.array([0.5, 1, 1.5]), rtol=1e-6)
    np.testing.assert_array_equal(run(log_prob)[1], [False, False, True])


def test_importance_weight_is_truncated():
    weight = importance_weight(jnp.log(jnp.array([0.2, 0.2, 0.9])), jnp.log(jnp.array([0.4, 0.2, 0.1])), 2.0)
    np.testing.assert_allclose(weight, [0.5, 1, 2], rtol=1e-6)


def test_group_means_by_hand():
    x = jnp.array([[1.0, 2, 3, 4], [10.0, -99, -99, -99]])
    mask = jnp.array([[True] * 4, [True] + [False] * 3])
    assert group_mean(Average.ROLLOUT, x, mask, 4) == pytest.approx((2.5 + 10) / 2)
    assert group_mean(Average.TOKEN, x, mask, 4) == pytest.approx(20 / 5)
    assert group_mean(Average.LENGTH, x, mask, 5) == pytest.approx((10 / 5 + 10 / 5) / 2)


def test_entropy_bonus_stops_at_its_floor():
    assert entropy_bonus(jnp.array(0.7), Paper(entropy_weight=0.1)) == pytest.approx(0.07)
    floored = Paper(entropy_weight=0.1, entropy_floor_nat=0.5)
    value, gradient = jax.value_and_grad(lambda h: entropy_bonus(h, floored))(jnp.array(0.7))
    assert (float(value), float(gradient)) == pytest.approx((0.05, 0.0))
    assert jax.grad(lambda h: entropy_bonus(h, floored))(jnp.array(0.3)) == pytest.approx(0.1)
