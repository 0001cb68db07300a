"""Learning problems with a known answer: a bandit, one that only touch can solve, one whose credit comes late."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.grpo import FrozenInputs, make_grpo_step, start_state
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.types import Parsed, Target

P, FNS = 8, tiny.SHALLOW
CONFIG = GRPOConfig(prompts=P, group=8, length=2, micro_prompts=8, algorithm=Paper(beta=0.0, gamma=0.0))
OPTIMIZER = optax.adam(0.02)
PAYS = jnp.array([10, 17])
"""The token that is paid for each label."""


def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
    """1 where the first token is the one that the label pays."""
    reward = (tokens[0] == PAYS[jnp.max(target.label)]).astype(jnp.float32)
    level = jnp.full(tiny.A, -1)
    parsed = Parsed(
        perceive=jnp.tile(level, (tiny.S, 1)),
        compare=level,
        conclude=level,
        formatted=reward > 0,
        truncated=reward > 0,
        length=jnp.int32(2),
    )
    return reward, {}, parsed


@pytest.fixture(scope="module")
def step():
    """One program for both problems: they differ in their batches."""
    return make_grpo_step(FNS, score, OPTIMIZER, CONFIG)


prefill = jax.jit(jax.vmap(FNS.prefill, in_axes=(None, 0, 0, 0)))


def batch_of(pattern: np.ndarray, label: np.ndarray):
    """All ask for hardness and see nothing but touch: one of two patterns, the same in both streams."""
    patterns = tiny.features(3, 2).touch[:, :1]
    batch = tiny.question_batch(0, P)
    one = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), batch)
    touch = jnp.broadcast_to(patterns[pattern], one.features.touch.shape)
    features = one.features.replace(touch=touch, view_mask=jnp.zeros(P, bool))
    return one.replace(features=features, target=tiny.target(np.zeros(P, int), label))


def train(step, batch, steps: int) -> jax.Array:
    """Probability [P] of the paid token after some steps."""
    params = tiny.shallow_params(0, loud=0.2)
    state = start_state(params, OPTIMIZER, jax.random.key(0), CONFIG)
    frozen = FrozenInputs(reference=params, noise=jnp.zeros((1, *batch.features.touch.shape[1:])))
    for _ in range(steps):
        state, _ = step(state, batch, frozen)
    first, _ = prefill(state.params, batch.features, batch.ids, batch.mask)
    return jax.nn.softmax(first)[jnp.arange(P), PAYS[jnp.max(batch.target.label, -1)]]


@pytest.mark.long
def test_touch_is_read(step):
    """Nothing but the pattern of the streams says which token is paid; without it one half is the best."""
    pattern = np.arange(P) % 2
    assert train(step, batch_of(pattern, pattern), 250).mean() >= 0.99


@pytest.mark.long
def test_touch_problem_cannot_be_solved_blind(step):
    """The control: the same pattern in all prompts leaves only guessing."""
    pattern = np.arange(P) % 2
    assert train(step, batch_of(0 * pattern, pattern), 60).mean() <= 0.6


WORDS = np.array([10, 17, 20, 21, 25])
FEW = dataclasses.replace(FNS, banned=~np.isin(np.arange(tiny.V), WORDS))
"""The same policy with five words."""


def two_steps(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
    """10 then 17 pays 1 and everything else nothing: the first word earns its credit by what follows it."""
    paid = (tokens[0] == WORDS[0]) & (tokens[1] == WORDS[1])
    return paid.astype(jnp.float32), {}, score(tokens, target)[2]


@pytest.mark.slow
def test_credit_reaches_the_first_of_two_steps():
    """One rollout in about twenty-five is paid at first."""
    step = make_grpo_step(FEW, two_steps, OPTIMIZER, CONFIG)
    batch = batch_of(np.zeros(P, int), np.zeros(P, int))
    params = tiny.copy(tiny.shallow_params(0, loud=0.2))
    state = start_state(params, OPTIMIZER, jax.random.key(0), CONFIG)
    frozen = FrozenInputs(reference=params, noise=jnp.zeros((1, *batch.features.touch.shape[1:])))
    for _ in range(200):
        state, _ = step(state, batch, frozen)
    best = jnp.tile(jnp.asarray(WORDS[:2], jnp.int32), (1, 1))
    one = jax.tree.map(lambda x: x[0], batch)
    log_p = jax.nn.log_softmax(FEW.group_logits(state.params, one.features, one.ids, one.mask, best))
    assert jnp.exp(token_log_probs(log_p, best).sum()) >= 0.99
