"""The decoder: nothing looks ahead, and the caches are written where they should be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.lm import Decoder, DecoderConfig, LayerCache, PrefixCache, _write_row

CONFIG = dataclasses.replace(tiny.CONFIG.decoder, tie_embedding=False)
DECODER = Decoder(CONFIG)
L, T, D = 5, 4, CONFIG.hidden_size


@pytest.fixture(scope="module")
def params():
    """Untied parameters: the embedding table is then read by the inputs alone."""
    head = np.random.default_rng(0).normal(0, 0.4, (D, CONFIG.vocab_size)).astype(np.float32)
    return {**tiny.params()["decoder"], "head": {"kernel": jnp.asarray(head)}}


def prefill(params, x):
    positions = jnp.tile(jnp.arange(L), (3, 1))
    return DECODER.apply({"params": params}, x, positions, jnp.ones(L, bool), method=Decoder.prefill)


def test_prefix_is_causal_by_zero_gradients(params):
    """The deepest keys of token i: gradient exactly 0 towards inputs j > i, and not 0 towards any j ≤ i."""
    x = jnp.asarray(np.random.default_rng(1).normal(size=(L, D)), jnp.float32)
    keys = jax.jit(jax.jacobian(lambda x: prefill(params, x)[1].layers[-1].k.sum((0, 2))))(x)
    depends = np.asarray(jnp.any(keys != 0, -1))  # [i, j]
    np.testing.assert_array_equal(depends, np.tril(np.ones((L, L), bool)))


def test_completion_is_causal_by_zero_gradients(params):
    """Hidden state of completion token t: 0 towards the embedding of every later token, not 0 towards the others."""
    x = jnp.asarray(np.random.default_rng(1).normal(size=(L, D)), jnp.float32)
    tokens = jnp.array([7, 9, 11, 13])
    prefix = prefill(params, x)[1]

    def hidden(table):
        changed = {**params, "embedding": {"embedding": table}}
        states = DECODER.apply({"params": changed}, tokens, prefix, method=Decoder.extend)
        return (states * jnp.arange(1, D + 1)).sum(-1)

    rows = jax.jit(jax.jacobian(hidden))(params["embedding"]["embedding"])[:, tokens]
    np.testing.assert_array_equal(np.asarray(jnp.any(rows != 0, -1)), np.tril(np.ones((T, T), bool)))


def test_prefix_cache_knows_the_next_position(params):
    positions = jnp.array([[0, 9, 2, 3, 70], [0, 4, 2, 3, 70], [0, 1, 2, 3, 70]])
    mask = jnp.array([True, True, True, True, False])
    x = jnp.zeros((L, D))
    _, prefix = DECODER.apply({"params": params}, x, positions, mask, method=Decoder.prefill)
    assert int(prefix.next_position) == 10  # after the largest id of any axis; the last token does not exist


def test_decode_reads_no_row_of_the_cache_after_its_own(params):
    """What a fresh cache holds past t is never seen."""
    rng = np.random.default_rng(2)
    x = jnp.asarray(rng.normal(size=(L, D)), jnp.float32)
    prefix = prefill(params, x)[1]
    shape = (CONFIG.num_kv_heads, T, CONFIG.head_dim)
    step = jax.jit(
        lambda c: DECODER.apply({"params": params}, jnp.int32(7), jnp.int32(0), prefix, c, method=Decoder.decode)
    )
    caches = [tuple(LayerCache(jnp.full(shape, v), jnp.full(shape, v)) for _ in range(2)) for v in (0.0, 5.0)]
    hidden = [step(c)[0] for c in caches]
    np.testing.assert_array_equal(*hidden)


def test_banned_ids_have_no_probability():
    banned = jnp.arange(CONFIG.vocab_size) % 3 == 0
    logits = Decoder(tiny.CONFIG.decoder).apply(
        {"params": tiny.params()["decoder"]}, jnp.ones(D), banned, method=Decoder.logits
    )
    p = jax.nn.softmax(logits)
    assert not p[banned].any()
    assert (p[~banned] > 0).all()
    assert logits.dtype == jnp.float32


def test_row_write_batches_over_both_axes():
    rng = np.random.default_rng(3)
    caches, rows = rng.normal(size=(4, 2, 5, 3)).astype(np.float32), rng.normal(size=(4, 2, 1, 3)).astype(np.float32)
    ours = jax.vmap(_write_row, in_axes=(0, 0, None))(jnp.asarray(caches), jnp.asarray(rows), jnp.int32(2))
    caches[:, :, 2] = rows[:, :, 0]
    np.testing.assert_array_equal(ours, caches)


def test_row_write_broadcasts_a_shared_cache():
    rows = jnp.asarray(np.arange(6.0).reshape(2, 1, 1, 3))
    ours = jax.vmap(_write_row, in_axes=(None, 0, None))(jnp.zeros((1, 4, 3)), rows, jnp.int32(3))
    np.testing.assert_array_equal(ours[:, 0, 3], rows[:, 0, 0])


def test_row_write_refuses_an_index_per_rollout():
    with pytest.raises(ValueError, match="do not batch t"):
        jax.vmap(_write_row, in_axes=(None, None, 0))(jnp.zeros((1, 4, 3)), jnp.zeros((1, 1, 3)), jnp.arange(2))


def test_heads_must_group():
    with pytest.raises(ValueError, match="num_heads is 3: must be a multiple of num_kv_heads 2"):
        DecoderConfig(vocab_size=8, num_heads=3, num_kv_heads=2)


def test_fresh_prefix_is_a_pytree_that_vmap_can_leave_alone():
    layer = LayerCache(jnp.zeros((1, 2, 4)), jnp.zeros((1, 2, 4)))
    prefix = PrefixCache((layer,), jnp.ones(2, bool), jnp.int32(2))
    assert len(jax.tree.leaves(prefix)) == 4
