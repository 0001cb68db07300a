"""The sampler, driven by decoders whose next token is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.rl.rollout import SampleConfig, _running_sums, inverse_draw, make_answer, sample
from touchr1_jax.text.constraint import compile_constraint
from touchr1_jax.text.parser import compile_parser

V, PAD, END, STOP = 8, 0, 1, 2
CONFIG = SampleConfig(group=2, length=6, end_ids=(END, STOP), pad_id=PAD, greedy=True)
SCRIPT = np.array([[5, 4, END, 7, 7, 7], [3, 6, 5, STOP, 7, 7]])
"""Completions of two prompts."""


def scripted(script: np.ndarray = SCRIPT, calls: list | None = None):
    """Decoder and first logits that say the script; a prompt knows its row by its next position."""
    peaked = 20.0 * jax.nn.one_hot(jnp.asarray(script), V)

    def decode(token, t, prefix, caches):
        if calls is not None:
            calls.append(t)
        return peaked[prefix.next_position, jnp.minimum(t + 1, script.shape[1] - 1)], caches

    return decode, peaked[:, 0]


def prefix(p: int) -> PrefixCache:
    return PrefixCache((), jnp.ones((p, 1), bool), jnp.arange(p))


def draw(script: np.ndarray = SCRIPT, config: SampleConfig = CONFIG, calls: list | None = None):
    decode, first = scripted(script, calls)
    return sample(decode, first, prefix(len(script)), (), jax.random.key(0), config)


@pytest.fixture(scope="module")
def said():
    return jax.jit(draw)()


def test_tokens_masks_and_log_probabilities_of_a_script(said):
    tokens = np.array([[5, 4, END, PAD, PAD, PAD], [3, 6, 5, STOP, PAD, PAD]])
    mask = np.array([[1, 1, 1, 0, 0, 0], [1, 1, 1, 1, 0, 0]], bool)
    np.testing.assert_array_equal(said.tokens, np.repeat(tokens[:, None], 2, 1))
    np.testing.assert_array_equal(said.mask, np.repeat(mask[:, None], 2, 1))
    peak = 20 - np.log(np.exp(20) + V - 1)
    np.testing.assert_allclose(said.log_prob, np.where(said.mask, peak, 0), atol=1e-6)


def test_an_answer_that_cannot_be_finished_is_refused():
    """Every token would be forbidden, and the first of the vocabulary drawn."""
    least = compile_constraint(tiny.LANGUAGE, tiny.TOKENIZER)
    with pytest.raises(ValueError, match=f"length is 6: must be at least {least.shortest}, the shortest formatted"):
        dataclasses.replace(CONFIG, constraint=least)


@pytest.mark.long
def test_loop_ends_with_the_last_rollout():
    """Without compilation the loop runs in Python and can be counted: one call per token up to the last end token."""
    calls = []
    with jax.disable_jit():
        draw(config=dataclasses.replace(CONFIG, length=500), calls=calls)
    assert len(calls) == 4


@pytest.mark.long
def test_without_an_end_the_loop_runs_to_the_length():
    calls = []
    endless = np.full((2, 6), 5)
    with jax.disable_jit():
        said = draw(endless, calls=calls)
    assert len(calls) == CONFIG.length
    assert said.mask.all()
    assert (said.tokens == 5).all()


@pytest.mark.long
def test_compiled_and_uncompiled_agree(said):
    with jax.disable_jit():
        plain = draw()
    for a, b in zip(jax.tree.leaves(said), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


SCORES = jnp.asarray(np.random.default_rng(0).normal(0, 1.5, V), jnp.float32).at[PAD].set(-1e9)


def random_text(key: jax.Array, group: int = 8, length: int = 6):
    """Independent tokens from softmax(SCORES)."""
    config = dataclasses.replace(CONFIG, group=group, length=length, greedy=False)
    return sample(lambda o, t, past, c: (SCORES, c), jnp.tile(SCORES, (2, 1)), prefix(2), (), key, config)


def test_key_decides():
    run = jax.jit(random_text)
    one, again, other = run(jax.random.key(1)), run(jax.random.key(1)), run(jax.random.key(2))
    np.testing.assert_array_equal(one.tokens, again.tokens)
    assert (one.tokens != other.tokens).any()
    assert (one.tokens[:, 0] != one.tokens[:, 1]).any()  # rollouts of a group differ
    assert (one.tokens[0] != one.tokens[1]).any()  # so do prompts


def test_tokens_follow_the_softmax():
    """2·10⁴ first tokens: frequencies within five standard deviations of their probabilities, none banned."""
    said = jax.jit(lambda k: random_text(k, 10_000, 1))(jax.random.key(0))
    n, p = said.tokens.size, np.asarray(jax.nn.softmax(SCORES), np.float64)
    count = np.bincount(said.tokens.ravel(), minlength=V)
    assert count[PAD] == 0
    np.testing.assert_allclose(count / n, p, atol=5 * np.sqrt(p.max() / n))
    np.testing.assert_allclose(said.log_prob, np.log(np.maximum(p, 1e-99))[said.tokens], rtol=1e-5)


def test_inverse_draws_by_hand():
    """Probabilities 0, .5, .3, 0, .2: a word is drawn where u lies between its cumulative probabilities."""
    logits = jnp.log(jnp.array([1e-30, 0.5, 0.3, 1e-30, 0.2]))
    u = jnp.array([0.0, 0.49, 0.51, 0.79, 0.81, 0.999])
    np.testing.assert_array_equal(inverse_draw(jnp.tile(logits, (6, 1)), u), [0, 1, 2, 2, 4, 4])
    words = jnp.arange(67)  # of one probability, more than two blocks of the sum
    np.testing.assert_array_equal(inverse_draw(jnp.zeros((67, 67)), (words + 0.5) / 67), words)


def test_inverse_draws_hit_no_word_of_weight_0_whatever_the_order_of_the_sum():
    """A compiled sum of 40,000 words is not monotone; u is 0, or stands where it rises at a word of weight 0."""
    rng = np.random.default_rng(0)
    logits = np.where(rng.random(40_000) < 0.5, -np.inf, 4 * rng.normal(size=40_000)).astype(np.float32)
    logits[:9] = -np.inf
    weight = np.exp(logits - logits.max())
    total = np.asarray(jax.jit(_running_sums)(weight))
    rises = np.flatnonzero((np.diff(total) > 0) & (weight[1:] == 0))
    assert len(rises) > 50
    u = np.concatenate([total[rises] / total[-1], [0.0, 1 - 2**-23]]).astype(np.float32)
    drawn = jax.jit(jax.vmap(inverse_draw, in_axes=(None, 0)))(logits, u)
    assert np.isfinite(logits[drawn]).all()
    exact = np.cumsum(weight, dtype=np.float64)
    np.testing.assert_allclose(exact[drawn] / exact[-1], u, atol=weight.max() / exact[-1])


def test_settings_of_the_sampler_never_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        CONFIG.greedy = False
    with pytest.raises(ValueError, match=r"temperature is 0\.0: must lie in 1e-06 …"):  # drew token 0, of NaN
        dataclasses.replace(CONFIG, greedy=False, temperature=0.0)


@pytest.mark.long
def test_tokens_of_a_rollout_are_independent_draws():
    """One key for all steps would repeat the first token."""
    said = jax.jit(lambda k: random_text(k, 200, 6))(jax.random.key(0))
    alive = said.mask[..., 1]
    same = (said.tokens[..., 0] == said.tokens[..., 1])[alive].mean()
    p = np.asarray(jax.nn.softmax(SCORES), np.float64)
    p = np.where(np.isin(np.arange(V), CONFIG.end_ids), 0, p)
    expected = (p**2).sum() / p.sum()
    assert abs(same - expected) < 5 * np.sqrt(expected / alive.sum())


@pytest.mark.parametrize("end", [END, STOP])
def test_end_token_is_counted_and_nothing_after_it(end):
    script = np.array([[end, 5, 5, 5, 5, 5]])
    said = jax.jit(lambda: draw(script))()
    np.testing.assert_array_equal(said.tokens[0, 0], [end, PAD, PAD, PAD, PAD, PAD])
    np.testing.assert_array_equal(said.mask[0, 0], [True] + [False] * 5)
    assert not said.log_prob[0, 0, 1:].any()


@pytest.mark.long
def test_greedy_answers_are_parsed_and_begin_with_the_most_likely_token():
    params, batch = tiny.shallow_params(), tiny.question_batch(1, 2)
    parser = compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)
    answers = make_answer(tiny.SHALLOW, parser, 3)(params, batch)
    assert answers.tokens.shape == (2, 3)
    for i in range(2):
        one = parser(answers.tokens[i])
        jax.tree.map(lambda a, b, i=i: np.testing.assert_array_equal(a, b[i]), one, answers.parsed)
    first, _ = jax.jit(jax.vmap(tiny.SHALLOW.prefill, in_axes=(None, 0, 0, 0)))(
        params, batch.features, batch.ids, batch.mask
    )
    np.testing.assert_array_equal(answers.tokens[:, 0], first.argmax(-1))
