"""The prompt's layout and the answer that supervised fine-tuning imitates.

A prompt is the view tokens, then for each sensor its name and its tactile tokens, then the question:

    <view>×n  gelsight_mini <tactile>×n  xense <tactile>×n  …  <pad>×m how hard is it

Questions are padded on their left with tokens that nothing attends to.  So all prompts have the same length, embeddings
sit at the same places in all of them, and the last position is always the last word of the question, from which the
completion starts; nothing is padded on the right.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from touchr1_jax.text.language import Attribute, Language
from touchr1_jax.text.tokenizer import Tokenizer
from touchr1_jax.text.turns import TurnLanguage

QUESTIONS: Mapping[str, str] = {
    "hardness": "how hard is it",
    "roughness": "how rough is it",
    "protrusion": "how protruding is it",
    "material": "which material is it",
}
"""Question for each attribute."""

AND = "and"
"""Joins the questions of a prompt that asks for several attributes."""

NO_SENSOR = "nothing"
"""Body of `perceive` when no sensor is present: a body must not be empty."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PromptLayout:
    """Q prompts of equal length L that differ only in their question.

    Attributes:
      asked: attributes that each prompt asks for.
      ids: token ids; `tactile_id` and `view_id` where embeddings go.
      mask: false at padding, which nothing may attend to.
      touch: positions of the n tactile tokens of each stream.
      view: positions of the view tokens.
      stream_text: stream whose name a token belongs to, −1 for all other tokens.
      step_text: where text says the time of each time step, a tactile token of the step whose text a token is, −1 for
        all other tokens.
    """

    asked: np.ndarray  # bool [Q, A]
    ids: np.ndarray  # int32 [Q, L]
    mask: np.ndarray  # bool [Q, L]
    touch: np.ndarray  # int32 [S, n]
    view: np.ndarray  # int32 [n_view]
    stream_text: np.ndarray  # int32 [L]
    step_text: np.ndarray | None = None  # int32 [L]


def prompt_words() -> tuple[str, ...]:
    """Words of prompts and answers that are no part of a language, for the vocabulary of a word-level tokenizer."""
    return (*QUESTIONS.values(), AND, NO_SENSOR)


def question_ids(
    tokenizer: Tokenizer, language: Language, asked: Sequence[str], questions: Mapping[str, str] = QUESTIONS
) -> list[int]:
    """Ids of the question for the named attributes, joined by "and".

    Raises:
      ValueError: nothing asked, an attribute that the language lacks, or one without a question.
    """
    if not asked:
        raise ValueError("asked is empty: a prompt asks for at least one attribute; name it")
    for name in asked:
        language.attribute_index(name)
        if name not in questions:
            raise ValueError(f"attribute {name!r} has no question; add it to the questions ({', '.join(questions)})")
    return tokenizer.encode(f" {AND} ".join(questions[name] for name in asked))


def build_layout(
    tokenizer: Tokenizer,
    language: Language,
    *,
    tactile_tokens: int,
    view_tokens: int,
    asked: Sequence[Sequence[str]] | None = None,
    questions: Mapping[str, str] = QUESTIONS,
) -> PromptLayout:
    """Lay out one prompt per entry of `asked`; by default one per attribute of the language, in its order.

    Args:
      tokenizer: vocabulary of the prompts.
      language: gives the sensors, stream s being sensor s, and the attributes.
      tactile_tokens: n, embeddings per stream.
      view_tokens: n_view, embeddings of the RGB view; 0 for none.
      asked: names of the attributes that each prompt asks for.
      questions: question of each attribute.
    """
    rows = [(a.name,) for a in language.attributes] if asked is None else asked
    asked_ids = [question_ids(tokenizer, language, row, questions) for row in rows]
    width = max(map(len, asked_ids))
    head, touch, stream_text = [tokenizer.view_id] * view_tokens, [], [-1] * view_tokens
    for s, sensor in enumerate(language.sensors):
        name = tokenizer.encode(sensor.phrases[0])
        head += [*name, *[tokenizer.tactile_id] * tactile_tokens]
        stream_text += [s] * len(name) + [-1] * tactile_tokens
        touch.append(range(len(head) - tactile_tokens, len(head)))
    padding = [width - len(ids) for ids in asked_ids]
    return PromptLayout(
        asked=np.array([[a.name in row for a in language.attributes] for row in rows]),
        ids=np.array(
            [[*head, *[tokenizer.pad_id] * m, *ids] for m, ids in zip(padding, asked_ids, strict=True)], np.int32
        ),
        mask=np.array([[*[True] * len(head), *[False] * m, *[True] * (width - m)] for m in padding]),
        touch=np.array(touch, np.int32),
        view=np.arange(view_tokens, dtype=np.int32),
        stream_text=np.array(stream_text + [-1] * width, np.int32),
    )


def answer_text(
    language: Language,
    *,
    asked: np.ndarray,
    streams: np.ndarray,
    perceive: np.ndarray,
    compare: np.ndarray,
    conclude: np.ndarray,
) -> str:
    """The answer with these slots, "<perceive> xense soft </perceive> <compare> soft </compare> <conclude> …".

    Args:
      asked: bool [A], attributes to answer for.
      streams: bool [S], sensors to report on; without any, `perceive` says "nothing".
      perceive: int [S, A], level that each sensor's own evidence shows.
      compare: int [A], cross-sensor level.
      conclude: int [A], level answered.

    Raises:
      ValueError: a level of an asked attribute outside 0..K−1.
    """

    def words(slot: str, levels: np.ndarray) -> str:
        named = [(attribute, int(levels[a])) for a, attribute in enumerate(language.attributes) if asked[a]]
        return " ".join(_level_word(slot, attribute, level) for attribute, level in named)

    reports = [
        f"{sensor.phrases[0]} {words(f'perceive[{sensor.name}]', perceive[s])}"
        for s, sensor in enumerate(language.sensors)
        if streams[s]
    ]
    bodies = [" ".join(reports) or NO_SENSOR, words("compare", compare), words("conclude", conclude)]
    return " ".join(f"<{tag}> {body} </{tag}>" for tag, body in zip(language.tags, bodies, strict=True))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LevelTokens:
    """Where every level of a language is one token: those tokens, and the one that opens `conclude`.

    `level` is int [A, K], −1 where an attribute has fewer levels.
    """

    opens: int
    level: np.ndarray

    def concluded(self, tokens: np.ndarray) -> np.ndarray:
        """True at the tokens of answers, int [*n, T], that are levels after the opening of `conclude`."""
        return np.logical_or.accumulate(tokens == self.opens, -1) & np.isin(tokens, self.level)


def level_tokens(language: Language | TurnLanguage, tokenizer: Tokenizer) -> LevelTokens | None:
    """The tokens of the levels; `None` where the tokenizer splits a level or the tag."""
    words = [[tokenizer.encode(level[0]) for level in attribute.levels] for attribute in language.attributes]
    opens = tokenizer.encode(f"<{language.tags[-1]}>")
    if any(len(ids) != 1 for ids in [opens, *(ids for row in words for ids in row)]):
        return None
    level = np.full((len(words), max(map(len, words))), -1, np.int32)
    for row, of_attribute in zip(level, words, strict=True):
        row[: len(of_attribute)] = [ids[0] for ids in of_attribute]
    return LevelTokens(opens=opens[0], level=level)


def encode_answer(tokenizer: Tokenizer, text: str, length: int) -> tuple[np.ndarray, np.ndarray]:
    """An answer for training: ids, end token and padding, int32 [T], and the mask of ids with the end, bool [T].

    Raises:
      ValueError: the answer and its end token are longer than T.
    """
    ids = [*tokenizer.encode(text), tokenizer.end_ids[0]]
    if len(ids) > length:
        raise ValueError(
            f"length is {length}: the answer {text!r} takes {len(ids)} tokens with its end; raise the completion length"
        )
    padding = length - len(ids)
    return np.array(ids + [tokenizer.pad_id] * padding, np.int32), np.arange(length) < len(ids)


def _level_word(slot: str, attribute: Attribute, level: int) -> str:
    if not 0 <= level < len(attribute.levels):
        raise ValueError(
            f"{slot}, {attribute.name}: level {level} must lie in 0..{len(attribute.levels) - 1}; "
            "answer only for attributes whose levels are known"
        )
    return attribute.levels[level][0]
