"""The prompt of a policy on a pretrained Qwen2.5-VL, in its chat template.

    system turn, user turn: <view>, for each sensor its name and its touch, the question; the assistant's turn opened

Touch takes the place of a video, one pad per tactile token between the two marks of vision.  Questions are padded
on their left, as in `template`, so that all prompts have one length and end where the completion starts.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from touchr1_jax.text.chat import SYSTEM, TURN_END, VISION, VISION_END, opening, turn
from touchr1_jax.text.language import Language
from touchr1_jax.text.template import QUESTIONS, PromptLayout, question_ids
from touchr1_jax.text.tokenizer import Tokenizer


def build_chat_layout(
    tokenizer: Tokenizer,
    language: Language,
    *,
    tactile_tokens: int,
    view_tokens: int,
    asked: Sequence[Sequence[str]] | None = None,
    questions: Mapping[str, str] = QUESTIONS,
    system: str = SYSTEM,
) -> PromptLayout:
    """Lay out one prompt per entry of `asked`; by default one per attribute of the language, in its order.

    A stream's name and marks belong to the stream (`stream_text` s), the marks of the view to the view (S, the number
    of streams): they are masked with it.

    Args:
      tokenizer: must know the special tokens of the chat template.
      language: gives the sensors, stream s being sensor s, and the attributes.
      tactile_tokens: n, embeddings per stream.
      view_tokens: n_view, embeddings of the RGB view; 0 for none.
      asked: names of the attributes that each prompt asks for.
      questions: question of each attribute.
      system: the system message.

    Raises:
      ValueError: a tokenizer that splits a mark, or as `question_ids`.
    """
    rows = [(a.name,) for a in language.attributes] if asked is None else asked
    asked_ids = [question_ids(tokenizer, language, row, questions) for row in rows]
    head, owner, touch, view = _head(tokenizer, language, tactile_tokens, view_tokens, system)
    tail = tokenizer.encode(f"{TURN_END}\n{opening('assistant')}")
    width = max(map(len, asked_ids))
    padding = [width - len(ids) for ids in asked_ids]
    ids = [[*head, *[tokenizer.pad_id] * m, *q, *tail] for m, q in zip(padding, asked_ids, strict=True)]
    return PromptLayout(
        asked=np.array([[a.name in row for a in language.attributes] for row in rows]),
        ids=np.array(ids, np.int32),
        mask=np.array([[*[True] * len(head), *[False] * m, *[True] * (width - m + len(tail))] for m in padding]),
        touch=np.array(touch, np.int32),
        view=np.array(view, np.int32),
        stream_text=np.array(owner + [-1] * (width + len(tail)), np.int32),
    )


def _head(
    tokenizer: Tokenizer, language: Language, tactile_tokens: int, view_tokens: int, system: str
) -> tuple[list[int], list[int], list[list[int]], list[int]]:
    """Ids before the question, the stream whose text each is, and the places of touch and view."""
    begin, end = (_mark(tokenizer, mark) for mark in (VISION, VISION_END))
    ids = tokenizer.encode(turn("system", system) + opening("user"))
    owner = [-1] * len(ids)

    def show(pad: int, count: int, whose: int) -> list[int]:
        places = list(range(len(ids) + 1, len(ids) + 1 + count))
        ids.extend([begin, *[pad] * count, end])
        owner.extend([whose, *[-1] * count, whose])
        return places

    view = show(tokenizer.view_id, view_tokens, len(language.sensors)) if view_tokens else []
    touch = []
    for s, sensor in enumerate(language.sensors):
        name = tokenizer.encode(sensor.phrases[0])
        ids.extend(name)
        owner.extend([s] * len(name))
        touch.append(show(tokenizer.tactile_id, tactile_tokens, s))
    return ids, owner, touch, view


def _mark(tokenizer: Tokenizer, mark: str) -> int:
    ids = tokenizer.encode(mark)
    if len(ids) != 1:
        raise ValueError(
            f"tokenizer splits {mark} into {len(ids)} tokens: must have it as a special token; use the tokenizer.json "
            "of a Qwen2.5-VL checkpoint"
        )
    return ids[0]
