"""Blocks of the vocabulary add up to the whole, value and gradient, and never exist together."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.chunked import block_size, chunked_log_probs
from touchr1_jax.models.layers import MASKED
from touchr1_jax.models.lm import Decoder

N, D, V = 7, 5, 24


@pytest.fixture(scope="module")
def given():
    rng = np.random.default_rng(0)
    hidden, table = (jnp.asarray(rng.normal(0, 2, s), jnp.float32) for s in ((N, D), (V, D)))
    return hidden, table, jnp.asarray(rng.integers(0, V, N)), jnp.asarray(rng.random(V) < 0.3)


def whole(hidden, table, tokens, banned):
    logits = jnp.where(banned, MASKED, hidden @ table.T)
    return jnp.take_along_axis(jax.nn.log_softmax(logits), tokens[:, None], 1)[:, 0]


@pytest.mark.parametrize("block", [3, 8, 23, 24, 100])
def test_blocks_add_up_to_the_whole(given, block):
    hidden, table, tokens, banned = given
    tokens = jnp.where(banned[tokens], jnp.argmin(banned), tokens)
    ours = jax.jit(lambda *x: chunked_log_probs(*x, block=block))(hidden, table, tokens, banned)
    np.testing.assert_allclose(ours, whole(hidden, table, tokens, banned), rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("block", [4, 24])
def test_gradients_are_those_of_the_whole(given, block):
    hidden, table, tokens, banned = given
    weight = jnp.linspace(-1, 2, N)
    ours = lambda h, w: jnp.sum(weight * chunked_log_probs(h, w, tokens, banned, block=block))
    theirs = lambda h, w: jnp.sum(weight * whole(h, w, tokens, banned))
    for a, b in zip(*(jax.jit(jax.grad(f, (0, 1)))(hidden, table) for f in (ours, theirs)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


def test_first_block_may_be_banned_whole(given):
    hidden, table, _, _ = given
    banned, tokens = jnp.arange(V) < 8, jnp.full(N, 20)
    ours = chunked_log_probs(hidden, table, tokens, banned, block=8)
    np.testing.assert_allclose(ours, whole(hidden, table, tokens, banned), rtol=2e-6)


def test_scores_far_apart_do_not_overflow(given):
    hidden, table, tokens, banned = given
    ours = chunked_log_probs(1e3 * hidden, table, tokens, jnp.zeros_like(banned), block=6)
    assert np.isfinite(ours).all()


def test_no_array_has_the_whole_vocabulary_for_every_token():
    """In the compiled value and gradient: [n, V] would be 40 MB, what is needed is far less."""
    n, d, v = 1000, 8, 10_000
    shapes = (jax.ShapeDtypeStruct(s, jnp.float32) for s in ((n, d), (v, d)))
    tokens, banned = jnp.zeros(n, jnp.int32), jnp.zeros(v, bool)
    loss = lambda h, w: jnp.sum(chunked_log_probs(h, w, tokens, banned, block=500))
    memory = jax.jit(jax.grad(loss, (0, 1))).lower(*shapes).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 0.4 * 4 * n * v


@pytest.mark.parametrize(
    ("vocabulary", "most", "size"), [(152_064, 8192, 6912), (151_936, 8192, 4748), (24, 100, 24), (7, 7, 7)]
)
def test_block_sizes_divide_the_vocabulary(vocabulary, most, size):
    assert block_size(vocabulary, most) == size


@pytest.mark.parametrize(("vocabulary", "most"), [(10_007, 8192), (24, 0)])
def test_awkward_vocabularies_are_refused(vocabulary, most):
    with pytest.raises(ValueError, match=f"block is {most}: the vocabulary of {vocabulary} has no divisor"):
        block_size(vocabulary, most)


@pytest.mark.parametrize("tied", [True, False])
def test_decoder_scores_as_by_its_logits(tied):
    """Values, and gradients towards the table of words and the last norm."""
    config = dataclasses.replace(tiny.CONFIG.decoder, num_layers=0, tie_embedding=tied)
    rng = np.random.default_rng(1)
    x, table = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in ((N, 24), (config.vocab_size, 24)))
    params = {"embedding": {"embedding": table}, "norm": {"scale": jnp.linspace(0.5, 1.5, 24)}}
    params |= {} if tied else {"head": {"kernel": 2 * table.T}}
    tokens = jnp.asarray(rng.integers(0, config.vocab_size, N))
    run = lambda p, method, *rest: Decoder(config).apply({"params": p}, x, *rest, method=method)
    allowed = jnp.zeros(config.vocab_size, bool)
    ours = lambda p: jnp.sum(jnp.sin(run(p, Decoder.log_probs, tokens, allowed, 13)))
    logits = lambda p: jax.nn.log_softmax(run(p, Decoder.logits, allowed))
    theirs = lambda p: jnp.sum(jnp.sin(jnp.take_along_axis(logits(p), tokens[:, None], 1)))
    for a, b in zip(*(jax.tree.leaves(jax.jit(jax.value_and_grad(f))(params)) for f in (ours, theirs)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * float(jnp.abs(b).max()))


def test_completions_are_scored_as_by_their_logits():
    agent, batch, tokens = tiny.SHALLOW, tiny.question_batch(1, 2), tiny.completions(0, 2, 3, 4)

    def both(params, features, ids, mask, tokens):
        prompt = agent.prefill(params, features, ids, mask)
        log_p = jax.nn.log_softmax(agent.completion_logits(params, tokens, *prompt))
        ours = agent.completion_log_probs(params, tokens, *prompt, block=13)
        return ours, jnp.take_along_axis(log_p, tokens[..., None], -1)[..., 0]

    every = jax.jit(jax.vmap(both, in_axes=(None, 0, 0, 0, 0)))
    ours, theirs = every(tiny.shallow_params(), batch.features, batch.ids, batch.mask, tokens)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)
