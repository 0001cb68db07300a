"""The same logits as Hugging Face transformers, from the same weights: golden arrays that `make_golden` computed."""

import functools
import importlib.util
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.models.qwen import cases, tiny
from tests.touchr1_jax.models.qwen.cases import CASES
from touchr1_jax.models.qwen.model import QwenVL
from touchr1_jax.models.token_cache import empty_caches
from touchr1_jax.types import Params

RELATIVE = 1e-5
"""Largest difference allowed, relative to the largest logit: ten times stricter than what is asked of the project."""


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(cases.GOLDEN) as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def params(tmp_path_factory):
    """Parameters of each case, read through the loader once for each distinct checkpoint."""

    @functools.cache
    def read(*differs: object) -> Params:
        case = next(c for c in CASES.values() if (c.window_px, c.tied, c.shape) == differs)
        return tiny.params_of(case, tmp_path_factory.mktemp("checkpoint"))

    return lambda case: read(case.window_px, case.tied, case.shape)


def close(ours: jax.Array, theirs: np.ndarray) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=RELATIVE * np.abs(theirs).max())


@pytest.mark.parametrize("name", CASES)
def test_positions_are_those_of_the_reference(name, golden):
    np.testing.assert_array_equal(tiny.inputs_of(name).positions, golden[f"{name}.positions"])


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_logits_are_those_of_the_reference(name, golden, params):
    model = QwenVL(tiny.config_of(CASES[name]))
    forward = jax.jit(lambda p, x: model.apply({"params": p}, x, tiny.grids_of(CASES[name])))
    theirs = golden[f"{name}.logits"]
    assert np.ptp(theirs, axis=-1).min() > 1  # else agreement would mean little
    close(forward(params(CASES[name]), tiny.inputs_of(name)), theirs)


@pytest.mark.long
@pytest.mark.parametrize("name", ["mixed", "qwen3_mixed_1"])
def test_cached_answers_are_the_full_forward_pass(name, golden, params):
    """The prompt without its last words, then these words at once, and one by one."""
    case, last = CASES[name], 4
    model, weights = QwenVL(tiny.config_of(case)), params(case)
    whole = tiny.inputs_of(name)
    prompt = whole._replace(ids=whole.ids[:-last], positions=whole.positions[:, :-last])
    run = lambda method, *args: model.apply({"params": weights}, *args, method=method)
    first, prefix = jax.jit(lambda x: run(QwenVL.prefill, x, tiny.grids_of(case)))(prompt)
    theirs = golden[f"{name}.logits"][-last - 1 :]
    close(first, theirs[0])
    answer = whole.ids[-last:]
    close(jax.jit(lambda o, past: run(QwenVL.extend, o, past))(answer, prefix), theirs[1:])
    c = model.config.decoder
    caches = empty_caches(c, last)
    step = jax.jit(lambda token, t, past, caches: run(QwenVL.decode, token, t, past, caches))
    for t in range(last):
        logits, caches = step(answer[t], jnp.int32(t), prefix, caches)
        close(logits, theirs[1 + t])


def test_golden_arrays_lie_where_they_should(golden):
    assert cases.GOLDEN.stat().st_size < 300_000
    assert int(str(golden["transformers"]).split(".")[0]) >= 5


@pytest.mark.slow
@pytest.mark.skipif(
    not importlib.util.find_spec("transformers") or not importlib.util.find_spec("torch"),
    reason="the parity extra is not installed",
)
def test_golden_arrays_are_what_transformers_computes_here():
    command = [sys.executable, "-W", "ignore", "-m", "tests.touchr1_jax.models.qwen.make_golden", "--check"]
    subprocess.run(command, check=True, timeout=300)
