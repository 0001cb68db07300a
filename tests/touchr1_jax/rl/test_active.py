"""GRPO on trajectories: its gradient is that of the expected reward, and one program serves a sweep of prices."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import explored
from tests.touchr1_jax.explored import BANK, BUDGET, POLICY, SHALLOW, N, T
from touchr1_jax.models.active_policy import Explored
from touchr1_jax.models.policy import Policy
from touchr1_jax.rl import active
from touchr1_jax.rl.active import (
    ActiveEngine,
    ActiveInputs,
    check_active_config,
    exploration_metrics,
    make_active_step,
    mutual_information,
)
from touchr1_jax.rl.config import DrGrpo, GRPOConfig, Norm, Paper, Stable
from touchr1_jax.rl.gradient import Experience, grpo_gradient
from touchr1_jax.rl.grpo import start_state
from touchr1_jax.rl.touch_reward import Prices, priced_answer
from touchr1_jax.rl.trajectory import Trajectories, sample_trajectories
from touchr1_jax.types import Rollout

PRICES = Prices(jnp.float32(0.05), jnp.float32(0.1))
PATHS = explored.trajectories()
OBJECT, ASKED = 1, 0


def reward_of(actions, word) -> float:
    """Reward of a trajectory of the object and question."""
    words = [levels[0] for levels in POLICY.language.attributes[ASKED].levels]
    answer = -0.1 if word not in words else float(words.index(word) == BANK.label[OBJECT, ASKED])
    return float(
        answer - 0.05 * BANK.seconds[OBJECT, list(actions)].sum() - 0.1 * BANK.harm[OBJECT, list(actions)].sum()
    )


REWARD = np.array([reward_of(*path) for path in PATHS])


def listed_log_probs(params) -> jax.Array:
    """log π of every trajectory: a plain causal pass over prompt, turns and observations without gaps.

    The probability of a token is that among the tokens with which some listed trajectory goes on.
    """
    question = POLICY.ids[ASKED][POLICY.mask[ASKED]].tolist()
    rows, goes_on = [], {}
    for actions, word in PATHS:
        row = [(token, None) for token in question]
        for i, turn in enumerate(explored.turn_ids(actions, word)):
            for token in turn:
                goes_on.setdefault(tuple(row), set()).add(token)
                row.append((token, None))
            row += [(0, (actions[i], n)) for n in range(N)] if i < len(actions) else []
        rows.append(row)
    width = max(map(len, rows))
    ids = np.array([[t for t, _ in row] + [0] * (width - len(row)) for row in rows])
    choice, token = (
        np.array([[-1 if s is None else s[k] for _, s in row] + [-1] * (width - len(row)) for row in rows])
        for k in (0, 1)
    )
    exists = np.array([[i < len(row) for i in range(width)] for row in rows])
    after = np.zeros((len(rows), width, POLICY.tokenizer.vocab_size), bool)
    scored = np.zeros((len(rows), width), bool)
    for r, row in enumerate(rows):
        for i in range(len(question) - 1, len(row) - 1):
            if row[i + 1][1] is None:
                after[r, i, list(goes_on[tuple(row[: i + 1])])] = scored[r, i] = True
    seen = jnp.asarray(BANK.tokens[OBJECT])[np.maximum(choice, 0), np.maximum(token, 0)]

    def states(module: Policy) -> jax.Array:
        x = jnp.where((choice >= 0)[..., None], module.project(seen), module.embed(jnp.asarray(ids)))
        places = jnp.broadcast_to(jnp.arange(width), (3, width))
        hidden = jax.vmap(lambda x, m: module.decoder.states(x, places, m)[0])(x, jnp.asarray(exists))
        return module.decoder.logits(hidden, jnp.asarray(POLICY.fns.banned))

    logits = POLICY.fns.module.apply({"params": params}, method=states)
    log_p = jax.nn.log_softmax(jnp.where(after, logits, -jnp.inf))
    following = jnp.asarray(np.roll(ids, -1, 1))[..., None]
    return jnp.sum(jnp.where(scored, jnp.take_along_axis(log_p, following, -1)[..., 0], 0.0), -1)


@pytest.fixture(scope="module")
def exact():
    """log π of every trajectory, and the gradient of the expected reward."""
    expected = lambda p: (jnp.exp(log_p := listed_log_probs(p)) @ jnp.asarray(REWARD, jnp.float32), log_p)
    grads, log_p = jax.jit(jax.grad(expected, has_aux=True))(explored.params())
    return np.asarray(log_p, np.float64), grads


@pytest.mark.long
def test_the_list_is_complete(exact):
    np.testing.assert_allclose(np.exp(exact[0]).sum(), 1, atol=1e-5)


def experience(log_p: np.ndarray) -> Experience:
    """All trajectories as one group, each with the advantage π(τ) R(τ), up to the loss's means."""
    g = len(PATHS)
    touch, exists = np.zeros((g, BUDGET, N, explored.W), np.float32), np.zeros((g, BUDGET, N), bool)
    for i, (actions, _) in enumerate(PATHS):
        touch[i, : len(actions)], exists[i, : len(actions)] = BANK.tokens[OBJECT, list(actions)], True
    tokens = np.stack([explored.padded(explored.turn_ids(*path)) for path in PATHS])[None]
    mask = jnp.asarray(tokens != POLICY.tokenizer.pad_id)
    batch = jax.tree.map(lambda x: x[1:], explored.batch_of(0, OBJECT, OBJECT))
    batch = jax.tree.map(lambda x: x[1:], batch)
    seen = Explored(batch.features, jnp.asarray(touch)[None], jnp.asarray(exists)[None], jnp.ones((1, 1), bool))
    rollout = Rollout(tokens=jnp.asarray(tokens), log_prob=jnp.zeros(mask.shape), mask=mask)
    advantage = jnp.asarray(np.exp(log_p) * REWARD * g * T, jnp.float32)[None]
    return Experience(
        batch=dataclasses.replace(batch, features=seen),
        masked_touch=seen.touch,
        masked_stream=jnp.zeros(1, jnp.int32),
        rollout=rollout,
        old=rollout.log_prob,
        advantage=advantage,
        weight=jnp.ones(1),
    )


@pytest.mark.long
def test_gradient_is_that_of_the_expected_reward(exact):
    log_p, expected = exact
    config = GRPOConfig(prompts=1, micro_prompts=1, group=len(PATHS), length=T, algorithm=DrGrpo(constrained=True))
    fns = POLICY.constrained_fns
    run = jax.jit(lambda p: grpo_gradient(fns, config, p, p, experience(log_p))[::2])
    grads, old = run(explored.params())
    np.testing.assert_allclose(old[0].sum(-1, where=np.asarray(experience(log_p).rollout.mask)[0]), log_p, atol=1e-5)
    for found, exact_grad in zip(jax.tree.leaves(grads), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(-found, exact_grad, atol=1e-5)


STEP = GRPOConfig(prompts=4, group=4, length=T, micro_prompts=2, algorithm=Paper(constrained=True))


@pytest.mark.long
def test_one_program_serves_all_prices_and_batches():
    optimizer = optax.sgd(1e-3)
    step = make_active_step(SHALLOW.constrained_fns, optimizer, STEP, BUDGET)
    start = explored.params(SHALLOW)
    state = start_state(start, optimizer, jax.random.key(0), STEP)
    bank = jax.tree.map(jnp.asarray, BANK)
    for price, objects in ((0.0, (0, 1, 2, 3)), (0.5, (3, 2, 1, 0))):
        inputs = ActiveInputs(start, bank, Prices(jnp.float32(price), jnp.float32(price)))
        state, metrics = step(state, explored.batch_of(*objects), inputs)
        np.testing.assert_allclose(metrics["reward_seconds"], -price * metrics["seconds"], rtol=1e-5)
        assert metrics["sampler_gap_peak"] < 1e-5
        assert metrics["grad_norm"] > 0
        assert metrics["grounding"] > 0
    assert step._cache_size() == 1


def one_malformed(*given) -> Trajectories:
    """Drawn trajectories, of which the first names a conclusion where its touch should stand, and ends there."""
    found = sample_trajectories(*given)
    turn = jnp.asarray(POLICY.tokenizer.encode("<touch> <conclude>"))
    tokens = found.rollout.tokens.at[0, 0].set(POLICY.tokenizer.pad_id).at[0, 0, : len(turn)].set(turn)
    mask = found.rollout.mask.at[0, 0].set(jnp.arange(T) < len(turn))
    parsed = found.parsed.replace(conclude=found.parsed.conclude.at[0, 0].set(-1))
    return found.replace(rollout=found.rollout.replace(tokens=tokens, mask=mask), parsed=parsed)


@pytest.mark.long
def test_answers_are_enumerated_with_the_price_of_their_touches(monkeypatch):
    """Each level earns what a trajectory with that answer does; one that ended without a conclusion states none."""
    monkeypatch.setattr(active, "sample_trajectories", one_malformed)
    algorithm = Paper(constrained=True, gamma=0.0, beta=0.0, enumerated=Norm.NONE, learn_conclusion=False)
    config = dataclasses.replace(STEP, algorithm=algorithm)
    fns, optimizer, bank = SHALLOW.constrained_fns, optax.sgd(1e-3), jax.tree.map(jnp.asarray, BANK)
    engine = ActiveEngine(fns, priced_answer, optimizer, config, None, lambda p: p, fns.levels, False, BUDGET)
    inputs, batch = ActiveInputs(explored.params(SHALLOW), bank, PRICES), explored.batch_of(0, 1, 2, 3)
    key = jax.random.key(0)
    group, metrics = jax.jit(lambda: engine.rollouts(inputs.reference, batch, inputs, key, key))()
    label = BANK.label[np.arange(4), np.arange(4) % 2]
    right = label[:, None, None] == np.arange(3)
    cost = group.terms["seconds"] + group.terms["harm"]
    np.testing.assert_allclose(group.levels.reward, right + cost[..., None], atol=1e-6)
    assert group.levels.at[0, 0] == T
    last = np.minimum(group.levels.at, T - 1)
    word = np.take_along_axis(np.asarray(group.rollout.tokens), last[..., None], -1)[..., 0]
    answered = (word[..., None] == np.asarray(group.levels.ids)[:, None]) @ np.arange(1, 4) - 1
    np.testing.assert_array_equal(answered, np.asarray(group.parsed.conclude)[np.arange(4), :, np.arange(4) % 2])
    assert 0 <= metrics["first_kind_information"] < np.log(2)


def test_information_of_a_question_about_a_kind():
    """Independent: 0.  One kind for each of two questions: log 2.  No action at all: 0."""
    tables = {0.0: [[2, 4], [1, 2]], np.log(2): [[3, 0], [0, 3]]}
    for nat, count in tables.items():
        np.testing.assert_allclose(mutual_information(jnp.asarray(count, jnp.float32)), nat, atol=1e-6)
    assert mutual_information(jnp.zeros((2, 2))) == 0


def test_statistics_of_actions_by_hand():
    """Two trajectories of each of three prompts, two of one question: 1, 2, 0, 2, 0, 0 actions; one is silent."""
    action = np.array([[[0, -1], [1, 0]], [[-1, -1], [0, 1]], [[-1, -1], [-1, -1]]])
    exists = np.repeat((action >= 0)[..., None], 3, -1)
    exists[0, 1, 1] = False
    found = types.SimpleNamespace(action=action, exists=exists, seconds=np.ones((3, 2)), harm=np.zeros((3, 2)))
    batch = types.SimpleNamespace(target=types.SimpleNamespace(asked=np.eye(2, dtype=bool)[[0, 1, 1]]))
    metrics = jax.jit(lambda: exploration_metrics(found, batch, ("press", "slide")))()
    assert {name: float(value) for name, value in metrics.items()} == pytest.approx(
        {
            "actions": 5 / 6,
            "seconds": 1,
            "harm": 0,
            "no_action_share": 3 / 6,
            "one_action_share": 1 / 6,
            "all_actions_share": 2 / 6,
            "silent_share": 1 / 5,
            "first_kind_peak": 2 / 3,
            "first_kind_information": np.log(27 / 16) / 3,
            "kinds": 2,
            "questions": 2,
            "budget": 2,
        }
    )


WRONG = {
    "budget": (STEP, 0),
    "length": (STEP, BUDGET + 1),
    "constrained": (dataclasses.replace(STEP, algorithm=Paper()), BUDGET),
    "tactile_use": (dataclasses.replace(STEP, algorithm=Stable(constrained=True)), BUDGET),
    "stable_rewards": (dataclasses.replace(STEP, algorithm=Paper(constrained=True, stable_rewards=True)), BUDGET),
    "segment_credit": (dataclasses.replace(STEP, algorithm=Paper(constrained=True, segment_credit=True)), BUDGET),
    "buckets": (dataclasses.replace(STEP, buckets=(5,)), BUDGET),
}


@pytest.mark.parametrize("field", WRONG)
def test_settings_that_trajectories_cannot_have_are_named(field):
    config, budget = WRONG[field]
    with pytest.raises(ValueError, match=field):
        check_active_config(POLICY.constrained_fns, config, budget)
