"""The plain program of the timed job computes what the engine computes."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.engine import speed_grpo
from experiments.engine.job import Job, config_of, low_ids
from experiments.engine.plain_program import PlainProgram, grpo_loss, plain_params, sample
from touchr1_jax.rl.advantages import advantages
from touchr1_jax.rl.gradient import Experience, grpo_gradient
from touchr1_jax.types import Rollout

SIZE = dataclasses.replace(speed_grpo.SMOKE.size, group=4, num_layers=2, num_heads=4, num_kv_heads=2)
PREFIX = 20


def moved(params, seed):
    """Parameters at some distance."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: x + 0.1 * rng.normal(size=x.shape).astype(np.float32), params)


@pytest.mark.long
def test_loss_and_gradient_are_those_of_the_engine():
    """Of the same completions, under a policy that has left its reference; the plain ratios are to its own sampler."""
    config, job, prompts = config_of(SIZE), Job(SIZE, PREFIX, config_of(SIZE)), PlainProgram(SIZE, PREFIX, 1).prompts
    policy, reference = moved(job.state.params, 1), moved(job.state.params, 2)
    mine, reference_mine = plain_params(policy, SIZE), plain_params(reference, SIZE)
    tokens, old = jax.jit(sample, static_argnums=0)(SIZE, mine, prompts, jax.random.key(3))
    score = jax.vmap(jax.vmap(low_ids(SIZE.vocab_size, host=False), in_axes=(0, None)))
    reward = score(tokens, job.batch.target)[0]
    learn = Experience(
        batch=job.batch,
        masked_touch=job.batch.features.touch,
        masked_stream=jnp.zeros(SIZE.prompts, jnp.int32),
        rollout=Rollout(tokens=tokens, log_prob=old, mask=jnp.ones(tokens.shape, bool)),
        old=old,
        advantage=advantages(config.algorithm, reward, {}),
        weight=jnp.full(SIZE.prompts, 1 / SIZE.prompts),
    )
    engine = jax.jit(lambda *trees: grpo_gradient(job.fns, config, *trees))
    wanted, parts, _ = engine(policy, reference, learn)
    assert parts["kl"] > 0.01
    loss, grads = jax.jit(jax.value_and_grad(grpo_loss))(mine, reference_mine, prompts, tokens, reward, old)
    chex.assert_trees_all_close(loss, parts["loss"], rtol=1e-5)
    largest = max(float(jnp.abs(x).max()) for x in jax.tree.leaves(grads))
    chex.assert_trees_all_close(grads, plain_params(wanted, SIZE), rtol=1e-5, atol=1e-5 * largest)


@pytest.mark.long
def test_an_iteration_moves_the_policy_and_not_its_reference():
    program = PlainProgram(SIZE, PREFIX, 1)
    before = jax.tree.map(np.array, program.params)
    losses = [float(program.step()) for _ in range(2)]
    assert losses[0] != losses[1]
    chex.assert_trees_all_equal(program.reference, before)
    moves = jax.tree.map(lambda x, y: float(np.abs(x - y).max()), program.params, before)
    assert min(jax.tree.leaves(moves)) > 0
