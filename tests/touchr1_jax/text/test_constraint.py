"""Whatever a constrained sampler draws is formatted and ends in time, for any vocabulary."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.text.vocabularies import character_level
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.rl.rollout import SampleConfig, sample
from touchr1_jax.text.constraint import compile_constraint
from touchr1_jax.text.oracle import read
from touchr1_jax.text.parser import compile_parser
from touchr1_jax.text.tokenizer import Tokenizer

TOKENIZERS = {"words": tiny.TOKENIZER, "characters": character_level()}


def draw(tokenizer: Tokenizer, length: int, rows: int, key: int = 0):
    """Completions of a policy that prefers nothing."""
    scores = jnp.where(jnp.asarray(tokenizer.banned), -1e9, 0.0)
    config = SampleConfig(
        group=rows,
        length=length,
        end_ids=tokenizer.end_ids,
        pad_id=tokenizer.pad_id,
        inverse=True,
        constraint=compile_constraint(tiny.LANGUAGE, tokenizer),
    )
    prefix = PrefixCache((), jnp.ones((1, 1), bool), jnp.zeros(1, jnp.int32))
    run = lambda k: sample(lambda o, t, past, c: (scores, c), scores[None], prefix, (), k, config)
    return jax.tree.map(lambda x: x[0], jax.jit(run)(jax.random.key(key)))


@pytest.mark.long
@pytest.mark.parametrize(("name", "extra"), [("words", 0), ("words", 12), ("characters", 0), ("characters", 40)])
def test_every_draw_is_formatted_and_ends(name, extra):
    tokenizer = TOKENIZERS[name]
    length = compile_constraint(tiny.LANGUAGE, tokenizer).shortest + extra
    said = draw(tokenizer, length, 64)
    parsed = jax.jit(jax.vmap(compile_parser(tiny.LANGUAGE, tokenizer)))(said.tokens)
    assert parsed.formatted.all()
    assert not parsed.truncated.any()
    for row, mask in zip(np.asarray(said.tokens), np.asarray(said.mask), strict=True):
        assert read(tiny.LANGUAGE, tokenizer.decode(row[mask])).formatted
    if extra:
        assert len(np.unique(said.tokens, axis=0)) > 60


def test_shortest_answer_by_hand():
    """Six tags, a word in each body, the end; characters are counted one by one."""
    assert compile_constraint(tiny.LANGUAGE, TOKENIZERS["words"]).shortest == 10
    letters = sum(len(f"<{tag}></{tag}>") for tag in tiny.LANGUAGE.tags)
    assert compile_constraint(tiny.LANGUAGE, TOKENIZERS["characters"]).shortest == letters + 3 + 1


def test_log_probabilities_are_those_of_the_free_policy():
    said = draw(TOKENIZERS["words"], 20, 8)
    free = -np.log(np.sum(~TOKENIZERS["words"].banned))
    np.testing.assert_allclose(said.log_prob, np.where(said.mask, free, 0), rtol=1e-5)


@pytest.mark.long
def test_tags_of_another_language_need_no_code():
    language = dataclasses.replace(tiny.LANGUAGE, tags=("feel", "weigh", "say"))
    constraint = compile_constraint(language, character_level())
    ids = character_level().encode("<feel>x</feel> and <weigh>y</weigh><say>z</say> ")
    state = jnp.int32(0)
    for token in ids:
        assert constraint.allowed(state, jnp.int32(100))[token]
        state = constraint.advance(state, jnp.int32(token))
    assert constraint.allowed(state, jnp.int32(1))[1]
    letter = jnp.int32(character_level().encode("x")[0])
    assert not constraint.allowed(state, jnp.int32(100))[letter]
    assert constraint.advance(state, letter) == constraint.advance(state, jnp.int32(1)) == state


def test_a_vocabulary_without_tags_is_refused():
    small = Tokenizer(
        pieces=(b"", b"", b"", b"", b"a"), pad_id=0, end_ids=(1,), tactile_id=2, view_id=3, encoder=lambda text: []
    )
    with pytest.raises(ValueError, match="no sequence of tokens of this vocabulary is a formatted answer"):
        compile_constraint(tiny.LANGUAGE, small)
