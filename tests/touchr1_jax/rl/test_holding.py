"""What a step samples with can be held elsewhere, and is asked for once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.distributed.problems import grpo
from touchr1_jax.models.lora import LoraConfig, adapt
from touchr1_jax.rl.holding import held, holding


def test_outside_they_are_as_they_are():
    params = {"a": jnp.ones(3)}
    assert held(params) is params


def test_inside_they_are_held_until_it_ends_even_by_an_error():
    with holding(lambda params: params + 1):
        assert held(1) == 2
        with pytest.raises(TypeError), holding(lambda params: params + 2):
            held("words")
        assert held(1) == 2
    assert held(1) == 1


def test_a_step_holds_the_sampler_and_not_the_learner():
    """With its weights held at 0 it draws from the uniform distribution and learns from other weights."""
    problem = grpo()
    batch = jax.tree.map(lambda *x: np.stack(x), *[problem.item(i) for i in range(8)])
    asked = []

    def nothing(params):
        asked.append(jax.tree.structure(params))
        return jax.tree.map(jnp.zeros_like, params)

    with holding(nothing):
        traced = problem.step.trace(problem.state, batch, *problem.shared)
    assert asked == [jax.tree.structure(problem.state.params)]
    found = jax.tree.map(np.asarray, traced.lower().compile()(problem.state, batch, *problem.shared)[1])
    assert found["grad_norm"] > 0


def test_a_frozen_base_is_held_too():
    fns = adapt(tiny.SHALLOW, {"decoder": {"scale": jnp.ones(2)}}, LoraConfig(rank=1))
    doubled = fns.with_context(lambda params: jax.tree.map(lambda x: 2 * x, params))
    assert doubled.base["decoder"]["scale"].tolist() == [2, 2]
    assert tiny.SHALLOW.with_context(lambda params: None) is tiny.SHALLOW
