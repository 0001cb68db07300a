"""Whole steps batched over runs, with traced weights: each run is the one that it would be alone."""

import dataclasses

import jax
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl.test_grpo import FNS, FROZEN, P, score
from touchr1_jax.rl.config import GRPOConfig, Paper, left_out
from touchr1_jax.rl.grpo import make_grpo_step, start_state

OPTIMIZER = optax.sgd(0.05)
SIZES = GRPOConfig(prompts=P, group=3, length=4, micro_prompts=P)
WEIGHTS = {"beta": 0.1, "gamma": 0.05, "entropy_weight": 0.02}


def one_step(key: jax.Array, weights: dict):
    """Metrics and parameters after a step of one run."""
    config = dataclasses.replace(SIZES, algorithm=Paper(**weights))
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
        make_grpo_step(FNS, score, OPTIMIZER, dataclasses.replace(SIZES, algorithm=Paper(constrained=True)))
