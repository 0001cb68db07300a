"""Numbers that are not finite: a reward's group is left out and named, an optimizer never receives them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl.test_grpo import FNS, FROZEN, P, score
from touchr1_jax.rl import tactile_use
from touchr1_jax.rl.advantages import advantages, of_kept_groups
from touchr1_jax.rl.config import Advantage, GRPOConfig, Paper, TactileUse
from touchr1_jax.rl.grpo import GRPOEngine, make_grpo_step, start_state
from touchr1_jax.rl.scoring import left_out_groups
from touchr1_jax.rl.update import finite_update
from touchr1_jax.skipping import count_skipped, skip_nonfinite
from touchr1_jax.types import SAMPLE, Rollout

CONFIG = GRPOConfig(prompts=P, group=3, length=4, micro_prompts=2, algorithm=Paper(gamma=0.0))
OPTIMIZER = optax.adam(0.05)


BROKEN, EQUAL = 1, 2
"""Labels of the first prompt's question for which each of its answers earns NaN, and the same."""


def worth(tokens, target):
    """What `score` pays, but for the first question."""
    reward, terms, parsed = score(tokens, target)
    value = jnp.where(target.label[0] == BROKEN, jnp.nan, 0.4)
    spread = jnp.where(target.asked[0], value, 0.0)
    return jnp.where(target.asked[0], value, reward), {**terms, "spread": spread}, parsed


@pytest.mark.long
def test_a_reward_that_is_nan_costs_its_group_and_nothing_else():
    """The step is that of a group whose rewards are all equal, which teaches nothing either."""
    step, batch = make_grpo_step(FNS, worth, OPTIMIZER, CONFIG, sampled=True), tiny.question_batch(1, P)

    def learn(label):
        state = start_state(tiny.shallow_params(0), OPTIMIZER, jax.random.key(1), CONFIG)
        target = batch.target.replace(label=jnp.where(batch.target.asked[:, :1], label, batch.target.label))
        return jax.device_get(step(state, batch.replace(target=target), FROZEN))

    (broken, metrics), (equal, others) = learn(BROKEN), learn(EQUAL)
    assert np.isnan(metrics.pop(SAMPLE).reward)
    assert others[SAMPLE].reward == np.float32(0.4)
    jax.tree.map(np.testing.assert_array_equal, broken.params, equal.params)
    assert all(np.isfinite(value) for value in metrics.values())
    assert metrics["nonfinite_share"] == metrics["nonfinite_in_spread"] == 1 / P
    assert metrics["nonfinite_in_right"] == 0


REWARD = jnp.array([[0.2, 0.4], [0.1, jnp.inf], [1.0, 0.0]])
A, B = jnp.array([[0.1, 0.3], [0.1, 0.5], [1.0, 0.0]]), jnp.array([[0.1, 0.1], [0.0, jnp.inf], [0.0, 0.0]])


def test_a_group_that_is_left_out_has_the_mean_of_the_others():
    reward, terms, finite, shares = left_out_groups(REWARD, {"a": A, "b": B})
    np.testing.assert_array_equal(finite, [True, False, True])
    np.testing.assert_allclose(reward, [[0.2, 0.4], [0.4, 0.4], [1.0, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(terms["b"], [[0.1, 0.1], [0.05, 0.05], [0.0, 0.0]], rtol=1e-6)
    expected = {"nonfinite_in_a": 0, "nonfinite_in_b": 1 / 3, "nonfinite_in_total": 0}
    assert {name: pytest.approx(float(share)) for name, share in shares.items()} == expected


@pytest.mark.long
def test_the_literal_bonus_of_a_group_that_is_left_out_is_the_mean_of_the_others(monkeypatch):
    """Its rollouts would otherwise differ, and enter the mean and the σ of the batch."""
    bonus = jnp.arange(3.0 * P).reshape(P, 3)
    monkeypatch.setattr(tactile_use, "tactile_bonus", lambda *given: (bonus, {}))
    config = dataclasses.replace(CONFIG, algorithm=Paper(gamma=0.0, tactile_use=TactileUse.LITERAL))
    batch = tiny.question_batch(1, P)
    label = jnp.where(batch.target.asked[:, :1], BROKEN, batch.target.label)
    tokens = tiny.completions(0, P, 3, 4)
    rollout = Rollout(tokens, jnp.zeros(tokens.shape), jnp.ones(tokens.shape, bool))
    batch = batch.replace(target=batch.target.replace(label=label), rollout=rollout)
    engine = GRPOEngine(FNS, worth, OPTIMIZER, config, None, lambda params: params, None, False)
    group, _ = jax.jit(engine.rollouts)(tiny.shallow_params(0), batch, FROZEN, jax.random.key(0), jax.random.key(1))
    left_out = ~np.asarray(group.finite)
    assert left_out.any()
    np.testing.assert_allclose(group.reward[left_out], jnp.mean(group.reward[~left_out]), rtol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("comparison", "best_of"), [*((each, 1) for each in Advantage), (Advantage.GLOBAL, 2), (Advantage.BATCH, 2)]
)
def test_the_other_advantages_are_those_of_a_batch_without_the_group(comparison, best_of):
    """Also where they are compared with mean and σ of the whole batch, and count by the best of two rollouts.

    Of seven candidates the first five are learned from.
    """
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.normal(size=(7, 4)), jnp.float32) for _ in range(2))
    algorithm, kept = Paper(advantage=comparison, best_of=best_of, epsilon=0.3), np.array([0, 1, 3, 4])
    alone = advantages(algorithm, (a + b)[kept], {"a": a[kept], "b": b[kept]})
    b = b.at[2, 1].set(jnp.nan)
    reward, terms, finite = jax.tree.map(lambda x: x[:5], left_out_groups(a + b, {"a": a, "b": b})[:3])
    found = of_kept_groups(algorithm, advantages(algorithm, reward, terms, finite), finite)
    np.testing.assert_allclose(found[kept], alone, rtol=1e-4)
    np.testing.assert_array_equal(found[2], np.zeros(4))


@pytest.mark.parametrize("big", [[[3e38, 3e38], [1.0, 0.0]], [[1e25, 0.0], [1.0, 0.0]]], ids=["sum", "spread"])
def test_rewards_whose_sum_or_spread_overflows_are_named_too(big):
    """Of an infinite σ every advantage would be 0 without a word."""
    big = jnp.array(big)
    _, _, finite, shares = left_out_groups(big + big, {"a": big, "b": big})
    np.testing.assert_array_equal(finite, [False, True])
    assert (shares["nonfinite_in_a"], shares["nonfinite_in_total"]) == (0, 0.5)
    # those of each group are finite, of the batch not; those of the sum are, of its parts not
    many, parts = jnp.full((4, 2), 1e19), {"a": big, "b": 1 - big}
    assert not left_out_groups(many, {"a": many})[2].any()
    np.testing.assert_array_equal(left_out_groups(jnp.ones((2, 2)), parts)[2], [False, True])


def test_rewards_of_a_callers_own_score_are_squared_in_float32():
    """In 16 bits the square of 300 is infinite."""
    own = jnp.array([[300, 0], [1, 0]], jnp.float16)
    reward, terms, finite, _ = left_out_groups(own, {"a": own})
    assert finite.all()
    assert reward.dtype == terms["a"].dtype == jnp.float32
    np.testing.assert_array_equal(reward, own)


PARAMS = {"w": jnp.arange(3.0)}


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
def test_an_optimizer_of_a_callers_own_never_receives_what_is_not_finite(bad):
    grads = {"w": jnp.array([1.0, bad, 1.0])}
    before = OPTIMIZER.init(PARAMS)
    same = finite_update(OPTIMIZER, grads, optax.tree.norm(grads), before, PARAMS)
    jax.tree.map(np.testing.assert_array_equal, same, (PARAMS, before))
    guarded = skip_nonfinite(OPTIMIZER)
    several = optax.MultiSteps(guarded, 2).gradient_transformation()
    chained = optax.chain(optax.clip_by_global_norm(1.0), guarded)
    for own in (guarded, several, chained, optax.chain(guarded, guarded)):
        params, state = finite_update(own, grads, optax.tree.norm(grads), own.init(PARAMS), PARAMS)
        jax.tree.map(np.testing.assert_array_equal, params, PARAMS)
        assert count_skipped(state).tolist() == [1, 1]
        _, state = finite_update(own, PARAMS, optax.tree.norm(PARAMS), state, PARAMS)
        assert count_skipped(state).tolist() == [1, 0]


def test_finite_gradients_reach_it_as_they_are():
    grads = {"w": jnp.array([1.0, -2.0, 0.5])}
    state = OPTIMIZER.init(PARAMS)
    updates, after = OPTIMIZER.update(grads, state, PARAMS)
    found = finite_update(OPTIMIZER, grads, optax.tree.norm(grads), state, PARAMS)
    jax.tree.map(np.testing.assert_array_equal, found, (optax.apply_updates(PARAMS, updates), after))


@pytest.mark.long
def test_dynamic_sampling_logs_what_it_passed_over():
    """Its candidates' metrics are those of a step that learns from all; the selected ones hide constant groups."""

    def metrics_of(**change) -> dict[str, np.ndarray]:
        algorithm = Paper(beta=0.0, gamma=0.0, candidates=P // change["prompts"])
        config = dataclasses.replace(CONFIG, group=6, algorithm=algorithm, **change)
        step = make_grpo_step(FNS, score, OPTIMIZER, config)
        state = start_state(tiny.shallow_params(0), OPTIMIZER, jax.random.key(1), config)
        return jax.device_get(step(state, tiny.question_batch(1, P), FROZEN))[1]

    chosen, whole = metrics_of(prompts=2), metrics_of(prompts=P)
    of_answers = "reward", "accuracy", "degenerate_share", "all_right_share", "idle_share", "gamed_share"
    for name in (*of_answers, "nonfinite_share", "touch_share"):
        np.testing.assert_allclose(chosen[f"drawn_{name}"], whole[name], rtol=1e-6)
    assert chosen["degenerate_share"] < chosen["drawn_degenerate_share"]
    assert chosen["reward"] != chosen["drawn_reward"]


def test_a_step_that_takes_its_state_leaves_the_callers_key():
    key = jax.random.key(0)
    state = start_state(PARAMS, OPTIMIZER, key, CONFIG)
    jax.jit(lambda state: state, donate_argnums=0)(state)
    jax.random.split(key)


@pytest.mark.long
def test_trained_parameters_have_32_bits():
    """An update of 1e-6 is less than bfloat16 rounds a weight of .02."""
    narrow = {"decoder": {"kernel": jnp.full(3, 0.02, jnp.bfloat16)}}
    with pytest.raises(ValueError, match=r"decoder.*kernel.* is bfloat16: must be float32 where it is trained"):
        start_state(narrow, OPTIMIZER, jax.random.key(0), CONFIG)
