"""The turns of a policy that acts before it answers, as an automaton over tokens.

    <touch> tac3d slide 5n </touch>
    <conclude> hard </conclude>

A turn is one action or the conclusion.  Its text is that of the tokenizer's own encoding: other token sequences of the
same text are malformed, as is any other text.  A turn ends with its last token, or with the first token that no legal
turn has at its place.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from touchr1_jax.text.language import EXPLORED_ATTRIBUTES, Attribute
from touchr1_jax.text.tokenizer import Tokenizer, word_tokenizer

ANY_TURN, LAST_TURN, LEFT = 0, 1, 2
"""Places of the automaton: the start of a turn, the start of one that must conclude, and outside of all turns."""

QUESTIONS_OF_TOUCH: Mapping[str, str] = {
    "hardness": "how hard is it",
    "roughness": "how rough is it",
    "protrusion": "how protruding is it",
    "elasticity": "how elastic is it",
    "friction": "how slippery is it",
}
"""Question for each attribute that a policy can explore."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TurnLanguage:
    """Actions and answers that turns can name; `tags` enclose an action and the conclusion.

    Without `repeats` a constrained policy takes each action at most once in a trajectory.
    """

    actions: tuple[str, ...]
    attributes: tuple[Attribute, ...] = EXPLORED_ATTRIBUTES
    repeats: bool = True
    tags: tuple[str, str] = ("touch", "conclude")

    def action_text(self, action: int) -> str:
        """The turn that chooses an action."""
        return self._enclosed(0, self.actions[action])

    def answer_text(self, word: str) -> str:
        """The turn that concludes with a level word."""
        return self._enclosed(1, word)

    @property
    def words(self) -> tuple[str, ...]:
        """Words of all levels, each once."""
        phrases = (p for attribute in self.attributes for level in attribute.levels for p in level)
        return tuple(dict.fromkeys(phrases))

    def _enclosed(self, tag: int, body: str) -> str:
        return f"<{self.tags[tag]}> {body} </{self.tags[tag]}>"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Turns:
    """The turns of a language for a tokenizer, as tables; a place is a prefix of legal turns, c a class of tokens.

    `action[place]` is the action that is named completely there and `answer[place, a]` the level of attribute a, both
    −1 elsewhere.  `LEFT` stays `LEFT`.  `names[place, i]` is true where a turn through that place can name action i, in
    the last column where it can conclude; it is `None` where actions may be repeated.
    """

    token_class: np.ndarray  # int32 [V]; class 0 are the tokens of no turn
    successor: np.ndarray  # int32 [places, classes]
    action: np.ndarray  # int32 [places]
    answer: np.ndarray  # int32 [places, A]
    length: int
    """Tokens of the longest turn."""
    names: np.ndarray | None = None  # bool [places, C + 1]

    def allowed(self, place: Int[Array, "*n"], made: Int[Array, "*n B"]) -> Bool[Array, "*n V"]:
        """Mask of the tokens that continue a turn.

        Args:
          place: where the turn is.
          made: actions of the turns before it, −1 for none; a turn that must not repeat them cannot name them.
        """
        after = jnp.asarray(self.successor)[place]
        continues = after != LEFT
        if self.names is not None:
            new = ~jnp.any(made[..., None] == jnp.arange(self.names.shape[1]), -2)
            can_end = jnp.einsum("...i,ki->...k", new.astype(jnp.float32), jnp.asarray(self.names, jnp.float32)) > 0
            continues &= jnp.take_along_axis(can_end, after, -1)
        return continues[..., self.token_class]

    def advance(self, place: Int[Array, "*n"], token: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """The place after a token."""
        return jnp.asarray(self.successor)[place, jnp.asarray(self.token_class)[token]]

    def ends(self, place: Int[Array, "*n"]) -> Bool[Array, "*n"]:
        """True where a turn is complete or malformed."""
        complete = (self.action >= 0) | (self.answer >= 0).any(-1)
        return jnp.asarray(complete)[place] | (place == LEFT)

    def places(self, tokens: Int[Array, "K T"], last: Bool[Array, "K"]) -> tuple[Int[Array, "K T"], Int[Array, "K"]]:
        """The place before each token of some turns, and the place after each turn.

        Args:
          tokens: token ids of K turns; what follows a turn's end changes nothing.
          last: turns that must conclude.
        """

        def step(place: Int[Array, "K"], token: Int[Array, "K"]) -> tuple[Int[Array, "K"], Int[Array, "K"]]:
            return jnp.where(self.ends(place), place, self.advance(place, token)), place

        start = jnp.where(last, LAST_TURN, ANY_TURN)
        final, before = jax.lax.scan(step, start, tokens.T)
        return before.T, final


def compile_turns(language: TurnLanguage, tokenizer: Tokenizer) -> Turns:
    """The automaton of a language's turns for a tokenizer.

    Raises:
      ValueError: no action, no level, or two turns of which one is the beginning of the other in tokens.
    """
    if not language.actions or not language.words:
        raise ValueError(
            f"the language has {len(language.actions)} actions and {len(language.words)} level words: must have both"
        )
    acts = [tokenizer.encode(language.action_text(i)) for i in range(len(language.actions))]
    answers = [tokenizer.encode(language.answer_text(word)) for word in language.words]
    known = sorted({token for turn in acts + answers for token in turn})
    token_class = np.zeros(tokenizer.vocab_size, np.int32)
    token_class[known] = 1 + np.arange(len(known))
    rows: list[dict[int, int]] = [{}, {}, {}]
    paths = [_insert(rows, ANY_TURN, turn) for turn in acts + answers]
    last_paths = [_insert(rows, LAST_TURN, turn) for turn in answers]
    ends_with, concludes_with = ([path[-1] for path in of_root] for of_root in (paths, last_paths))
    meanings = [-1] * len(rows)
    levels = np.full((len(rows), len(language.attributes)), -1, np.int32)
    for action in range(len(acts)):
        meanings[ends_with[action]] = action
    for places in (ends_with[len(acts) :], concludes_with):
        for place, word in zip(places, language.words, strict=True):
            levels[place] = [_level(attribute, word) for attribute in language.attributes]
    ends = [*ends_with, *concludes_with]
    if len(set(ends)) < len(ends) or any(rows[place] for place in ends):
        raise ValueError("one turn is the beginning of another in tokens; give actions and levels different words")
    successor = np.full((len(rows), 1 + len(known)), LEFT, np.int32)
    for place, row in enumerate(rows):
        for token, after in row.items():
            successor[place, token_class[token]] = after
    names = np.zeros((len(rows), len(acts) + 1), bool)
    for i, path in enumerate(paths + last_paths):
        names[path, min(i, len(acts))] = True
    return Turns(
        token_class=token_class,
        successor=successor,
        action=np.array(meanings, np.int32),
        answer=levels,
        length=max(map(len, acts + answers)),
        names=None if language.repeats else names,
    )


def turn_tokenizer(language: TurnLanguage) -> Tokenizer:
    """A tokenizer with one id for each word of the turns and of the questions."""
    turns = [language.action_text(i) for i in range(len(language.actions))]
    return word_tokenizer([*turns, *map(language.answer_text, language.words), *QUESTIONS_OF_TOUCH.values()])


def _insert(rows: list[dict[int, int]], root: int, turn: list[int]) -> list[int]:
    """Add the tokens of a turn below a root; the places after each of them."""
    path = [root]
    for token in turn:
        if token not in rows[path[-1]]:
            rows[path[-1]][token] = len(rows)
            rows.append({})
        path.append(rows[path[-1]][token])
    return path[1:]


def _level(attribute: Attribute, word: str) -> int:
    """Level of an attribute that a word names, −1 for none."""
    return next((k for k, words in enumerate(attribute.levels) if word in words), -1)
