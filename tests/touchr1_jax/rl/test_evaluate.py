"""Greedy answers as evaluation reads them."""

import jax
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rl.evaluate import make_answer
from touchr1_jax.text.parser import compile_parser

T = 3
PARSER = compile_parser(tiny.LANGUAGE, tiny.TOKENIZER)


@pytest.fixture(scope="module")
def said():
    return make_answer(tiny.SHALLOW, PARSER, T)(tiny.shallow_params(), tiny.question_batch(1, 2))


def test_one_parsed_answer_per_prompt(said):
    assert said.tokens.shape == (2, T)
    assert said.parsed.perceive.shape == (2, tiny.S, tiny.A)
    for i in range(2):
        one = PARSER(said.tokens[i])
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(said.parsed), strict=True):
            np.testing.assert_array_equal(a, b[i])


def test_first_token_is_the_most_likely(said):
    batch = tiny.question_batch(1, 2)
    prefill = jax.jit(jax.vmap(tiny.SHALLOW.prefill, in_axes=(None, 0, 0, 0)))
    first, _ = prefill(tiny.shallow_params(), batch.features, batch.ids, batch.mask)
    np.testing.assert_array_equal(said.tokens[:, 0], first.argmax(-1))
