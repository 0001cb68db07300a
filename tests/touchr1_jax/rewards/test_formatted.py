import jax.numpy as jnp

from tests.touchr1_jax.rewards.examples import make_parsed, make_target
from touchr1_jax.rewards.formatted import formatted


def test_one_or_nothing():
    assert formatted(make_parsed(formatted=True), make_target()) == 1
    assert formatted(make_parsed(formatted=False), make_target()) == 0
    assert formatted(make_parsed(formatted=True), make_target()).dtype == jnp.float32
