"""Quick compilation holds inside its block, whatever was set before, and changes no result beyond rounding."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.quick import FLAGS, OLDER_LOOPS, compiled_quickly

SETTING = "jax_disable_most_optimizations"


@pytest.fixture
def well(monkeypatch):
    """A process that compiles well, as one outside of the tests does."""
    monkeypatch.delenv(FLAGS, raising=False)
    before = jax.config.values[SETTING]
    jax.config.update(SETTING, False)
    yield
    jax.config.update(SETTING, before)


def test_it_ends_with_its_block_even_by_an_error(well):
    seen = {}

    def fail():
        seen.update(setting=jax.config.values[SETTING], flags=os.environ.get(FLAGS, ""))
        raise KeyError

    with pytest.raises(KeyError), compiled_quickly():
        fail()
    assert seen == {"setting": True, "flags": OLDER_LOOPS}
    assert not jax.config.values[SETTING]
    assert FLAGS not in os.environ


def test_flags_of_the_user_stay(well, monkeypatch):
    monkeypatch.setenv(FLAGS, "--xla_force_host_platform_device_count=2")
    with compiled_quickly(), compiled_quickly():
        assert os.environ[FLAGS].split() == ["--xla_force_host_platform_device_count=2", *OLDER_LOOPS.split()]
    assert os.environ[FLAGS] == "--xla_force_host_platform_device_count=2"


def test_results_are_the_same(well):
    x = jnp.linspace(-2, 2, 7)
    f = jax.grad(lambda x: jnp.sum(jnp.tanh(x) ** 2))
    with compiled_quickly():
        quick = jax.jit(f)(x)
    np.testing.assert_allclose(quick, f(x), atol=1e-6)
