"""The decoder: nothing looks ahead, and the caches are written where they should be."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.lm import Decoder
from touchr1_jax.models.stacked import before_the_loop, layer_by_layer
from touchr1_jax.models.token_cache import empty_caches

CONFIG = dataclasses.replace(tiny.CONFIG.decoder, tie_embedding=False)
DECODER = Decoder(CONFIG)
L, T, D = 5, 4, CONFIG.hidden_size


@pytest.fixture(scope="module")
def params():
    """Untied parameters: the embedding table is then read by the inputs alone."""
    head = np.random.default_rng(0).normal(0, 0.4, (D, CONFIG.vocab_size)).astype(np.float32)
    return {**tiny.params()["decoder"], "head": {"kernel": jnp.asarray(head)}}


@jax.jit
def prefill(params, x):
    positions = jnp.tile(jnp.arange(L), (3, 1))
    return DECODER.apply({"params": params}, x, positions, jnp.ones(L, bool), method=Decoder.prefill)


def filled(value):
    """Caches of all layers, every entry `value`."""
    return jax.tree.map(lambda x: jnp.full_like(x, value), empty_caches(CONFIG, T))


@pytest.mark.long
def test_prefix_cache_knows_the_next_position(params):
    positions = jnp.array([[0, 9, 2, 3, 70], [0, 4, 2, 3, 70], [0, 1, 2, 3, 70]])
    mask = jnp.array([True, True, True, True, False])
    x = jnp.zeros((L, D))
    _, prefix = DECODER.apply({"params": params}, x, positions, mask, method=Decoder.prefill)
    assert int(prefix.next_position) == 10  # after the largest id of any axis; the last token does not exist


@pytest.mark.long
def test_a_cache_for_each_layer_reads_as_one_for_all():
    """Three tokens through five layers whose caches are apart or together: the same hidden states."""
    config = dataclasses.replace(tiny.CONFIG.decoder, num_layers=5)
    decoder, before = Decoder(config), config.num_layers - 1
    positions, mask, tokens = jnp.broadcast_to(jnp.arange(L), (3, L)), jnp.ones(L, bool), jnp.array([7, 9, 11])
    x = jnp.asarray(np.random.default_rng(3).normal(size=(L, D)), jnp.float32)
    all_of = lambda module: (module.embed(tokens), module.states(x, positions, mask))
    shapes = jax.eval_shape(lambda key: decoder.init(key, method=all_of), jax.random.key(0))
    params = draw_params(shapes["params"], loud=0.1)
    run = lambda method: jax.jit(lambda *args: decoder.apply({"params": params}, *args, method=method))
    prefix = run(Decoder.prefill)(x, positions, mask)[1]
    apart, last = empty_caches(config, T), empty_caches(config, T)[-1]
    stack = jax.tree.map(lambda x: jnp.stack([x] * before), last)
    step = run(Decoder.decode)
    found = []
    for caches in (apart, (stack, last)):
        for t, token in enumerate(tokens):
            hidden, caches = step(token, jnp.int32(t), prefix, caches)
        found.append((hidden, jnp.concatenate([x.k.reshape(-1, config.head_dim, T) for x in caches])))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), *found)
    whole = run(Decoder.extend)(tokens, prefix)[-1]
    np.testing.assert_allclose(found[0][0], whole, atol=1e-5)


def test_banned_ids_have_no_probability():
    banned = jnp.arange(CONFIG.vocab_size) % 3 == 0
    logits = Decoder(tiny.CONFIG.decoder).apply(
        {"params": tiny.params()["decoder"]}, jnp.ones(D), banned, method=Decoder.logits
    )
    p = jax.nn.softmax(logits)
    assert not p[banned].any()
    assert (p[~banned] > 0).all()
    assert logits.dtype == jnp.float32


@pytest.mark.long
@pytest.mark.parametrize("cache_axis", [None, 0], ids=["one cache for all", "a cache each"])
def test_decoding_a_batch_writes_the_row_that_each_alone_writes(params, cache_axis):
    prefix, tokens, t = prefill(params, jnp.ones((L, D)))[1], jnp.array([7, 9]), jnp.int32(2)

    def step(token, t, caches):
        return DECODER.apply({"params": params}, token, t, prefix, caches, method=Decoder.decode)[1]

    fresh = filled(5.0)
    given = fresh if cache_axis is None else jax.tree.map(lambda x: jnp.stack([x, x]), fresh)
    one, together = jax.jit(step), jax.jit(jax.vmap(step, (0, None, cache_axis)))(tokens, t, given)
    for i, token in enumerate(tokens):
        alone = one(token, t, fresh)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-5), together, alone)
    np.testing.assert_array_equal((together[-1].k == 5).all((0, 1, 2)), np.arange(T) != 2)
    np.testing.assert_array_equal((together[-1].v == 5).all((0, 1, 3)), np.arange(T) != 2)
    with pytest.raises(ValueError, match="do not batch t"):
        jax.vmap(step, (None, 0, None))(tokens[0], jnp.arange(2), fresh)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="layers are taken out of loops on CPU alone")
@pytest.mark.parametrize(("kind", "out"), [(jnp.float32, True), (jnp.bfloat16, False)])
def test_a_loop_does_not_take_layers_out_of_their_stack_in_every_round(kind, out):
    def looped(stack, n):
        layers = lambda x: functools.reduce(lambda y, w: y @ before_the_loop(w), stack, x)
        return jax.lax.fori_loop(0, n, lambda _, x: layers(x), jnp.ones((4, 8), kind))

    options = {"xla_disable_hlo_passes": ""} | layer_by_layer(kind)  # those that tests leave out are needed
    text = jax.jit(looped).lower(jnp.ones((3, 8, 8), kind), 5).compile(options).as_text()
    assert ("slice" in text[text.index("\nENTRY") :]) == out
