"""The parser of answers: from token ids to levels, inside the jitted step and for any tokenizer.

    parser = compile_parser(TOUCH_LANGUAGE, tokenizer)
    parsed = jax.vmap(parser)(tokens)  # tokens int32 [G, T]

Rules (tags, phrases and white space are defined in `lexer`):
  The text is that of the tokens before the first end token; without one the answer is truncated and read as it stands.
  The body of a segment lies between its open and its close tag.  It counts only where each of the two tags occurs
  exactly once in the whole text and the open one comes first; otherwise all slots of the segment are ⊥ (−1).
  A level named in `perceive` belongs to the sensor last named before it in that body, and to none if there is none.
  `compare` and `conclude` have one slot; sensor names are ignored there.
  A slot that names no level of an attribute, or two different ones, is ⊥ for it; one named twice counts,
  and negation is ignored: "not hard" is hard.
  Formatted: each of the six tags exactly once, in order, no body without a non-white character, nothing but white space
  after the last tag.  Free text may stand before and between the segments.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from touchr1_jax.text.language import Language
from touchr1_jax.text.lexer import EMPTY_CLASS, FIRST_PHRASE, FIRST_TAG, TEXT, Lexer, compile_lexer, phrases_of
from touchr1_jax.text.tokenizer import Tokenizer
from touchr1_jax.types import Parsed

_MAX_LEVELS = 31  # levels of an attribute are bits of an int32
_UNROLL = 8


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Parser:
    """A pure function from the tokens of one completion to `Parsed`, with constant tables."""

    lexer: Lexer
    end_ids: tuple[int, ...]
    sensors: int
    sensor_of: np.ndarray  # int32 [events], the sensor that an event names, −1 for none
    levels_of: np.ndarray  # int32 [events, A], bit k where an event names level k of an attribute
    ordinal: tuple[bool, ...]  # of each attribute

    @property
    def levels(self) -> tuple[int, ...]:
        """Number of levels of each attribute."""
        return tuple(int(bits).bit_length() for bits in np.bitwise_or.reduce(self.levels_of, axis=0))

    @property
    def ordinal_levels(self) -> int:
        """Most levels of an ordinal attribute, 0 without any."""
        return max(itertools.compress(self.levels, self.ordinal), default=0)

    def __call__(self, tokens: Int[Array, "*T"]) -> Parsed:
        """Parse one completion; tokens from the first end token on are ignored.

        Raises:
          ValueError: tokens with a batch dimension.
        """
        if tokens.ndim != 1:
            raise ValueError(f"tokens have shape {tokens.shape}: must be one completion [T]; use jax.vmap(parser)")
        is_end = jnp.any(tokens[:, None] == jnp.array(self.end_ids), axis=-1)
        ended = jnp.cumsum(is_end) > 0
        token_class = jnp.where(ended, EMPTY_CLASS, self._classes(tokens))
        perceive, compare, conclude, formatted = self._read(self._events(token_class))
        return Parsed(
            perceive=perceive,
            compare=compare,
            conclude=conclude,
            formatted=formatted,
            truncated=~jnp.any(is_end),
            length=jnp.sum(~ended, dtype=jnp.int32),
        )

    def segments(self, tokens: Int[Array, "T"]) -> Int[Array, "T"]:
        """Segment of each token: 0 up to the end of `perceive`, 1 up to the end of `compare` after it, then 2."""
        events = self._events(self._classes(tokens)).reshape(len(tokens) + 1, -1)[:-1]
        perceived, compared = (jnp.any(events == FIRST_TAG + closing, -1).astype(jnp.int32) for closing in (1, 3))
        before = lambda x: (jnp.cumsum(x) - x > 0).astype(jnp.int32)
        return before(perceived) * (1 + before(compared))

    def _classes(self, tokens: Int[Array, "T"]) -> Int[Array, "T"]:
        """Class of each token after those before it, of which it may complete a character."""
        lexer, whole = self.lexer, jnp.asarray(self.lexer.token_class)
        if lexer.completes.shape[1] == 1:
            return whole[0, tokens]  # no token holds a part of a character
        completes, leaves = jnp.asarray(lexer.completes), jnp.asarray(lexer.leaves)

        def step(
            is_open: Int[Array, ""], token: tuple[Int[Array, ""], Int[Array, ""]]
        ) -> tuple[Int[Array, ""], Int[Array, ""]]:
            head, tail = token
            return jnp.where(tail < 0, leaves[head, is_open], tail), completes[head, is_open]

        each = (jnp.asarray(lexer.head)[tokens], jnp.asarray(lexer.tail)[tokens])
        _, completed = jax.lax.scan(step, jnp.int32(0), each, unroll=_UNROLL)
        return whole[completed, tokens]

    def _events(self, token_class: Int[Array, "T"]) -> Int[Array, "N"]:
        """Events of a text in order, `NONE` in between."""
        next_state, event_list = jnp.asarray(self.lexer.next_state), jnp.asarray(self.lexer.event_list)

        def step(state: Int[Array, ""], c: Int[Array, ""]) -> tuple[Int[Array, ""], Int[Array, ""]]:
            return next_state[c, state], event_list[c, state]

        state, lists = jax.lax.scan(step, jnp.int32(0), token_class, unroll=_UNROLL)
        lists = jnp.append(lists, jnp.asarray(self.lexer.end_list)[state])
        return jnp.asarray(self.lexer.events)[lists].reshape(-1)

    def _read(
        self, events: Int[Array, "N"]
    ) -> tuple[Int[Array, "S A"], Int[Array, "A"], Int[Array, "A"], Bool[Array, ""]]:
        """The slots that a sequence of events fills, and true if it is formatted."""
        order = jnp.arange(events.size)
        hit = events == FIRST_TAG + jnp.arange(6)[:, None]
        once, at = jnp.sum(hit, axis=1) == 1, jnp.argmax(hit, axis=1)
        start, stop = at[0::2, None], at[1::2, None]
        inside = (once[0::2] & once[1::2])[:, None] & (start < order) & (order < stop)  # [3, N]
        is_text = events == TEXT
        filled = jnp.all(jnp.any(inside & is_text, axis=1))
        formatted = jnp.all(once) & jnp.all(at[1:] > at[:-1]) & filled & ~jnp.any(is_text & (order > at[-1]))
        slots = jnp.concatenate([inside[0] & self._sensor_in_force(events, inside[0]), inside[1:]])  # [S + 2, N]
        levels = jnp.asarray(self.levels_of)[events]
        named = jnp.where(slots[:, :, None], levels, 0)
        level = _only_bit(jax.lax.reduce(named, jnp.int32(0), jax.lax.bitwise_or, (1,)))  # [S + 2, A]
        return level[: self.sensors], level[self.sensors], level[self.sensors + 1], formatted

    def _sensor_in_force(self, events: Int[Array, "N"], inside: Bool[Array, "N"]) -> Bool[Array, "S N"]:
        """True where sensor s is the one last named in the body up to each event."""
        sensor = jnp.asarray(self.sensor_of)[events]
        rank = jnp.arange(events.size) * self.sensors + sensor  # sorts by position, remembers the sensor
        last = jax.lax.cummax(jnp.where(inside & (sensor >= 0), rank, -1))
        return (last >= 0) & (last % self.sensors == jnp.arange(self.sensors)[:, None])


def compile_parser(language: Language, tokenizer: Tokenizer) -> Parser:
    """The parser of a language for a tokenizer; all tables are made here, on the host.

    Raises:
      ValueError: an attribute with more than 31 levels, no sensor, or tags that are not three different words.
    """
    for attribute in language.attributes:
        if len(attribute.levels) > _MAX_LEVELS:
            raise ValueError(
                f"attribute {attribute.name} has {len(attribute.levels)} levels: the parser reads at most "
                f"{_MAX_LEVELS}; split the attribute"
            )
    if not language.sensors:
        raise ValueError("sensors is empty: `perceive` reports on at least one sensor; name one")
    sensor_of, levels_of = _meaning(language)
    return Parser(
        lexer=compile_lexer(language, tokenizer),
        end_ids=tokenizer.end_ids,
        sensors=len(language.sensors),
        sensor_of=sensor_of,
        levels_of=levels_of,
        ordinal=tuple(attribute.ordinal for attribute in language.attributes),
    )


def _meaning(language: Language) -> tuple[np.ndarray, np.ndarray]:
    """Sensor that each event names or −1, int32 [events], and its levels as bits, int32 [events, A]."""
    phrases = phrases_of(language)
    sensor_of = np.full(FIRST_PHRASE + len(phrases), -1, np.int32)
    levels_of = np.zeros((len(sensor_of), len(language.attributes)), np.int32)
    for event, phrase in enumerate(phrases, FIRST_PHRASE):
        for s, sensor in enumerate(language.sensors):
            if phrase in sensor.phrases:
                sensor_of[event] = s
        for a, attribute in enumerate(language.attributes):
            for k, words in enumerate(attribute.levels):
                levels_of[event, a] |= (phrase in words) << k
    return sensor_of, levels_of


def _only_bit(bits: Int[Array, "*shape"]) -> Int[Array, "*shape"]:
    """Number of the one bit that is set, −1 where none or several are."""
    return jnp.where(jax.lax.population_count(bits) == 1, 31 - jax.lax.clz(bits), -1)
