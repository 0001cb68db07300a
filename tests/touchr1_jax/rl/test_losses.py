"""The loss on arrays against NumPy, and its terms by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.rl import reference
from touchr1_jax.rl.config import Average, GRPOConfig, Paper, Surrogate
from touchr1_jax.rl.losses import (
    TokenTerms,
    at_most,
    check_centering,
    divisor,
    entropy,
    estimated_kl,
    exact_kl,
    expected_score,
    group_mean,
    grpo_loss,
    mismatch_parts,
    surrogate,
    token_terms,
)

RATIO = np.array([0.5, 0.9, 1.0, 1.1, 2.0])


def surrogate_of(log_prob, advantage: float):
    """Value, clip flag and d Σ value / d log π of one rollout whose old log-probabilities are 0."""
    algorithm, zero = Paper(clip_low=0.2, clip_high=0.3), jnp.zeros(len(log_prob))
    run = lambda x: surrogate(algorithm, x, zero, zero == 0, jnp.array(advantage))
    x = jnp.asarray(log_prob, jnp.float32)
    return *run(x), jax.grad(lambda x: run(x)[0].sum())(x)


@pytest.mark.parametrize(
    ("advantage", "value", "clipped"),
    [
        (2.0, 2 * np.minimum(RATIO, 1.3), RATIO > 1.3),
        (-2.0, -2 * np.maximum(RATIO, 0.8), RATIO < 0.8),
        (0.0, 0 * RATIO, RATIO < 0),
    ],
    ids=["a good rollout is clipped above", "a bad one below", "one of advantage zero has no gradient"],
)
def test_clip_by_hand(advantage, value, clipped):
    ours, flags, gradient = surrogate_of(np.log(RATIO), advantage)
    np.testing.assert_allclose(ours, value, rtol=1e-6)
    np.testing.assert_array_equal(flags, clipped)
    np.testing.assert_allclose(gradient, np.where(clipped, 0, advantage * RATIO), rtol=1e-5)


@pytest.mark.parametrize("kind", list(Surrogate))
@pytest.mark.parametrize(("low", "high"), [(0.0, 0.2), (0.2, 0.0), (0.0, 0.0)])
@pytest.mark.parametrize("advantage", [2.0, -2.0])
def test_a_ratio_of_one_has_its_whole_gradient_at_the_bound_of_the_clip(kind, low, high, advantage):
    """On policy all ratios are 1: a range that begins or ends there left .75 or .625 of the gradient."""
    algorithm, zero = Paper(surrogate=kind, clip_low=low, clip_high=high), jnp.zeros(3)
    run = lambda x: surrogate(algorithm, x, zero, zero == 0, jnp.array(advantage))
    assert not run(zero)[1].any()
    np.testing.assert_allclose(jax.grad(lambda x: run(x)[0].sum())(zero), advantage, rtol=1e-6)


@pytest.mark.parametrize("gap", [-1e9, 1e9])
def test_far_ratios_stay_finite(gap):
    """A padding token has a log-probability of −1e9; it is masked later, but 0 · ∞ would be NaN."""
    value, _, gradient = surrogate_of([gap], -1.0)
    assert jnp.isfinite(value).all()
    assert jnp.isfinite(gradient).all()


RNG = np.random.default_rng(3)
LOG_PROB = RNG.normal(-1, 0.4, (4, 7))
LEAD = np.array([[0.4], [-0.4], [0.01], [-0.4]])  # of log π over log π_old, rollout by rollout
OLD = LOG_PROB - LEAD - RNG.normal(0, 0.05, (4, 7)) * (np.arange(7) > 0)
OLD[2, :2] = LOG_PROB[2, :2]
MASK = np.arange(7) < np.array([[7], [3], [5], [1]])
ADVANTAGE = np.array([1.2, -0.7, 0.3, -2.0])


@pytest.mark.parametrize("kind", list(Surrogate))
@pytest.mark.parametrize(("low", "high"), [(0.2, 0.28), (0.05, 0.1)])
def test_every_surrogate_equals_an_independent_reference(kind, low, high):
    algorithm = Paper(surrogate=kind, clip_low=low, clip_high=high)
    old, advantage, mask = jnp.asarray(OLD, jnp.float32), jnp.asarray(ADVANTAGE, jnp.float32), jnp.asarray(MASK)
    run = lambda x: surrogate(algorithm, x, old, mask, advantage)
    value, clipped = run(jnp.asarray(LOG_PROB, jnp.float32))
    gradient = jax.grad(lambda x: group_mean(Average.ROLLOUT, run(x)[0], mask, 7))(jnp.asarray(LOG_PROB, jnp.float32))
    expected = reference.surrogate(kind.value, LOG_PROB, OLD, MASK, ADVANTAGE, low, high)
    np.testing.assert_allclose(np.where(MASK, value, 0), np.where(MASK, expected["value"], 0), rtol=2e-5, atol=1e-6)
    np.testing.assert_array_equal(np.where(MASK, clipped, False), np.where(MASK, expected["clipped"], False))
    np.testing.assert_allclose(gradient, expected["gradient"], rtol=2e-4, atol=1e-6)
    assert 0 < np.asarray(clipped)[MASK].sum() < MASK.sum()


def test_a_batch_whose_rollouts_are_all_masked_has_a_mean_of_0():
    config = GRPOConfig(algorithm=Paper(average=Average.BATCH))
    mask = jnp.zeros((2, 3, 4), bool)
    np.testing.assert_array_equal(group_mean(Average.BATCH, jnp.ones((2, 3, 4)), mask, divisor(config, mask)), [0, 0])


def loss_arguments() -> dict[str, np.ndarray]:
    """Random arguments of the loss of three prompts of four rollouts; prompt 1 does not count."""
    rng = np.random.default_rng(0)
    shape = 3, 4, 7
    log_prob = rng.normal(-1, 0.4, shape)
    return {
        "log_prob": log_prob,
        "reference_kl": rng.uniform(0, 1, shape),
        "grounding": rng.uniform(0, 3, shape),
        "entropy": rng.uniform(0, 2, shape),
        "old": log_prob + rng.uniform(-0.5, 0.5, shape),
        "sampler": log_prob + rng.uniform(-0.5, 0.5, shape),
        "mask": np.arange(7) < rng.integers(1, 8, (3, 4, 1)),
        "advantage": rng.normal(size=(3, 4)),
        "weight": np.array([0.5, 0.0, 0.5]),
    }


LOUD = {"beta": 0.1, "entropy_weight": 0.1, "importance_cap": 1.2}


@pytest.mark.parametrize(
    "algorithm",
    [Paper(gamma=0.05, **LOUD), Paper(gamma=0.1, grounding_budget=0.15, entropy_floor_nat=1.0, **LOUD)],
    ids=["free", "up to bounds"],
)
def test_loss_and_parts_are_their_formulas(algorithm):
    """The other options are those of `test_reference_gradients`."""
    arguments = loss_arguments()
    config = GRPOConfig(prompts=4, micro_prompts=4, group=4, length=9, algorithm=algorithm)
    arrays = {name: jnp.asarray(x, bool if x.dtype == bool else jnp.float32) for name, x in arguments.items()}
    terms = TokenTerms(*(arrays.pop(name) for name in ("log_prob", "reference_kl", "grounding", "entropy")))
    loss, parts = grpo_loss(terms, **arrays, config=config)
    expected, means = reference.loss(algorithm, prompts=4, **arguments)
    assert float(loss) == pytest.approx(expected, rel=1e-5, abs=1e-7)  # terms of .1 nearly cancel
    for name, value in means.items():
        np.testing.assert_allclose(parts[name], value, rtol=1e-5, err_msg=name)
    mask = arguments["mask"]
    np.testing.assert_allclose(parts["kl_peak"], np.where(mask, arguments["reference_kl"], 0).max((1, 2)), rtol=1e-6)
    np.testing.assert_allclose(
        parts["grounding_peak"], np.where(mask, arguments["grounding"], 0).max((1, 2)), rtol=1e-6
    )


def test_a_bound_cuts_the_gradient_off():
    gradient = jax.vmap(jax.grad(lambda x: at_most(x, 0.5)))
    np.testing.assert_array_equal(gradient(jnp.array([0.3, 0.7])), [1, 0])
    assert at_most(jnp.array(3.0), None) == 3.0


def test_cap_bounds_the_grounding_of_each_token_and_cuts_its_gradient():
    rng = np.random.default_rng(0)
    branches = [jnp.asarray(rng.normal(0, 2, (4, 6)), jnp.float32) for _ in range(2)]

    def grounding(p, q, cap=None):
        log_p, log_q = jax.nn.log_softmax(p), jax.nn.log_softmax(q)
        return token_terms(Paper(grounding_cap_nat=cap), jnp.zeros(4, jnp.int32), log_p, None, log_q).grounding

    free = grounding(*branches)
    cap = float(jnp.median(free))
    np.testing.assert_allclose(grounding(*branches, cap), np.minimum(free, cap), rtol=1e-6)
    gradient = jax.grad(lambda p, q: grounding(p, q, cap).sum())(*branches)
    np.testing.assert_array_equal(jnp.any(gradient != 0, -1), free < cap)


def test_terms_of_policies_that_are_not_run_are_zero():
    log_p = jax.nn.log_softmax(jnp.asarray(RNG.normal(0, 2, (4, 6)), jnp.float32))
    terms = token_terms(Paper(), jnp.zeros(4, jnp.int32), log_p, None, None)
    assert not terms.reference_kl.any()
    assert not terms.grounding.any()


@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_entropy_has_a_gradient_where_it_is_paid_for(weight):
    algorithm, scores = Paper(entropy_weight=weight), jnp.asarray(RNG.normal(0, 2, (4, 6)), jnp.float32)
    of = lambda x: token_terms(algorithm, jnp.zeros(4, jnp.int32), jax.nn.log_softmax(x), None, None).entropy.sum()
    assert bool(jax.grad(of)(scores).any()) is (weight > 0)


def test_entropy_is_the_distance_from_the_uniform():
    """H(p) = log V − KL(p ‖ uniform), with banned tokens as the decoder writes them."""
    log_p = jax.nn.log_softmax(jnp.array([1.0, 0.3, -2, -1e9]))
    uniform = jax.nn.log_softmax(jnp.array([0.0, 0, 0, -1e9]))
    np.testing.assert_allclose(entropy(log_p), np.log(3) - exact_kl(log_p, uniform), rtol=1e-5)


ESTIMATORS = ("k1", "k2", "k3")


def test_exact_kl_of_equal_distributions_is_zero_even_with_banned_tokens():
    scores = jnp.array([1.0, 2.0, -1e9, -1e9])
    log_p = jax.nn.log_softmax(scores)
    value, gradient = jax.value_and_grad(lambda x: exact_kl(jax.nn.log_softmax(x), log_p))(scores)
    assert value == 0
    np.testing.assert_allclose(gradient, 0, atol=1e-7)


@pytest.mark.parametrize(
    ("estimator", "value"), [("k1", np.log(2)), ("k2", np.log(2) ** 2 / 2), ("k3", 0.5 - 1 + np.log(2))]
)
def test_estimators_by_hand(estimator, value):
    """π = .5, ref = .25 at the sampled token: r = ½."""
    ours = estimated_kl(jnp.log(jnp.array(0.5)), jnp.log(jnp.array(0.25)), estimator)
    np.testing.assert_allclose(ours, value, rtol=1e-6)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("gap", [-1e9, -1e3, 1e3, 1e9])
def test_clamp_keeps_far_ratios_finite(estimator, gap):
    value, gradient = jax.value_and_grad(lambda x: estimated_kl(x, jnp.array(gap), estimator))(jnp.array(0.0))
    assert jnp.isfinite(value)
    assert jnp.isfinite(gradient)


def test_clamp_leaves_near_ratios_alone():
    np.testing.assert_allclose(estimated_kl(jnp.array(0.0), jnp.array(-19.0), "k1"), 19.0, rtol=1e-6)


def test_k3_keeps_its_digits_near_zero():
    """exp(x) − 1 − x would round x = 1e-3 to two digits."""
    np.testing.assert_allclose(estimated_kl(jnp.array(0.0), jnp.array(1e-3), "k3"), 5.0016671e-7, rtol=1e-3)


DRIFTED = np.array([[[2.0, 0.5, 9.0], [3.0, 3.0, 1.0]]])
"""π_old/π_sampler of two rollouts; the last token of the first does not exist."""


@pytest.mark.parametrize(
    ("options", "loss", "dropped"),
    [
        ({}, 0.0, 0.0),  # −(1 − 1) / 2
        ({"importance_cap": 1.5}, 1 / 6, 0.0),  # −((1.5 + .5) / 2 − (1.5 + 1.5 + 1) / 3) / 2
        ({"importance_cap": 1.5, "importance_sequence": True}, 0.25, 0.0),  # −(1 − 1.5) / 2, of products 1 and 9
        ({"mismatch_limit": 0.7}, -0.5, 0.5),  # log 2 = .69 a token stays, 2 log 3 / 3 = .73 goes
        ({"mismatch_limit": 0.69}, 0.0, 1.0),
        ({"mismatch_limit": 0.74, "importance_cap": 1.5}, 1 / 6, 0.0),
    ],
)
def test_weights_and_dropped_rollouts_by_hand(options, loss, dropped):
    log_prob, mask = jnp.full((1, 2, 3), -1.0), jnp.asarray([[[True, True, False], [True, True, True]]])
    terms = TokenTerms(log_prob, *(jnp.zeros((1, 2, 3)),) * 3)
    config = GRPOConfig(prompts=1, micro_prompts=1, group=2, length=3, algorithm=Paper(beta=0.0, gamma=0.0, **options))
    sampler = log_prob - jnp.log(jnp.asarray(DRIFTED))
    found, parts = grpo_loss(terms, log_prob, sampler, mask, jnp.array([[1.0, -1.0]]), jnp.ones(1), config)
    assert float(found) == pytest.approx(loss, abs=1e-6)
    assert float(parts["dropped_share"][0]) == dropped
    assert float(parts["sampler_gap"][0]) == pytest.approx((np.log(2) + 2 * np.log(3) / 3) / 2, rel=1e-6)
    assert float(parts["sampler_gap_peak"][0]) == pytest.approx(np.log(3), rel=1e-6)


def test_the_gap_of_the_sampler_is_that_of_rollouts_with_tokens():
    """A rollout that was cut off and is masked has none: it must not hide the gap of the others."""
    mask = jnp.array([[[True, True], [False, False]]])
    found = mismatch_parts(jnp.full((1, 2, 2), 0.3), mask, jnp.zeros((1, 2), bool))
    assert float(found["sampler_gap"][0]) == pytest.approx(0.3, rel=1e-6)


def test_the_entropy_is_that_of_rollouts_with_tokens():
    """One rollout of .8 nat with a masked one is above a floor of .5, and gets no more bonus."""
    nothing, mask = jnp.zeros((1, 2, 1)), jnp.array([[[True], [False]]])
    algorithm = Paper(beta=0.0, gamma=0.0, mask_truncated=True, entropy_weight=1.0, entropy_floor_nat=0.5)
    config = GRPOConfig(prompts=1, micro_prompts=1, group=2, length=1, algorithm=algorithm)

    def loss(x):
        terms = TokenTerms(nothing, nothing, nothing, x)
        return grpo_loss(terms, nothing, nothing, mask, jnp.zeros((1, 2)), jnp.ones(1), config)

    (_, parts), slopes = jax.value_and_grad(loss, has_aux=True)(jnp.full((1, 2, 1), 0.8))
    assert float(parts["entropy"][0]) == pytest.approx(0.8)
    assert not slopes.any()


@pytest.mark.parametrize(
    ("cap", "slopes"), [(None, [0.1, -0.1]), (2.0, [0.0, 0.0]), (1.0, [0.0, -0.1])], ids=["no cap", "2", "1"]
)
def test_the_expected_score_by_hand(cap, slopes):
    """q = .5, .3 and p = .4, .4 leave both .2: r = 1.  At a cap of 1 only min(.4, .3) − .4 is left."""
    log_p, log_q = jnp.log(jnp.array([0.4, 0.4])), jnp.log(jnp.array([0.5, 0.3]))
    algorithm = Paper(score_centering=2, importance_cap=cap)
    found = jax.grad(lambda x: expected_score(algorithm, x, log_q))(log_p)
    np.testing.assert_allclose(found, slopes, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"surrogate": Surrogate.CISPO}, "surrogate is Surrogate.CISPO: must be Surrogate.TOKEN"),
        ({"importance_sequence": True, "importance_cap": 2.0}, "importance_sequence is True: must be False"),
        ({"minibatches": 2}, "minibatches is 2: must be 1 where score_centering is set; change either"),
        ({"stale": 1}, "stale is 1: must be 0 for score_centering without importance_cap; set a cap"),
    ],
)
def test_what_score_centering_is_not_defined_for_is_named(change, message):
    check_centering(Paper(score_centering=4, stale=1, importance_cap=2.0))
    with pytest.raises(ValueError, match=message):
        check_centering(Paper(score_centering=4, **change))


@pytest.mark.long
def test_rollouts_without_the_samplers_tokens_are_named():
    with pytest.raises(ValueError, match=r"score_centering is set, but rollouts lack .*; set rollouts\.url"):
        expected_score(Paper(score_centering=4), None, None)
