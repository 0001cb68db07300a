"""Rewards in the graph and on the host: one interface, and faults that are named when the step is traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rewards import Reward, make_rewards
from touchr1_jax.rl.scoring import check_finite, make_host_score, make_score
from touchr1_jax.text.parser import compile_parser

PARSER = compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)
REWARDS = make_rewards(np.array([[1 / 3] * 3 + [0] * 6] * 3 + [[1 / 9] * 9]))
WEIGHTS = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
TARGET = tiny.target(np.zeros(3, int), np.array([0, 1, 2]))
TOKENS = tiny.completions(0, 3, 4, 8)


def batched(score):
    return jax.jit(jax.vmap(jax.vmap(score, in_axes=(0, None))))(TOKENS, TARGET)


def test_host_reward_equals_the_traced_one():
    """The same formula in NumPy, called once per rollout on the host."""

    def plain(tokens, parsed, target):
        assert tokens.shape == (8,)
        return {
            "format": 0.1 * float(parsed.formatted),
            "length": float(parsed.length) / 8 * float(target.label[0] == 1),
        }

    reward, terms, parsed = batched(make_host_score(PARSER, plain, ("format", "length")))
    np.testing.assert_allclose(terms["format"], 0.1 * np.asarray(parsed.formatted))
    np.testing.assert_allclose(terms["length"], np.asarray(parsed.length) / 8 * (np.arange(3) == 1)[:, None])
    np.testing.assert_allclose(reward, terms["format"] + terms["length"], rtol=1e-6)


@pytest.mark.parametrize(
    ("returned", "message"),
    [({"b": 1.0}, r"returned terms \['b'\]: must be \['a'\]"), ({"a": np.nan}, "'a' is nan: must be finite")],
)
def test_faults_of_a_host_reward_are_named(returned, message):
    with pytest.raises(Exception, match=message):
        jax.block_until_ready(batched(make_host_score(PARSER, lambda *_: returned, ("a",))))


@pytest.mark.parametrize("name", REWARDS)
def test_every_reward_is_finite_at_the_corners(name):
    check_finite(name, REWARDS[name], tiny.S, tiny.A)


@pytest.mark.parametrize(
    "value",
    [lambda p, t: jnp.log(p.length / 20), lambda p, t: jnp.sum(1.0 * t.label * t.asked) / jnp.sum(t.asked)],
    ids=["log of no tokens", "mean of nothing asked"],
)
def test_a_reward_that_is_not_finite_somewhere_fails_when_traced(value):
    score = make_score(PARSER, {"mine": Reward(value)}, {"mine": 1.0})
    with pytest.raises(ValueError, match=r"reward 'mine' is (nan|-inf) for .*: must be finite everywhere"):
        jax.eval_shape(score, TOKENS[0, 0], jax.tree.map(lambda x: x[0], TARGET))


def test_traced_score_is_the_weighted_sum():
    reward, terms, _ = batched(make_score(PARSER, REWARDS, WEIGHTS))
    np.testing.assert_allclose(reward, sum(terms.values()), rtol=1e-5)
    assert set(terms) == set(WEIGHTS)
