"""Attention written out: its gradient, its blocks, and prompts that are encoded again from a change on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.blocked_attention import PREFILL_ROWS, LayerCache, attend_causally
from touchr1_jax.models.layers import MASKED, MOST_SCORES, KeySource, attend

KV, R, D = 2, 3, 4


def normal(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def naive(q, sources):
    """softmax(q kᵀ/√d) v over all keys at once, differentiated by JAX."""
    keys, values = (jnp.concatenate([getattr(s, name) for s in sources], 1) for name in ("k", "v"))
    masks = [jnp.broadcast_to(s.mask, (q.shape[0], s.k.shape[1])) for s in sources]
    scores = jnp.einsum("tkrd,knd->krtn", q, keys) / D**0.5
    weights = jax.nn.softmax(jnp.where(jnp.concatenate(masks, 1), scores, MASKED), -1)
    return jnp.einsum("krtn,knd->tkrd", weights, values).reshape(q.shape[0], -1)


@pytest.mark.parametrize(("queries", "shared"), [(1, 5), (7, 16), (20, 37)])
def test_value_and_gradient_equal_those_of_the_plain_softmax(queries, shared):
    """Two blocks of keys, one with a mask for all queries, one causal; row lengths below, at and past a register's."""
    causal, seen = jnp.tri(queries, dtype=bool), jnp.arange(shared) != 1
    args = (
        normal(0, queries, KV, R, D),
        normal(1, KV, shared, D),
        normal(2, KV, shared, D),
        normal(3, KV, queries, D),
        normal(4, KV, queries, D),
    )
    weight = normal(5, queries, KV * R * D)

    def total(attention):
        def run(q, k, v, own_k, own_v):
            return jnp.sum(weight * attention(q, [KeySource(k, v, seen), KeySource(own_k, own_v, causal)]))

        return jax.jit(jax.value_and_grad(run, argnums=range(5)))(*args)

    (ours, gradient), (theirs, expected) = total(attend), total(naive)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    for a, b in zip(gradient, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_keys_that_a_group_shares_get_the_sum_of_its_gradients():
    q, k, v = normal(0, 5, 3, KV, R, D), normal(1, KV, 6, D), normal(2, KV, 6, D)
    run = lambda attention, k: jnp.sum(
        jnp.sin(jax.vmap(lambda x: attention(x, [KeySource(k, v, jnp.ones(6, bool))]))(q))
    )
    ours, theirs = (jax.jit(jax.grad(lambda k, a=a: run(a, k)))(k) for a in (attend, naive))
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("most", [MOST_SCORES, 500, 100])
def test_a_group_at_once_is_each_of_its_sequences_by_itself(most):
    """Value and every gradient: one block of keys for all, one for each sequence; all at once, or in 2 or 10 turns."""
    group, t = 3, 5
    args = (
        normal(0, group, t, KV, R, D),
        normal(1, KV, 6, D),
        normal(2, KV, 6, D),
        normal(3, KV, group, t, D),
        normal(4, KV, group, t, D),
    )
    seen, causal = jnp.arange(6) != 2, jnp.tri(t, dtype=bool)
    weight = normal(5, group, t, KV * R * D)

    def at_once(q, k, v, own_k, own_v):
        return jnp.sum(weight * attend(q, [KeySource(k, v, seen), KeySource(own_k, own_v, causal)], most))

    def one_by_one(q, k, v, own_k, own_v):
        each = jax.vmap(lambda q, a, b: naive(q, [KeySource(k, v, seen), KeySource(a, b, causal)]), in_axes=(0, 1, 1))
        return jnp.sum(weight * each(q, own_k, own_v))

    (ours, gradient), (theirs, expected) = (
        jax.jit(jax.value_and_grad(f, argnums=range(5)))(*args) for f in (at_once, one_by_one)
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    for a, b in zip(gradient, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rows", [3, PREFILL_ROWS + 9])
def test_blocks_of_queries_see_what_the_whole_sees(rows):
    """Also where the queries are only the last of the keys' tokens."""
    length = PREFILL_ROWS + 9
    mask = jnp.arange(length) != 4
    q, cache = normal(0, rows, KV, R, D), LayerCache(normal(1, KV, length, D), normal(2, KV, length, D))
    whole = naive(q, [KeySource(cache.k, cache.v, jnp.tri(rows, length, length - rows, dtype=bool) & mask)])
    np.testing.assert_allclose(jax.jit(attend_causally)(q, cache, mask), whole, rtol=1e-4, atol=1e-5)


prefill = jax.jit(tiny.FNS.prefill, static_argnums=5)


@pytest.mark.long
@pytest.mark.parametrize("stream", range(tiny.S))
def test_a_prompt_encoded_again_from_a_change_on_is_the_prompt_encoded_whole(stream):
    params = tiny.params()
    features = jax.tree.map(lambda x: x[0], tiny.features(0))
    changed = features.replace(touch=features.touch.at[stream].set(normal(9, *features.touch.shape[1:])))
    ids, mask = jnp.asarray(tiny.LAYOUT.ids[0]), jnp.asarray(tiny.LAYOUT.mask[0])
    _, known = prefill(params, features, ids, mask)
    again = prefill(params, changed, ids, mask, known, int(tiny.SLOTS.touch[stream].min()))
    whole = prefill(params, changed, ids, mask)
    for a, b in zip(*map(jax.tree.leaves, (again, whole)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    assert jnp.abs(whole[0] - prefill(params, features, ids, mask)[0]).max() > 1e-3


def test_touch_starts_at_the_first_sensor_name():
    text = tiny.LAYOUT.stream_text
    assert tiny.FNS.touch_start == np.flatnonzero((text >= 0) & (text < tiny.S)).min()
    assert tiny.FNS.touch_start < tiny.SLOTS.touch.min()
