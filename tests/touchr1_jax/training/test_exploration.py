"""Warm start and reinforcement of a policy that explores: batches, and a run of both stages from the first to the last
step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import explored
from tests.touchr1_jax.explored import BANK, BUDGET, POLICY, T
from touchr1_jax.rewards import RewardError
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.environment import EnvironmentCheckError
from touchr1_jax.rl.touch_reward import Prices
from touchr1_jax.training.exploration import (
    ActiveFeed,
    RandomTouchFeed,
    check_exploration,
    drop_out,
    touch_batch_of,
    train_active,
)
from touchr1_jax.training.loop import Hooks, LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig
from touchr1_jax.training.train_sft import SFTConfig, train_sft

PRICES = Prices(jnp.float32(0.01), jnp.float32(0.0))
WHOLE = dataclasses.replace(BANK, available=np.ones((4, 2), bool))
"""The bank with every contact."""


def test_random_trajectories_are_legal_and_answer_by_the_label():
    feed = RandomTouchFeed(POLICY, WHOLE, batch_size=64, budget=BUDGET, seed=0)
    batch = next(feed)
    known = {tuple(explored.padded(explored.turn_ids(*t))): t for t in explored.trajectories()}
    counts = np.zeros(BUDGET + 1)
    for tokens, touch, exists in zip(
        batch.tokens[:, 0], batch.touch.touch[:, 0], batch.touch.exists[:, 0], strict=True
    ):
        actions, word = known[tuple(tokens)]
        assert len(set(actions)) == len(actions)
        counts[len(actions)] += 1
        levels = {a.levels[k][0] for a in POLICY.language.attributes for k in range(3)}
        assert word in levels
        assert exists[len(actions) :].sum() == 0
        assert (touch[~exists] == 0).all()
    assert counts.min() > 10


def test_the_order_of_the_questions_does_not_tell_what_a_batch_draws():
    """Each has random bits of its own: of epoch 0 and of batch 0 among them."""
    feed, drawn = ActiveFeed(POLICY, WHOLE, batch_size=8, seed=3), []
    feed.make = lambda element, rng: drawn.append((element, rng.permutation(len(feed._object))))
    next(feed)
    order, bits = drawn[0]
    assert not np.array_equal(order, bits[: len(order)])


def test_batches_come_again_from_their_state():
    feed = ActiveFeed(POLICY, WHOLE, batch_size=4, seed=0, dropout=0.3)
    next(feed)
    place = feed.get_state()
    first = next(feed)
    feed.set_state(place)
    jax.tree.map(np.testing.assert_array_equal, first, next(feed))


def test_questions_ask_what_the_bank_knows():
    batch = touch_batch_of(POLICY, BANK, np.array([2, 0]), np.array([1, 0]))
    assert batch.target.asked.tolist() == [[False, True], [True, False]]
    np.testing.assert_array_equal(batch.target.label, BANK.label[[2, 0]])
    assert batch.case.object.tolist() == [2, 0]


def test_whole_motions_and_sensors_drop_out():
    rng = np.random.default_rng(0)
    stays = drop_out(BANK, 500, 0.0, rng)
    assert stays.all()
    wide = dataclasses.replace(
        BANK, choices=tuple(dataclasses.replace(c, sensor=s) for s in ("xense", "tac3d", "gel") for c in BANK.choices)
    )
    stays = drop_out(wide, 2000, 0.3, rng).reshape(-1, 3, 2)
    assert (stays.sum((1, 2)) >= 2).all()
    product = stays.any(2)[:, :, None] & stays.any(1)[:, None]
    np.testing.assert_array_equal(stays, product)
    assert 0.2 < 1 - stays.any(2).mean() < 0.35


@pytest.mark.long
def test_both_stages_run_and_learn():
    bank = jax.tree.map(jnp.asarray, WHOLE)
    sft = SFTConfig(
        steps=30,
        batch_size=8,
        micro_contacts=8,
        optimizer=OptimizerConfig(learning_rate=1e-2, lr_scale=1.0, warmup_steps=2),
    )
    losses, rewards = [], []
    start = POLICY.init(0, explored.W)
    feed = RandomTouchFeed(POLICY, WHOLE, batch_size=8, budget=BUDGET, seed=0)
    warm = train_sft(POLICY, start, feed, sft, Hooks(log=lambda t, m: losses.append(m["loss"])))
    assert losses[-1] < 0.5 * losses[0]
    config = GRPOConfig(prompts=4, group=8, length=T, micro_prompts=4, lr_scale=5e3, algorithm=Paper(constrained=True))
    feed = ActiveFeed(POLICY, WHOLE, batch_size=config.drawn, seed=0)
    hooks = Hooks(log=lambda t, m: rewards.append(m["reward"]))
    found = train_active(POLICY, warm, feed, bank, config, LoopConfig(steps=20), hooks, prices=PRICES, budget=BUDGET)
    assert np.mean(rewards[-5:]) > np.mean(rewards[:5])
    assert jax.tree.structure(found) == jax.tree.structure(warm)


def nan_answer(parsed, target, spent, prices):
    return {"answer": jnp.where(parsed.formatted, jnp.nan, 0.0)}


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"prices": Prices(jnp.float32(9), jnp.float32(0))}, RewardError),
        ({"reward": nan_answer}, RewardError),
        ({"budget": 0}, EnvironmentCheckError),
    ],
)
def test_what_cannot_be_learned_is_named_before_training(changes, error):
    batch = touch_batch_of(POLICY, WHOLE, np.array([0]), np.array([0]))
    with pytest.raises(error):
        check_exploration(POLICY, WHOLE, batch, **{"prices": PRICES, "budget": 2, **changes})


def test_an_object_with_one_contact_is_named_before_training():
    with pytest.raises(EnvironmentCheckError, match=r"\[3\]"):
        ActiveFeed(POLICY, BANK, batch_size=2, seed=0)
