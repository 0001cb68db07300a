"""Rewards of a whole group by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.rewards.examples import make_parsed, make_target
from touchr1_jax.rewards.diversity import diversity
from touchr1_jax.rewards.overlong import overlong


@pytest.mark.parametrize(
    ("length", "truncated", "earned"),
    [(0, False, 0), (15, False, 0), (17, False, -0.5), (19, False, -1), (9, True, -1)],
)
def test_the_penalty_grows_over_the_last_fifth_of_twenty_tokens(length, truncated, earned):
    one = make_parsed().replace(length=jnp.array(length), truncated=jnp.array(truncated))
    parsed = jax.tree.map(lambda x: x[None], one)
    assert overlong(jnp.zeros((1, 20), jnp.int32), parsed, make_target()) == pytest.approx(earned)


@pytest.mark.parametrize(
    ("tokens", "earned"), [([[1, 2], [1, 2], [1, 3]], [0.5, 0.5, 1.0]), ([[1, 2], [1, 2]], [0, 0]), ([[4, 4]], [0])]
)
def test_diversity_is_the_share_of_the_others_that_differ(tokens, earned):
    parsed = jax.tree.map(lambda x: jnp.stack([x] * len(tokens)), make_parsed())
    np.testing.assert_allclose(diversity(jnp.array(tokens), parsed, make_target()), earned)
