"""Turns are read from tokens, and the automaton allows exactly what continues one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.text.language import EXPLORED_ATTRIBUTES
from touchr1_jax.text.turns import ANY_TURN, LAST_TURN, TurnLanguage, compile_turns, turn_tokenizer

LANGUAGE = TurnLanguage(actions=("tac3d slide 5n", "xense press 2n", "xense slide 2n"))
TOKENIZER = turn_tokenizer(LANGUAGE)
TURNS = compile_turns(LANGUAGE, TOKENIZER)
PLACES = jax.jit(TURNS.places)


def read(text: str, *, last: bool = False) -> tuple[int, list[int]]:
    """Action and levels of one turn."""
    ids = TOKENIZER.encode(text)
    padded = np.array([ids + [TOKENIZER.pad_id] * (TURNS.length - len(ids))])
    place = int(PLACES(padded, np.array([last]))[1][0])
    return int(TURNS.action[place]), TURNS.answer[place].tolist()


NO_LEVEL = [-1] * len(EXPLORED_ATTRIBUTES)


@pytest.mark.parametrize(("action", "words"), list(enumerate(LANGUAGE.actions)))
def test_every_action_is_read(action, words):
    assert read(f"<touch> {words} </touch>") == (action, NO_LEVEL)


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize(("a", "k"), [(a, k) for a in range(len(NO_LEVEL)) for k in range(3)])
def test_every_level_is_read(a, k, last):
    word = EXPLORED_ATTRIBUTES[a].levels[k][0]
    levels = [k if i == a else -1 for i in range(len(NO_LEVEL))]
    assert read(f"<conclude> {word} </conclude>", last=last) == (-1, levels)


MALFORMED = (
    "<touch> tac3d press 2n </touch>",
    "<touch> tac3d slide 5n",
    "<touch> hard </touch>",
    "<conclude> hard </touch>",
    "hard",
    "",
)


@pytest.mark.parametrize("text", MALFORMED)
def test_anything_else_names_nothing(text):
    assert read(text) == (-1, NO_LEVEL)


def test_the_last_turn_must_conclude():
    assert read("<touch> xense slide 2n </touch>", last=True) == (-1, NO_LEVEL)


ONCE = compile_turns(dataclasses.replace(LANGUAGE, repeats=False), TOKENIZER)


def words_after(text: str, place: int = ANY_TURN, turns=TURNS, made=()) -> set[str]:
    """Tokens that the automaton allows after a text, and after these actions."""
    before = jnp.array([*made, -1])
    for token in TOKENIZER.encode(text):
        place = int(TURNS.advance(jnp.array(place), jnp.array(token)))
    return {TOKENIZER.pieces[i].decode().strip() for i in np.flatnonzero(turns.allowed(jnp.array(place), before))}


def test_allowed_tokens_are_those_that_continue_a_turn():
    assert words_after("") == {"<touch>", "<conclude>"}
    assert words_after("", LAST_TURN) == {"<conclude>"}
    assert words_after("<touch>") == {"tac3d", "xense"}
    assert words_after("<touch> xense") == {"press", "slide"}
    assert words_after("<touch> xense slide 2n") == {"</touch>"}
    assert words_after("<conclude>") == set(LANGUAGE.words)
    assert words_after("<touch> xense slide 2n </touch>") == set()


def test_a_turn_that_must_not_repeat_an_action_names_another_or_concludes():
    assert words_after("<touch>", turns=ONCE) == {"tac3d", "xense"}
    assert words_after("<touch>", turns=ONCE, made=(0,)) == {"xense"}
    assert words_after("<touch>", turns=ONCE, made=(1,)) == {"tac3d", "xense"}
    assert words_after("<touch> xense", turns=ONCE, made=(1,)) == {"slide"}
    assert words_after("", turns=ONCE, made=(2, 0, 1)) == {"<conclude>"}
    assert words_after("<conclude>", turns=ONCE, made=(2, 0, 1)) == set(LANGUAGE.words)
    assert words_after("", LAST_TURN, turns=ONCE, made=(2, 0)) == {"<conclude>"}


@pytest.mark.parametrize("actions", [(), ("press", "press")])
def test_languages_without_a_choice_or_with_two_equal_turns_are_refused(actions):
    language = TurnLanguage(actions=actions)
    with pytest.raises(ValueError, match=r"must have both|different words"):
        compile_turns(language, turn_tokenizer(language))
