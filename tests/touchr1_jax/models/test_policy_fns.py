"""A group that shares its prefix computes what separate full sequences would; sampler and learner see the same."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.models import naive
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.rl.rollout import SampleConfig, sample_group

P, G, T = 2, 3, 6
BLOCKS = [
    ("view", tiny.NV),
    ("text", 1),
    (0, tiny.N),
    ("text", 1),
    (1, tiny.N),
    ("text", tiny.L - tiny.NV - 2 * tiny.N - 2),
]
DRAW = SampleConfig(group=G, length=T, end_ids=tiny.FNS.end_ids, pad_id=tiny.FNS.pad_id)
writable = tiny.WRITABLE


@pytest.fixture(scope="module")
def batch():
    """One contact with everything, and one without its first stream and its view."""
    batch = tiny.question_batch(1, P)
    stream_mask = batch.features.stream_mask.at[1, 0].set(False)
    view_mask = batch.features.view_mask.at[1].set(False)
    return batch.replace(features=batch.features.replace(stream_mask=stream_mask, view_mask=view_mask))


group_logits = jax.jit(jax.vmap(tiny.FNS.group_logits, in_axes=(None, 0, 0, 0, 0)))


def full_mask(features, mask) -> np.ndarray:
    """Which prompt tokens of one contact exist."""
    mask = np.array(mask)
    mask[: tiny.NV] &= bool(features.view_mask)
    for s in range(tiny.S):
        mask[tiny.LAYOUT.touch[s]] &= bool(features.stream_mask[s])
        mask[tiny.LAYOUT.stream_text == s] &= bool(features.stream_mask[s])
    return mask


def naive_logits(params, batch, touch, view, tokens):
    """Logits [P, G, T, V] with every rollout as one full sequence; `touch` and `view` may be traced."""
    return jnp.stack([naive_group(params, batch, i, touch[i], view[i], tokens[i]) for i in range(P)])


def naive_group(params, batch, i, touch, view, tokens):
    """The same for prompt i."""
    features = jax.tree.map(lambda x: np.asarray(x)[i], batch.features)
    mask = full_mask(features, np.asarray(batch.mask)[i])
    positions = naive.prompt_positions(mask, features.touch_time, tiny.CONFIG.vision.grid, BLOCKS)
    last = positions[:, mask].max()
    positions = np.concatenate([positions, np.tile(last + 1 + np.arange(T), (3, 1))], 1)
    table = params["decoder"]["embedding"]["embedding"]
    prompt = table[batch.ids[i]].at[tiny.LAYOUT.touch].set(touch).at[tiny.LAYOUT.view].set(view)
    return jax.vmap(lambda o: naive.logits(params["decoder"], prompt, o, positions, mask, tiny.CONFIG.decoder))(tokens)


def close(ours, theirs, tolerance: float = 1e-5) -> None:
    """Every leaf to a relative error of its own norm; one that is 0 in truth, of a thousandth of the largest."""
    scale = max(float(jnp.linalg.norm(x)) for x in jax.tree.leaves(theirs))
    for path, leaf in jax.tree_util.tree_leaves_with_path(theirs):
        found = dict(jax.tree_util.tree_leaves_with_path(ours))[path]
        size = max(float(jnp.linalg.norm(leaf)), 1e-3 * scale)
        assert float(jnp.linalg.norm(found - leaf)) <= tolerance * size, jax.tree_util.keystr(path)


@pytest.mark.long
def test_shared_prefix_gives_the_values_of_full_sequences(batch):
    tokens, params = tiny.completions(0, P, G, T), tiny.params()
    ours = group_logits(params, batch.features, batch.ids, batch.mask, tokens)[..., writable]
    theirs = naive_logits(params, batch, batch.features.touch, batch.features.view, tokens)[..., writable]
    assert float(jnp.std(theirs)) > 1  # else agreement would mean little
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5 * float(np.abs(theirs).max()))


@pytest.mark.long
def test_shared_prefix_gives_the_gradients_of_full_sequences(batch):
    tokens = tiny.completions(0, P, G, T)
    decoder = {"decoder": tiny.params()["decoder"]}
    cotangent = jnp.asarray(np.random.default_rng(0).normal(size=(P, G, T, len(writable))), jnp.float32)

    def ours(params, touch, view):
        features = batch.features.replace(touch=touch, view=view)
        return jnp.sum(cotangent * group_logits(params, features, batch.ids, batch.mask, tokens)[..., writable])

    def theirs(params, touch, view):
        return jnp.sum(cotangent * naive_logits(params, batch, touch, view, tokens)[..., writable])

    at = decoder, batch.features.touch, batch.features.view
    close(jax.grad(ours, (0, 1, 2))(*at), jax.jit(jax.grad(theirs, (0, 1, 2)))(*at))


@pytest.fixture(scope="module")
def rollout(batch):
    """Sampled completions."""
    draw = jax.jit(lambda p, b, k: sample_group(tiny.FNS, p, b, k, DRAW))
    return draw(tiny.params(), batch, jax.random.key(3))


@pytest.mark.long
def test_learner_sees_the_log_probabilities_of_the_sampler(batch, rollout):
    logits = group_logits(tiny.params(), batch.features, batch.ids, batch.mask, rollout.tokens)
    learner = token_log_probs(jax.nn.log_softmax(logits), rollout.tokens)
    assert rollout.mask.sum() > P * G  # more than first tokens
    np.testing.assert_allclose(jnp.where(rollout.mask, learner, 0), rollout.log_prob, rtol=1e-5, atol=1e-5)


@pytest.mark.long
def test_greedy_completion_is_the_most_likely_token_at_every_step(batch):
    greedy = dataclasses.replace(DRAW, group=1, greedy=True)
    said = jax.jit(lambda p, b, k: sample_group(tiny.FNS, p, b, k, greedy))(tiny.params(), batch, jax.random.key(0))
    tokens = jnp.tile(said.tokens, (1, G, 1))  # the compiled shape
    best = jnp.argmax(group_logits(tiny.params(), batch.features, batch.ids, batch.mask, tokens), -1)[:, :1]
    np.testing.assert_array_equal(jnp.where(said.mask, best, 0), jnp.where(said.mask, said.tokens, 0))


@pytest.mark.long
def test_banned_ids_are_never_sampled(batch):
    """10⁴ tokens; the policy's own scores prefer the banned ids by far."""
    params = tiny.params()
    table = params["decoder"]["embedding"]["embedding"]
    loved = {
        "decoder": {**params["decoder"], "embedding": {"embedding": table.at[tiny.TOKENIZER.banned].multiply(20.0)}}
    }
    many = dataclasses.replace(DRAW, group=1000, length=5)
    said = jax.jit(lambda p, b, k: sample_group(tiny.FNS, p, b, k, many))(loved, batch, jax.random.key(0))
    tokens = said.tokens[said.mask]
    assert len(tokens) > 5000
    assert not tiny.TOKENIZER.banned[tokens].any()
    assert len(np.unique(tokens)) > 10


@pytest.mark.parametrize(("layers", "stacks"), [(1, [()]), (9, [()] * 9), (10, [(9,), ()])])
def test_empty_cache_has_the_shape_of_the_decoder(layers, stacks):
    c = dataclasses.replace(tiny.CONFIG.decoder, num_layers=layers)
    policy = dataclasses.replace(tiny.CONFIG, decoder=c)
    fns = dataclasses.replace(tiny.FNS, module=dataclasses.replace(tiny.FNS.module, config=policy))
    shapes = [(x.k.shape, x.v.shape) for x in fns.empty_cache(7)]
    heads = [(*n, c.num_kv_heads) for n in stacks]
    assert shapes == [((*h, c.head_dim, 7), (*h, 7, c.head_dim)) for h in heads]


@pytest.mark.long
def test_blind_features_hold_no_touch():
    batch = tiny.touch_batch(0, 1)
    blind = jax.jit(lambda b: tiny.FNS.encode(tiny.params(), b, blind=True))(batch)
    assert not blind.stream_mask.any()
    assert not blind.touch.any()
    assert blind.view.any()
