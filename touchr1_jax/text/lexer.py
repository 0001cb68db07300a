"""From token ids to events: an automaton over characters, compiled on the host into tables over tokens.

Definitions, here and in the parser:
  White space is ASCII white space.  Word characters are Unicode's letters, marks, numbers and connectors (see
  `characters`); punctuation of any script, symbols and broken UTF-8 end a word as "." does.
  A tag is its literal lower-case bytes, `<perceive>`, wherever they stand, even inside a word; it breaks words.
  Phrases (level words, sensor names) match whole words outside tags, ASCII case-folded; a blank in a phrase matches one
  run of white space, a hyphen one hyphen.  Matching runs left to right over sensors and levels together; at each word
  the longest phrase wins and is consumed: "very hard" is no "hard" where both are phrases.

The events are: a tag, a phrase, and the first character after a tag (or the start) that is neither white nor part of a
tag.  A token is a function from state to (state, events); tokens with equal functions share a class, so that the tables
of a 150k vocabulary stay small.  A character that is cut between tokens counts at its last byte; its first emits that
there is text.
"""

import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from touchr1_jax.text.characters import A_BREAK, BEGUN, BOTH, NOTHING, WORD, Spelling
from touchr1_jax.text.language import Language
from touchr1_jax.text.tokenizer import Tokenizer

NONE, FIRST_TAG, TEXT, FIRST_PHRASE = 0, 1, 7, 8
"""Event codes: nothing; tag i is FIRST_TAG + i (open and close in turn); text; phrase p is FIRST_PHRASE + p."""

EMPTY_CLASS = 0
"""Class of the tokens that add nothing to the text."""

_WORD = re.compile(r"[a-z0-9_\x80]+")
_FOREIGN = "\x80"  # stands for every word that begins no phrase
_BREAK = "."  # stands for every character that is neither white, nor hyphen, nor of a word
_BEGUN = "…"  # stands for the first bytes of a character that is not ASCII

State = tuple[str, str, bool]  # beginning of a tag, beginning of a phrase, whether text was met since the last tag


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Lexer:
    """A language × tokenizer as tables: C token classes, Q states (0 starts), B lists of at most E events.

    Token v in state q leads to state `next_state[c, q]` and emits the events of list `event_list[c, q]`; the end of
    the text emits those of list `end_list[q]`.  `events[b]` is padded with `NONE`; list 0 is empty; class 0 changes
    nothing.
    Its class c is `token_class[j, v]`, where j is what its first bytes complete of a character that is cut between
    tokens: j = `completes[head[v], u]` for the open character u, after which `leaves[head[v], u]` is open, or `tail[v]`
    where that is not −1.
    """

    token_class: np.ndarray  # int32 [4, V]
    head: np.ndarray  # int32 [V]
    tail: np.ndarray  # int32 [V]
    completes: np.ndarray  # int32 [H, U]
    leaves: np.ndarray  # int32 [H, U]
    next_state: np.ndarray  # int32 [C, Q]
    event_list: np.ndarray  # int32 [C, Q]
    end_list: np.ndarray  # int32 [Q]
    events: np.ndarray  # int32 [B, E]

    @property
    def own_class(self) -> np.ndarray:
        """Class of each token as far as tags and text go, whatever is open before it, int32 [V]."""
        return np.where(self.completes[self.head, 0] == NOTHING, self.token_class[NOTHING], self.token_class[A_BREAK])


def phrases_of(language: Language) -> list[str]:
    """Every phrase of a language once; phrase p is event FIRST_PHRASE + p."""
    sensors = [p for sensor in language.sensors for p in sensor.phrases]
    levels = [p for attribute in language.attributes for level in attribute.levels for p in level]
    return list(dict.fromkeys(sensors + levels))


def tags_of(language: Language) -> list[str]:
    """The six tags, open and close in turn.

    Raises:
      ValueError: a tag name that is not one lower-case word, or that occurs twice.
    """
    for name in language.tags:
        if re.fullmatch(r"[a-z0-9_]+", name) is None or language.tags.count(name) > 1:
            raise ValueError(f"tags: {name!r} must be one lower-case ASCII word and differ from the others; rename it")
    return [tag for name in language.tags for tag in (f"<{name}>", f"</{name}>")]


def compile_lexer(language: Language, tokenizer: Tokenizer) -> Lexer:
    """Build the tables of a language for a vocabulary; well under a second for 150k tokens.

    The class of a token is found unit by unit: class(token + unit) = class(token) ∘ unit, each product computed once.
    """
    lists = _EventLists()
    rules = _Rules(language)
    states, unit_next, unit_list = _unit_tables(rules, lists)
    classes = _Classes(len(states), unit_next, unit_list, lists)
    spelling = Spelling(tokenizer.pieces)
    cases, tokens = range(NOTHING, BOTH + 1), range(len(tokenizer.pieces))
    token_class = np.array([[classes.of(spelling.completed(v, case)) for v in tokens] for case in cases])
    used, token_class = np.unique(np.append(token_class, EMPTY_CLASS), return_inverse=True)
    end_list = [lists.index(rules.finish(state)) for state in states]
    return Lexer(
        token_class=token_class[:-1].reshape(len(cases), -1).astype(np.int32),
        head=spelling.head,
        tail=spelling.tail,
        completes=spelling.completes,
        leaves=spelling.leaves,
        next_state=np.stack([classes.rows[c][0] for c in used]).astype(np.int32),
        event_list=np.stack([classes.rows[c][1] for c in used]).astype(np.int32),
        end_list=np.array(end_list, np.int32),
        events=lists.table(),
    )


class _Rules:
    """The automaton: one character leads from state to state and emits events."""

    start: State = ("", "", False)

    def __init__(self, language: Language) -> None:
        self.tags = {tag: FIRST_TAG + i for i, tag in enumerate(tags_of(language))}
        self.phrases = {phrase: FIRST_PHRASE + i for i, phrase in enumerate(phrases_of(language))}
        self.tag_beginnings = {tag[:n] for tag in self.tags for n in range(1, len(tag))}
        self.phrase_beginnings = {p[:n] for p in self.phrases for n in range(len(p) + 1)}
        self.letters = set("".join([*self.tags, *self.phrases]))

    def symbol(self, unit: int) -> str:
        """The character that stands for a unit of `characters`; one for all units that no rule distinguishes."""
        char = chr(unit)
        if char in " \t\n\r\v\f":
            return " "
        if unit == WORD or (unit < WORD and _WORD.fullmatch(char.lower()) and char.lower() not in self.letters):
            return _FOREIGN
        if unit == BEGUN:
            return _BEGUN
        return char if unit < WORD and (char.isalnum() or char in "_-</>") else _BREAK

    def step(self, state: State, char: str) -> tuple[State, list[int]]:
        """Read one symbol."""
        tag, phrase, met = state
        if tag + char in self.tags:
            return self.start, [self.tags[tag + char]]
        grows = tag + char in self.tag_beginnings
        is_text = not grows and (tag != "" or char not in " <")
        events = [TEXT] if is_text and not met else []
        next_tag = tag + char if grows else "<" if char == "<" else ""
        if char == _BEGUN:
            return (next_tag, phrase, True), events
        found, phrase = self._settle(self._extend(phrase, char))
        return (next_tag, phrase, met or is_text), events + found

    def finish(self, state: State) -> list[int]:
        """Events of the end of the text."""
        tag, phrase, met = state
        return ([TEXT] if tag and not met else []) + self._settle(phrase + _BREAK)[0]

    def _extend(self, phrase: str, char: str) -> str:
        if char == " ":
            return phrase if phrase.endswith(" ") else phrase + " "
        return phrase + (char.lower() if char == "-" or _WORD.fullmatch(char.lower()) else _BREAK)

    def _settle(self, text: str) -> tuple[list[int], str]:
        """Emit and drop words from the left until the rest begins a phrase; its last word may continue."""
        found = []
        while text not in self.phrase_beginnings:
            ends = [n for n in range(1, len(text)) if text[n] in " -." and text[:n] in self.phrases]
            if ends:
                found.append(self.phrases[text[: ends[-1]]])
                text = text[ends[-1] :]
            else:
                word = _WORD.match(text)
                if word is not None and word.end() == len(text):
                    return found, _FOREIGN
                text = text[word.end() :] if word is not None else text
            text = text.lstrip(" -.")
        return found, text


class _EventLists:
    """Numbers each distinct list of events; list 0 is empty."""

    def __init__(self) -> None:
        self._index: dict[tuple[int, ...], int] = {(): 0}
        self._lists: list[tuple[int, ...]] = [()]

    def index(self, events: list[int] | tuple[int, ...]) -> int:
        key = tuple(events)
        if key not in self._index:
            self._index[key] = len(self._lists)
            self._lists.append(key)
        return self._index[key]

    def joined(self, first: int, second: int) -> int:
        return self.index(self._lists[first] + self._lists[second])

    def table(self) -> np.ndarray:
        """The lists, padded with `NONE`, int32 [B, E]."""
        table = np.full((len(self._lists), max(1, *map(len, self._lists))), NONE, np.int32)
        for row, events in zip(table, self._lists, strict=True):
            row[: len(events)] = events
        return table


def _unit_tables(rules: _Rules, lists: _EventLists) -> tuple[list[State], np.ndarray, np.ndarray]:
    """Explore the automaton: its Q states, next state [131, Q] and event list [131, Q] of each unit."""
    symbols = [rules.symbol(unit) for unit in range(BEGUN + 1)]
    states: dict[State, int] = {rules.start: 0}
    columns: list[dict[str, tuple[int, int]]] = []
    queue = [rules.start]
    for state in queue:  # grows while it is read
        column = {}
        for char in dict.fromkeys(symbols):
            after, events = rules.step(state, char)
            if after not in states:
                states[after] = len(states)
                queue.append(after)
            column[char] = (states[after], lists.index(events))
        columns.append(column)
    table = np.array([[column[char] for column in columns] for char in symbols])
    return queue, table[..., 0], table[..., 1]


class _Classes:
    """Distinct functions state → (state, events) and their products with single units."""

    def __init__(self, states: int, unit_next: np.ndarray, unit_list: np.ndarray, lists: _EventLists) -> None:
        self._unit_next, self._unit_list, self._lists = unit_next, unit_list, lists
        self._symbol = np.unique(np.concatenate([unit_next, unit_list], 1), axis=0, return_inverse=True)[1].tolist()
        identity = (np.arange(states), np.zeros(states, np.int64))
        self.rows: list[tuple[np.ndarray, np.ndarray]] = [identity]
        self._index: dict[bytes, int] = {self._key(identity): EMPTY_CLASS}
        self._product: dict[tuple[int, int], int] = {}

    def of(self, piece: Sequence[int]) -> int:
        """Class of a token that adds these units."""
        token_class = EMPTY_CLASS
        for unit in piece:
            key = (token_class, self._symbol[unit])
            if key not in self._product:
                self._product[key] = self._compose(token_class, unit)
            token_class = self._product[key]
        return token_class

    def _compose(self, token_class: int, unit: int) -> int:
        state, events = self.rows[token_class]
        after, more = self._unit_next[unit][state], self._unit_list[unit][state]
        joined = np.where(events == 0, more, events)
        for q in np.flatnonzero((events != 0) & (more != 0)):
            joined[q] = self._lists.joined(int(events[q]), int(more[q]))
        key = self._key((after, joined))
        if key not in self._index:
            self._index[key] = len(self.rows)
            self.rows.append((after, joined))
        return self._index[key]

    @staticmethod
    def _key(row: tuple[np.ndarray, np.ndarray]) -> bytes:
        return row[0].tobytes() + row[1].tobytes()
