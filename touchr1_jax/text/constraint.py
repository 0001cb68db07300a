"""Constrained decoding from the parser's tables: only tokens from which a formatted answer can still be finished.

A state joins the lexer's state with the place in the answer: how many of the six tags were read, and whether the body
that is open holds text.  From every state the fewest tokens to the end are known, so that an answer closes in time.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from touchr1_jax.text.language import Language
from touchr1_jax.text.lexer import FIRST_PHRASE, FIRST_TAG, NONE, TEXT, Lexer, compile_lexer
from touchr1_jax.text.tokenizer import Tokenizer

_TAGS = 6
_PLACES = 2 * (_TAGS + 1)  # tags read, times whether the open body is filled
_NEVER = 1 << 20  # more tokens than any completion has
_REJECTED = -1


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Constraint:
    """Tables of a language for a tokenizer; state 0 starts, C are the lexer's token classes.

    `successor[s, c]` is the state after a token of class c, `need[s]` the fewest tokens to the end, end token included,
    `may_end[s]` whether the end token may come.
    """

    token_class: np.ndarray  # int32 [V]
    is_end: np.ndarray  # bool [V]
    successor: np.ndarray  # int32 [states, C], −1 where no formatted answer can follow
    need: np.ndarray  # int32 [states]
    may_end: np.ndarray  # bool [states]

    @property
    def shortest(self) -> int:
        """Tokens of the shortest formatted answer, end token included."""
        return int(self.need[0])

    def allowed(self, state: Int[Array, "*n"], left: Int[Array, ""]) -> Bool[Array, "*n V"]:
        """Mask of the tokens that may come next when `left` tokens remain, this one included."""
        after = jnp.asarray(self._need_after)[state] < left
        return jnp.where(self.is_end, jnp.asarray(self.may_end)[state][..., None], after[..., self.token_class])

    def advance(self, state: Int[Array, "*n"], token: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """The state after a token; it stays where the token is an end token or not allowed."""
        after = jnp.asarray(self.successor)[state, jnp.asarray(self.token_class)[token]]
        return jnp.where(jnp.asarray(self.is_end)[token] | (after < 0), state, after)

    @property
    def _need_after(self) -> np.ndarray:
        """Fewest tokens to the end after a token of each class, int32 [states, C]."""
        return np.where(self.successor < 0, _NEVER, self.need[self.successor])


def compile_constraint(language: Language, tokenizer: Tokenizer) -> Constraint:
    """The constraint of a language for a tokenizer.

    Raises:
      ValueError: the vocabulary cannot write a formatted answer.
    """
    lexer = compile_lexer(language, tokenizer)
    is_end = np.isin(np.arange(tokenizer.vocab_size), tokenizer.end_ids)
    place_after = _places_after(lexer.events)
    successor = _successors(lexer, place_after)
    may_end = (place_after[lexer.end_list] // 2 == _TAGS).reshape(-1)
    writable = np.unique(lexer.own_class[~tokenizer.banned & ~is_end])
    need = _fewest_tokens(successor[:, writable], may_end)
    if need[0] >= _NEVER:
        raise ValueError(
            f"tags {language.tags}: no sequence of tokens of this vocabulary is a formatted answer; "
            "add tokens that write the tags and some text"
        )
    return Constraint(token_class=lexer.own_class, is_end=is_end, successor=successor, need=need, may_end=may_end)


def _places_after(events: np.ndarray) -> np.ndarray:
    """Place after each list of events from each place, int32 [lists, places]; −1 if no formatted answer can follow."""
    after = np.tile(np.arange(_PLACES, dtype=np.int32), (len(events), 1))
    for place_row, row in zip(after, events, strict=True):
        for event in row:
            place_row[:] = [_read(int(place), int(event)) for place in place_row]
    return after


def _read(place: int, event: int) -> int:
    tags, filled = divmod(place, 2)
    if place < 0 or event == NONE or event >= FIRST_PHRASE:
        return place
    if event == TEXT:
        return _REJECTED if tags == _TAGS else 2 * tags + tags % 2  # free text outside bodies fills nothing
    closes = tags % 2 == 1
    return 2 * (tags + 1) if event - FIRST_TAG == tags and (filled or not closes) else _REJECTED


def _successors(lexer: Lexer, place_after: np.ndarray) -> np.ndarray:
    """State after each class from each state, int32 [Q · places, C]; state = lexer state · places + place."""
    place = place_after[lexer.event_list]  # [C, Q, places]
    state = np.where(place < 0, _REJECTED, lexer.next_state[..., None] * _PLACES + place)
    return state.reshape(len(state), -1).T.astype(np.int32)


def _fewest_tokens(successor: np.ndarray, may_end: np.ndarray) -> np.ndarray:
    """Fewest tokens from each state to the end, end token included, by relaxation until nothing changes."""
    need = np.where(may_end, 1, _NEVER).astype(np.int32)
    while True:
        after = np.where(successor < 0, _NEVER, need[successor]).min(1)
        shorter = np.minimum(need, np.minimum(after + 1, _NEVER))
        if np.array_equal(shorter, need):
            return need
        need = shorter
