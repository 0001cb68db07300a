"""A scale is refused on a machine that lacks what it needs; quick compilation ends with its block."""

import dataclasses
import os
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.machine import (
    FLAGS,
    GIB,
    OLDER_LOOPS,
    Accelerators,
    MachineError,
    accelerators,
    compiled_quickly,
    require_accelerators,
)  # fmt: skip
from experiments.core.runner import Experiment, run_experiment
from tests.experiments.fakes import coin

ONE = Accelerators(number=1, memory_gib=70.0)


def test_a_processor_is_no_accelerator():
    with pytest.raises(MachineError, match="needs 1 accelerator of 70 GiB, and this machine has none, only cpu"):
        require_accelerators("gpu", ONE)
    require_accelerators("default", None)


@pytest.mark.parametrize(("number", "gib", "enough"), [(1, 80, True), (1, 40, False), (16, 140, True), (0, 0, False)])
def test_number_and_memory_must_suffice(number, gib, enough):
    present = Accelerators(number=number, memory_gib=gib)
    if enough:
        require_accelerators("gpu", ONE, present)
    else:
        with pytest.raises(MachineError, match="scale is 'gpu'"):
            require_accelerators("gpu", ONE, present)


def test_accelerators_are_those_of_all_processes_with_the_least_memory_of_this_one(monkeypatch):
    gpus = [SimpleNamespace(platform="gpu", memory_stats=lambda n=n: {"bytes_limit": n * GIB}) for n in (80, 70, 90)]
    monkeypatch.setattr(jax, "devices", lambda: gpus)
    monkeypatch.setattr(jax, "local_devices", lambda: gpus[:2])
    assert accelerators() == Accelerators(number=3, memory_gib=70.0)


def test_a_run_is_refused_before_it_begins(tmp_path, capsys):
    experiment = dataclasses.replace(coin.EXPERIMENT, needs={"smoke": ONE})
    assert run_experiment(experiment, ["--scale", "smoke", "--runs-dir", str(tmp_path)], "Why?") == 1
    assert "needs 1 accelerator" in "".join(capsys.readouterr())
    assert list(tmp_path.iterdir()) == []


def test_needs_are_of_scales():
    with pytest.raises(ValueError, match="must be scales"):
        Experiment(name="coin", config=coin.Config(), run=coin.run, needs={"huge": ONE})


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
