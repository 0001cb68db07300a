"""Advantages by hand; rounding must not make signal out of equal rewards."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.rl.advantages import (
    added_after,
    advantages,
    batch_advantage,
    best_of,
    group_advantage,
    no_signal,
    prompt_weights,
    segment_advantages,
    zero_variance,
)
from touchr1_jax.rl.config import Advantage, Paper


def test_advantages_by_hand():
    """Mean ½, population σ ½."""
    np.testing.assert_allclose(group_advantage(jnp.array([1.0, 0, 0, 1]), epsilon=0.0), [1, -1, -1, 1], rtol=1e-6)
    # rewards 1, .4, 0, −.1: mean .325, σ² = mean of .675², .075², .325², .425²
    spread = np.sqrt((0.675**2 + 0.075**2 + 0.325**2 + 0.425**2) / 4)
    expected = np.array([0.675, 0.075, -0.325, -0.425]) / (spread + 1e-4)
    np.testing.assert_allclose(group_advantage(jnp.array([1, 0.4, 0, -0.1])), expected, rtol=1e-5)


@pytest.mark.parametrize("value", [1.0, 0.4, 0.0, -0.1])
@pytest.mark.parametrize("group", [2, 3, 5, 7, 8, 16])
@pytest.mark.parametrize("normalise", [True, False])
def test_equal_rewards_give_exactly_zero(value, group, normalise):
    """The mean of G times 0.4 is not 0.4 in float32: σ alone would amplify the difference."""
    reward = jnp.full((3, group), 0.6 * value + 0.3 + 0.1, jnp.float32)
    for rewards in (reward, jnp.full((3, group), value, jnp.float32)):
        assert not group_advantage(rewards, epsilon=0.0 if normalise else 1e-4, normalise=normalise).any()
        assert zero_variance(rewards).all()


@pytest.mark.parametrize("comparison", Advantage)
def test_equal_rewards_give_zero_without_epsilon_too(comparison):
    reward = jnp.full((2, 3), 0.4)
    assert not advantages(Paper(advantage=comparison, epsilon=0.0), reward, {"a": reward}).any()


def test_rewards_of_equal_value_but_unequal_rounding_have_zero_variance():
    reward = jnp.array([0.6 + 0.3 + 0.1, 1.0, 0.1 + 0.2 + 0.7, np.float32(1) + np.float32(2e-7)], jnp.float32)
    assert zero_variance(reward)
    assert not group_advantage(reward).any()
    np.testing.assert_array_equal(zero_variance(jnp.array([[0.5, 0.500005], [0.5, 0.50002]])), [True, False])


def test_zero_variance_groups_have_no_part_in_the_sigma_of_the_batch():
    reward = jnp.array([[1.0, 0.0], [0.4, 0.4], [1.0, 0.5]])
    sigma = np.sqrt((0.25 + 0.0625) / 2)
    expected = np.array([[0.5, -0.5], [0, 0], [0.25, -0.25]]) / sigma
    np.testing.assert_allclose(batch_advantage(reward, epsilon=0.0), expected, rtol=1e-6)
    assert not batch_advantage(jnp.full((2, 3), 0.4)).any()


def by_hand(kind: Advantage, terms: list[np.ndarray]) -> np.ndarray:
    """Advantages of rewards [P, G] in plain NumPy, one rollout after the other."""
    terms, reward, epsilon = [t.astype(float) for t in terms], sum(terms).astype(float), Paper().epsilon

    def of_group(row: np.ndarray) -> np.ndarray:
        return (row - row.mean()) / (row.std() + epsilon)

    match kind:
        case Advantage.GROUP:
            return np.array([of_group(row) for row in reward])
        case Advantage.NONE:
            return np.array([row - row.mean() for row in reward])
        case Advantage.LEAVE_ONE_OUT:
            return np.array([[r - np.delete(row, i).mean() for i, r in enumerate(row)] for row in reward])
        case Advantage.BATCH:
            sigma = np.sqrt(np.mean([row.var() for row in reward]))
            return np.array([row - row.mean() for row in reward]) / (sigma + epsilon)
        case Advantage.GLOBAL:
            return (reward - reward.mean()) / (reward.std() + epsilon)
        case Advantage.PER_REWARD:
            total = sum(np.array([of_group(row) for row in term]) for term in terms)
            return total / (total.std() + epsilon)


@pytest.mark.parametrize("kind", Advantage)
@pytest.mark.parametrize("offset", [0.0, 2.0**20])
def test_every_comparison_equals_numpy(kind, offset):
    """Also of rewards far from 0, whose mean float32 rounds by up to a sixteenth."""
    terms = [np.random.default_rng(seed).random((4, 6)).astype(np.float32) for seed in range(3)]
    terms[0] += np.float32(offset)
    found = advantages(
        Paper(advantage=kind), jnp.asarray(sum(terms)), {str(i): jnp.asarray(t) for i, t in enumerate(terms)}
    )
    np.testing.assert_allclose(found, by_hand(kind, terms), atol=2e-5)


@pytest.mark.parametrize("kind", Advantage)
def test_groups_without_signal_are_those_whose_advantages_are_zero(kind):
    """Of three groups the first and the last have equal totals; of the last, two terms that cancel."""
    a = jnp.array([[0.4, 0.4], [0.6, 0.0], [1.0, 0.0]])
    b = jnp.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    algorithm, terms = Paper(advantage=kind), {"a": a, "b": b}
    idle = no_signal(algorithm, a + b, terms)
    if kind is not Advantage.PER_REWARD:  # where the terms cancel, they do so in the sum of advantages too
        np.testing.assert_array_equal(idle, ~jnp.any(advantages(algorithm, a + b, terms) != 0, -1))
    assert idle.tolist() == {Advantage.GLOBAL: [False, False, False], Advantage.PER_REWARD: [True, False, False]}.get(
        kind, [True, False, True]
    )


@pytest.mark.parametrize("k", [1, 2, 3, 6])
def test_the_best_of_k_is_the_mean_over_all_sets_with_a_rollout(k):
    reward = np.random.default_rng(k).choice([1.0, 0.4, 0.0, -0.1], (5, 6)).astype(np.float32)
    sets = list(itertools.combinations(range(6), k))
    expected = [[np.mean([row[list(s)].max() for s in sets if i in s]) for i in range(6)] for row in reward]
    found = best_of(jnp.asarray(reward)[:, None], k)[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(
        found.mean(-1), [np.mean([row[list(s)].max() for s in sets]) for row in reward], atol=1e-6
    )
    assert "dot_general" not in str(jax.make_jaxpr(lambda x: best_of(x, k))(reward))  # which accelerators round


def test_the_best_of_a_group_is_all_that_counts_where_k_is_its_size():
    """Every rollout then shares the one best answer, and nothing is left to compare."""
    algorithm, reward = Paper(best_of=4), jnp.array([[1.0, 0.0, 0.4, 0.0]])
    assert no_signal(algorithm, reward, {}).all()
    assert not advantages(algorithm, reward, {}).any()


@pytest.mark.parametrize("k", [2, 4])
@pytest.mark.parametrize("worth", [300.1, 1000.3, 3e4])
def test_large_equal_rewards_are_no_signal_for_the_best_of_k_either(worth, k):
    """A sum of weights of 1 in all times 300 rounds by more than `SPREAD_FLOOR`."""
    algorithm, reward = Paper(best_of=k), jnp.full((1, 8), worth)
    np.testing.assert_array_equal(best_of(reward, k), reward)
    assert no_signal(algorithm, reward, {}).all()
    assert not advantages(algorithm, reward, {}).any()


@pytest.mark.parametrize("k", [2, 3])
def test_one_very_low_reward_does_not_round_the_best_of_k_of_the_others(k):
    """It is the largest of no set; before, the others were sums of differences from it, off by up to .05."""
    reward = np.array([0.1, -1e6, 0.3, 0.2, 0.4, 0.1], np.float32)
    sets = list(itertools.combinations(range(6), k))
    expected = [np.mean([reward[list(s)].max() for s in sets if i in s]) for i in range(6)]
    np.testing.assert_allclose(best_of(jnp.asarray(reward)[None], k)[0], expected, atol=1e-6)


def test_a_token_is_credited_with_what_is_not_settled_before_it():
    a, b = jnp.array([[1.0, 0.0, 1.0, 0.0]]), jnp.array([[0.0, 0.0, 1.0, 1.0]])
    algorithm = Paper(advantage=Advantage.NONE, segment_credit=True)
    segment = jnp.broadcast_to(jnp.array([0, 1, 1, 2]), (1, 4, 4))
    found = segment_advantages(algorithm, a + b, {"a": a, "b": b}, {"a": 1}, segment)
    np.testing.assert_allclose(found[..., 0], a + b - 1, atol=1e-6)
    np.testing.assert_allclose(found[..., 2], a + b - 1, atol=1e-6)
    np.testing.assert_allclose(found[..., 3], b - 0.5, atol=1e-6)
    same = segment_advantages(algorithm, a + b, {"a": a, "b": b}, {}, segment)
    np.testing.assert_allclose(same, jnp.broadcast_to((a + b - 1)[..., None], same.shape), atol=1e-6)
    assert not no_signal(algorithm, jnp.ones((1, 2)), {"a": a[:, :2], "b": 1 - a[:, :2]}).any()


def test_credited_segments_compared_over_the_batch_have_signal_though_groups_are_constant():
    """Also groups of one rollout, which only the batch compares."""
    reward = jnp.array([[1.0], [0.0]])
    algorithm = Paper(advantage=Advantage.GLOBAL, segment_credit=True)
    found = segment_advantages(algorithm, reward, {"a": reward}, {}, jnp.zeros((2, 1, 3), int))
    assert (found != 0).all()
    assert not no_signal(algorithm, reward, {"a": reward}).any()
    assert no_signal(algorithm, jnp.ones((2, 1)), {"a": jnp.ones((2, 1))}).all()


def test_a_large_reward_that_is_known_leaves_no_rounding_to_later_segments():
    """In float32, 10,000.3 − 10,000 is not .3; the difference would be an advantage of .7."""
    a, b = jnp.array([[1e4, 0.0, 5e3]]), jnp.full((1, 3), 0.3)
    segment = jnp.ones((1, 3, 2), int)
    found = segment_advantages(Paper(segment_credit=True), a + b, {"a": a, "b": b}, {"a": 0}, segment)
    np.testing.assert_array_equal(found, 0)


def test_a_bonus_after_normalisation_is_centred_in_its_own_group():
    found = added_after(jnp.array([[0.1, 0.1, 0.0], [0.1, 0.0, 0.0]]), 3.0)
    np.testing.assert_allclose(found, [[0.1, 0.1, -0.2], [0.2, -0.1, -0.1]], atol=1e-7)


@pytest.mark.long
def test_weights_of_prompts_that_count():
    np.testing.assert_allclose(prompt_weights(jnp.array([True, False, True, False])), [0.5, 0, 0.5, 0])
    np.testing.assert_array_equal(prompt_weights(jnp.zeros(3, bool)), [0, 0, 0])
