"""Whole steps under other algorithms and options: what each must change, and what none may."""

import dataclasses
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl.test_grpo import FNS, FROZEN, P, score
from touchr1_jax.rewards import make_rewards, uniform_prior
from touchr1_jax.rl.config import (
    Cispo,
    Dapo,
    DrGrpo,
    GRPOConfig,
    Gspo,
    Paper,
    ReinforcePlusPlus,
    Rloo,
    Stable,
    TactileUse,
    left_out,
)
from touchr1_jax.rl.grpo import make_grpo_step, start_state
from touchr1_jax.rl.scoring import make_score, reward_weights
from touchr1_jax.text.parser import compile_parser

G, T = 3, 6
OPTIMIZER = optax.sgd(0.05)
SIZES = GRPOConfig(prompts=P, group=G, length=T, micro_prompts=2)


def take(config: GRPOConfig, steps: int = 1, prompts: int = P, seed: int = 1):
    """State and metrics after some steps on one batch."""
    step = make_grpo_step(FNS, score, OPTIMIZER, config)
    state = start_state(tiny.shallow_params(0), OPTIMIZER, jax.random.key(seed), config)
    batch = tiny.question_batch(1, prompts).replace(ordered=jnp.arange(prompts) % 2 == 0)
    for _ in range(steps):
        state, metrics = step(state, batch, FROZEN)
    return state, jax.device_get(metrics)


def of(algorithm, **changes) -> GRPOConfig:
    return dataclasses.replace(SIZES, algorithm=algorithm, **changes)


def moved(state) -> float:
    leaves = zip(*map(jax.tree.leaves, (state.params, tiny.shallow_params(0))), strict=True)
    return sum(float(jnp.abs(a - b).sum()) for a, b in leaves)


@pytest.fixture(scope="module")
def plain():
    return take(of(Paper()))


@pytest.mark.slow
@pytest.mark.parametrize(
    "algorithm", [DrGrpo(), Gspo(), Cispo(), Rloo(), ReinforcePlusPlus()], ids=lambda a: type(a).__name__
)
def test_published_variants_take_a_finite_step_of_their_own(plain, algorithm):
    state, metrics = take(of(algorithm))
    assert all(np.isfinite(v) for v in metrics.values())
    assert moved(state) > 0
    assert abs(moved(state) - moved(plain[0])) > 1e-4
    assert metrics["reward"] == plain[1]["reward"]  # the same rollouts
    assert "kl" not in metrics  # β is 0: the reference is not even run


@pytest.mark.slow
def test_dynamic_sampling_learns_from_groups_that_differ():
    """Half of the candidates ask for material, whose reward is the same for all."""
    config = of(Dapo(), prompts=2, micro_prompts=2)
    _, metrics = take(config, prompts=config.drawn)
    assert config.drawn == 4
    _, all_of_them = take(of(Dapo(candidates=1)))
    assert all_of_them["degenerate_share"] >= 0.25
    assert metrics["degenerate_share"] <= max(0, all_of_them["degenerate_share"] - 0.25)


@pytest.mark.slow
def test_inner_updates_leave_the_sampler_behind():
    state, metrics = take(of(Paper(updates=3, clip_low=1e-3, clip_high=1e-3)))
    one, first = take(of(Paper(clip_low=1e-3, clip_high=1e-3)))
    assert first["clip_share"] == 0
    assert metrics["clip_share"] > 0
    assert metrics["loss"] == pytest.approx(float(first["loss"]), rel=1e-5)
    assert moved(state) > moved(one)


@pytest.mark.slow
def test_importance_weights_of_an_exact_sampler_are_one(plain):
    _, metrics = take(of(Paper(importance_cap=2.0)))
    for name in ("loss", "grad_norm", "kl"):
        np.testing.assert_allclose(metrics[name], plain[1][name], rtol=1e-3, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("buckets", [(), (2, 4)])
def test_inner_updates_remember_the_learner_before_them(buckets):
    """With an exact sampler the learner before the first of three updates is the sampler, in every bucket."""
    clip = {"updates": 3, "clip_low": 1e-3, "clip_high": 1e-3}
    state, metrics = take(of(Paper(**clip)))
    capped, found = take(of(Paper(**clip, importance_cap=2.0), buckets=buckets))
    np.testing.assert_allclose(found["clip_share"], metrics["clip_share"], atol=0.02)
    for a, b in zip(*map(jax.tree.leaves, (capped.params, state.params)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_the_reference_is_refreshed_on_time():
    config = of(Paper(reference_every=2, beta=0.1))
    state, _ = take(config, 1)
    np.testing.assert_array_equal(*(jax.tree.leaves(x)[0] for x in (state.reference, tiny.shallow_params(0))))
    state, _ = take(config, 2)
    for a, b in zip(*map(jax.tree.leaves, (state.reference, state.params)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.long
def test_a_state_without_a_reference_cannot_refresh_it():
    config = of(Paper(reference_every=2))
    state = start_state(tiny.shallow_params(0), OPTIMIZER, jax.random.key(1), of(Paper()))
    step = make_grpo_step(FNS, score, OPTIMIZER, config)
    with pytest.raises(ValueError, match="the state has no reference; make it with `start_state`"):
        step(state, tiny.question_batch(1, P), FROZEN)


@pytest.mark.slow
@pytest.mark.parametrize("buckets", [(2,), (3, 5)])
def test_buckets_change_nothing_but_the_time(buckets):
    """Rollouts that end early, by banning all words but the end and one more."""
    fns = dataclasses.replace(FNS, banned=~np.isin(np.arange(tiny.V), [1, 10]))
    found = []
    for config in (of(Paper()), of(Paper(), buckets=buckets)):
        step = make_grpo_step(fns, score, OPTIMIZER, config)
        state = start_state(tiny.shallow_params(0), OPTIMIZER, jax.random.key(2), config)
        found.append(step(state, tiny.question_batch(1, P), FROZEN))
    (whole, a), (cut, b) = found
    for name in a:
        np.testing.assert_allclose(a[name], b[name], rtol=1e-4, atol=1e-6, err_msg=name)
    for x, y in zip(*map(jax.tree.leaves, (whole.params, cut.params)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6)


def test_buckets_must_ascend_below_the_length():
    with pytest.raises(ValueError, match=r"buckets is \(6, 3\): must ascend"):
        of(Paper(), buckets=(6, 3))


def test_a_length_is_checked_without_its_memory():
    tracemalloc.start()
    of(Paper(), length=2**20, buckets=(3, 6))
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


@pytest.mark.long
@pytest.mark.parametrize(
    "algorithm",
    [
        Stable(tactile_margin=0.0, controls=1),
        pytest.param(Paper(tactile_use=TactileUse.LITERAL), marks=pytest.mark.slow),
    ],
    ids=["stable", "literal"],
)
def test_tactile_use_samples_the_controls(algorithm):
    state, metrics = take(of(algorithm), seed=0)
    assert {"touch_score", "control_drop", "control_noise", "control_order", "tactile_credit_share"} <= set(metrics)
    assert all(np.isfinite(v) for v in metrics.values())
    assert 0 <= metrics["control_noise"] <= 1
    assert metrics["credit_unearned_share"] == 0
    missing = 0.0 if isinstance(algorithm, Stable) else 1 / 6  # the literal shuffle counts for every other prompt
    assert metrics["control_missing_share"] == pytest.approx(missing, abs=1e-6)
    if algorithm.tactile_use is TactileUse.LITERAL:
        paid = metrics["reward_tactile_use"]
        assert 0 <= paid <= algorithm.tactile_weight * metrics["tactile_credit_share"]
    else:
        assert metrics["bonus_cancelled_share"] < metrics["bonus_telling_share"]
    assert moved(state) > 0


@pytest.mark.long
def test_a_literal_bonus_is_a_term_of_the_reward():
    config = of(Paper(tactile_use=TactileUse.LITERAL))
    step = make_grpo_step(FNS, score, OPTIMIZER, config)
    state = start_state(tiny.shallow_params(0), OPTIMIZER, jax.random.key(0), config)
    _, metrics = jax.eval_shape(step, state, tiny.question_batch(1, P), FROZEN)
    assert {"reward_right", "reward_tactile_use"} <= set(metrics)


@pytest.mark.slow
def test_the_entropy_bonus_raises_entropy():
    _, before = take(of(Paper(entropy_weight=0.0, beta=0.0, gamma=0.0)), 4)
    _, after = take(of(Paper(entropy_weight=1.0, beta=0.0, gamma=0.0)), 4)
    assert after["entropy"] > before["entropy"] + 1e-3


WEIGHTS = {"beta": 0.1, "gamma": 0.05, "entropy_weight": 0.02}


def one_step(key: jax.Array, weights: dict):
    """Metrics and parameters after a step of one run."""
    config = of(Paper(**weights), micro_prompts=P)
    state = start_state(tiny.shallow_params(0), OPTIMIZER, key, config)
    after, metrics = make_grpo_step(FNS, score, OPTIMIZER, config)(state, tiny.question_batch(1, P), FROZEN)
    return after.params, metrics


@pytest.mark.slow
def test_runs_batched_over_seeds_and_weights_are_the_runs_alone():
    keys = jax.vmap(jax.random.key)(np.arange(2))
    params, metrics = jax.jit(jax.vmap(one_step, in_axes=(0, None)))(keys, WEIGHTS)
    for i, key in enumerate(keys):
        alone, expected = one_step(key, WEIGHTS)
        for name, value in expected.items():
            np.testing.assert_allclose(metrics[name][i], value, rtol=2e-4, atol=1e-5, err_msg=name)
        for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-4, atol=1e-5)


def test_only_the_number_zero_leaves_a_term_out():
    assert left_out(0.0)
    assert not left_out(1e-9)
    assert not left_out(jax.numpy.zeros(()))


def test_constrained_sampling_needs_a_constraint():
    with pytest.raises(ValueError, match="constrained is True, but there is no constraint"):
        make_grpo_step(FNS, score, OPTIMIZER, of(Paper(constrained=True)))


def test_the_stable_preset_takes_no_published_reward():
    """Answers without touch outwit them; `reward_weights` takes their stable forms."""
    rewards, parser = make_rewards(uniform_prior((3, 3, 3, 9))), compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)
    published = {"accuracy": 0.9, "format": 0.1}
    with pytest.raises(ValueError, match="stable_rewards is True, but the score weighs accuracy, format: must"):
        make_grpo_step(FNS, make_score(parser, rewards, published), OPTIMIZER, of(Stable()))
    stable = make_score(parser, rewards, reward_weights(Stable(), published))
    make_grpo_step(FNS, stable, OPTIMIZER, of(Stable()))


def test_a_score_that_knows_no_rewards_cannot_credit_segments():
    with pytest.raises(ValueError, match="segment_credit is True"):
        make_grpo_step(FNS, score, OPTIMIZER, of(Paper(segment_credit=True)))


def test_minibatches_are_refused_where_scores_are_centered():
    """Whoever draws the rollouts: after the first optimizer step ratios are no longer 1."""
    with pytest.raises(ValueError, match="minibatches is 2: must be 1 where score_centering is set"):
        make_grpo_step(FNS, score, OPTIMIZER, of(Paper(score_centering=2, minibatches=2)))


@pytest.mark.slow
@pytest.mark.parametrize("buckets", [(), (2, 4)])
def test_without_a_reward_that_is_settled_early_segments_change_nothing(buckets):
    rewards, parser = make_rewards(uniform_prior((3, 3, 3, 9))), compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)
    found = []
    for segment_credit in (False, True):
        config = of(Paper(segment_credit=segment_credit), buckets=buckets)
        step = make_grpo_step(FNS, make_score(parser, rewards, {"accuracy": 0.9, "format": 0.1}), OPTIMIZER, config)
        state, metrics = step(
            start_state(tiny.shallow_params(0), OPTIMIZER, jax.random.key(1), config), tiny.question_batch(1, P), FROZEN
        )
        assert all(np.isfinite(v) for v in metrics.values())
        found.append(state.params)
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
