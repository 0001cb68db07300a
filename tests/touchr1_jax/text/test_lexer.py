import dataclasses

import numpy as np
import pytest

from tests.touchr1_jax.text.vocabularies import LANGUAGES, TRICKY, make_tokenizer
from touchr1_jax.text.characters import A_BREAK, A_WORD, Spelling
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.lexer import EMPTY_CLASS, FIRST_PHRASE, FIRST_TAG, TEXT, compile_lexer, phrases_of, tags_of
from touchr1_jax.text.tokenizer import Tokenizer


def events_of(language, text: str) -> list[str]:
    """Events of a text, spelled byte by byte, in words."""
    tokenizer = make_tokenizer("character", language)
    lexer = compile_lexer(language, tokenizer)
    names = {TEXT: "text"} | {FIRST_PHRASE + i: p for i, p in enumerate(phrases_of(language))}
    names |= {FIRST_TAG + i: t for i, t in enumerate(("<p>", "</p>", "<s>", "</s>", "<a>", "</a>"))}
    state, seen = 0, []
    for token in tokenizer.encode(text):
        c = lexer.token_class[0, token]
        seen += lexer.events[lexer.event_list[c, state]].tolist()
        state = lexer.next_state[c, state]
    seen += lexer.events[lexer.end_list[state]].tolist()
    return [names[event] for event in seen if event]


@pytest.mark.parametrize(
    ("text", "events"),
    [
        ("very hard", ["text", "very hard"]),
        ("very soft", ["text", "very", "soft"]),
        ("very  \n\t\r\v\f hard", ["text", "very hard"]),
        ("very-hard", ["text", "very", "hard"]),
        ("x-y", ["text", "x-y"]),
        ("x -y", ["text"]),
        ("a b c d", ["text", "a b c d"]),
        ("a b c x", ["text", "b c"]),
        ("a b c dd", ["text", "b c"]),
        ("b c d e", ["text", "b c d e"]),
        ("b c d x", ["text", "b c"]),
        ("a-b c", ["text", "a-b c"]),
        ("a-b <", ["text"]),
        ("not so hard", ["text", "not so hard"]),
        ("not so soft", ["text", "not", "soft"]),
        ("very<perceive>hard", ["text", "very", "<p>", "text", "hard"]),
        ("<perceive", ["text"]),
        ("<perceive <perceive>", ["text", "<p>"]),
        ("<<compare></compare>", ["text", "<s>", "</s>"]),
        ("<compare >", ["text", "compare"]),
        ("  \t", []),
    ],
)
def test_events(text, events):
    assert events_of(TRICKY, text) == events


@pytest.mark.parametrize("tags", [("a", "b", "a"), ("a b", "c", "d"), ("A", "b", "c")])
def test_tags_are_different_lower_case_words(tags):
    with pytest.raises(ValueError, match=r"tags: .* must be one lower-case ASCII word and differ"):
        tags_of(dataclasses.replace(TOUCH_LANGUAGE, tags=tags))


@pytest.mark.parametrize("language", LANGUAGES)
def test_tokens_that_act_alike_share_a_class(language):
    pieces = (b"", b"", b"", b"", b" q", b" zq", b"  Z", b"\n$", b"*", b"(", b"\xff", b"Q", b"soft", b"SOFT")
    tokenizer = Tokenizer(pieces=pieces, pad_id=0, end_ids=(1,), tactile_id=2, view_id=3, encoder=lambda text: [])
    classes = compile_lexer(LANGUAGES[language], tokenizer).own_class
    assert set(classes[:4]) == {EMPTY_CLASS}
    for same in ((4, 5, 6), (8, 9, 10), (12, 13)):
        assert len(set(classes[list(same)])) == 1, [pieces[i] for i in same]
    assert len(set(classes)) == 5


def test_class_of_empty_tokens_changes_nothing():
    lexer = compile_lexer(TOUCH_LANGUAGE, make_tokenizer("word", TOUCH_LANGUAGE))
    states = lexer.next_state.shape[1]
    np.testing.assert_array_equal(lexer.next_state[EMPTY_CLASS], np.arange(states))
    assert not lexer.event_list[EMPTY_CLASS].any()
    assert not lexer.events[0].any()


@pytest.mark.long
def test_tables_stay_small_for_a_big_vocabulary():
    rng = np.random.default_rng(0)
    letters = np.frombuffer(b"abcdefghijklmnopqrstuvwxyz .,<>/-_A", np.uint8)
    random = [rng.choice(letters, rng.integers(1, 7)).tobytes() for _ in range(30_000)]
    pieces = (b"", b"", b"", b"", *random)
    tokenizer = Tokenizer(pieces=pieces, pad_id=0, end_ids=(1,), tactile_id=2, view_id=3, encoder=lambda text: [])
    lexer = compile_lexer(TOUCH_LANGUAGE, tokenizer)
    assert lexer.token_class.shape == (4, 30_004)
    assert len(lexer.next_state) < 3_000
    assert lexer.events.shape[1] <= 6


@pytest.mark.parametrize(("char", "case"), [("é", A_WORD), ("中", A_WORD), ("、", A_BREAK), ("🖐", A_BREAK)])
def test_a_character_is_the_same_wherever_it_is_cut(char, case):
    code = char.encode()
    for i in range(1, len(code)):
        cut = Spelling((code[:i], code[i:]))
        assert cut.completes[cut.head[1], cut.tail[0]] == case
