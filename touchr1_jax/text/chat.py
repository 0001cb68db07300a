"""The prompt of a policy on a pretrained Qwen-VL, in the chat template that the model was trained on.

    <|im_start|>system
    You are a helpful assistant.<|im_end|>
    <|im_start|>user
    <view>, for each sensor its name and its touch, the question<|im_end|>
    <|im_start|>assistant

View and touch stand between the two marks of vision: touch takes the place of a video, one pad per tactile token.  For
Qwen3-VL, which reads the time of a video's frames as text, each time step has marks of its own, after its time:

    <0.2 seconds><|vision_start|> … <|vision_end|><1.2 seconds><|vision_start|> … <|vision_end|>

as its processor wrote it when it was released (transformers 4.57; 5.23 leaves two more marks around them)

Questions are padded on their left, as in `template`, so that all prompts have one length and end where the completion
starts.  The published template is a Jinja program; its result is written directly, and `check_template` rejects a
checkpoint with another template.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from touchr1_jax.text.language import Language
from touchr1_jax.text.template import QUESTIONS, PromptLayout, question_ids
from touchr1_jax.text.tokenizer import Tokenizer

TURN, TURN_END = "<|im_start|>", "<|im_end|>"
VISION, VISION_END = "<|vision_start|>", "<|vision_end|>"
MARKS = (TURN, TURN_END, VISION, VISION_END, "<|image_pad|>", "<|video_pad|>", "<|endoftext|>")
"""Special tokens of the template."""

SYSTEM = "You are a helpful assistant."
"""System message of Qwen2.5-VL's template where a conversation gives none; Qwen3-VL's has none then."""

TEMPLATE_SHA256: Mapping[str, str] = {
    "qwen2_5_vl": "a0bc6f6fc7a29a80017a433e8f03a1cc1236e838a944a2d034295a60c4f2fddb",
    "qwen3_vl": "9d879ef91075acbfb2df7e441fd79d60bacfca989cf6d511d2af45c681e94f10",
}
"""Type of the model → digest of the published template of its Instruct checkpoints, without surrounding white space."""

FRAMES_PER_SECOND = 2.0
"""Rate at which Qwen3-VL's processor samples videos, and at which the frames of a touch are shown to it."""


def check_template(directory: Path, model_type: str) -> Path:
    """Find the chat template of a checkpoint, which must be the published one; return its file.

    Raises:
      FileNotFoundError: the checkpoint has none.
      ValueError: it is another one, so that prompts would not be what the model was trained on.
    """
    for name in ("chat_template.jinja", "chat_template.json", "tokenizer_config.json"):
        path = directory / name
        if not path.is_file():
            continue
        try:
            text = path.read_text(encoding="utf-8")
            template = text if path.suffix == ".jinja" else json.loads(text).get("chat_template")
        except (ValueError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path} is no JSON object: {error}; fetch it again") from error
        if not isinstance(template, str):
            continue
        published = TEMPLATE_SHA256[model_type]
        digest = hashlib.sha256(template.strip().encode()).hexdigest()
        if digest != published:
            raise ValueError(
                f"{path} holds another chat template (SHA-256 {digest[:12]}…, published {published[:12]}…): "
                "prompts would not be what the model was trained on; use a released Qwen-VL Instruct checkpoint"
            )
        return path
    raise FileNotFoundError(f"{directory} has no chat template: fetch chat_template.json or tokenizer_config.json")


def timestamps(frames: Sequence[int], rate: float, frames_per_step: int) -> tuple[str, ...]:
    """Text of Qwen3-VL's processor before each step of a video, the mean time of its first and last frame.

    Args:
      frames: their numbers in the video; a last step that lacks frames repeats the last.
      rate: frames per second.
      frames_per_step: of the vision tower.
    """
    times = [i / rate for i in (*frames, *[frames[-1]] * (-len(frames) % frames_per_step))]
    steps = zip(times[::frames_per_step], times[frames_per_step - 1 :: frames_per_step], strict=True)
    return tuple(f"<{(first + last) / 2:.1f} seconds>" for first, last in steps)


def build_chat_layout(
    tokenizer: Tokenizer,
    language: Language,
    *,
    tactile_tokens: int,
    view_tokens: int,
    system: str = SYSTEM,
    times: Sequence[str] = (),
) -> PromptLayout:
    """Lay out one prompt per attribute of the language, in its order.

    A stream's name and marks belong to the stream (`stream_text` s), the marks of the view to the view (S, the number
    of streams): they are masked with it.

    Args:
      tokenizer: must know the special tokens of the chat template.
      language: gives the sensors, stream s being sensor s, and the attributes.
      tactile_tokens: n, embeddings per stream.
      view_tokens: n_view, embeddings of the RGB view; 0 for none.
      system: the system message.
      times: text before each time step of a stream, which share its tokens equally; none for Qwen2.5-VL.

    Raises:
      ValueError: a tokenizer that splits a mark, time steps that cannot share the tokens, or as `question_ids`.
    """
    if times and tactile_tokens % len(times):
        raise ValueError(f"tactile_tokens is {tactile_tokens}: must be a multiple of the {len(times)} times; change it")
    questions = [question_ids(tokenizer, language, (a.name,), QUESTIONS) for a in language.attributes]
    head, owner, step, touch, view = _head(tokenizer, language, tactile_tokens, view_tokens, system, times)
    tail = tokenizer.encode(f"{TURN_END}\n{_opening('assistant')}")
    width = max(map(len, questions))
    padding = [width - len(ids) for ids in questions]
    ids = [[*head, *[tokenizer.pad_id] * m, *q, *tail] for m, q in zip(padding, questions, strict=True)]
    return PromptLayout(
        asked=np.eye(len(questions), dtype=bool),
        ids=np.array(ids, np.int32),
        mask=np.array([[*[True] * len(head), *[False] * m, *[True] * (width - m + len(tail))] for m in padding]),
        touch=np.array(touch, np.int32),
        view=np.array(view, np.int32),
        stream_text=np.array(owner + [-1] * (width + len(tail)), np.int32),
        step_text=np.array(step + [-1] * (width + len(tail)), np.int32) if times else None,
    )


def _head(
    tokenizer: Tokenizer,
    language: Language,
    tactile_tokens: int,
    view_tokens: int,
    system: str,
    times: Sequence[str],
) -> tuple[list[int], list[int], list[int], list[list[int]], list[int]]:
    """Ids before the question, the stream and the step whose text each is, and the places of touch and view."""
    begin, end = (_mark(tokenizer, mark) for mark in (VISION, VISION_END))
    ids = tokenizer.encode(f"{_opening('system')}{system}{TURN_END}\n{_opening('user')}")
    owner, step = [-1] * len(ids), [-1] * len(ids)

    def write(text: list[int], whose: int, at: int = -1) -> None:
        ids.extend(text)
        owner.extend([whose] * len(text))
        step.extend([at] * len(text))

    def show(before: str, pad: int, count: int, whose: int) -> list[int]:
        text = [*tokenizer.encode(before), begin]
        first = len(ids) + len(text)
        at = first if before else -1
        write(text, whose, at)
        write([pad] * count, -1)
        write([end], whose, at)
        return list(range(first, first + count))

    view = show("", tokenizer.view_id, view_tokens, len(language.sensors)) if view_tokens else []
    touch = []
    for s, sensor in enumerate(language.sensors):
        write(tokenizer.encode(sensor.phrases[0]), s)
        shown = [show(time, tokenizer.tactile_id, tactile_tokens // len(times or ("",)), s) for time in times or ("",)]
        touch.append([place for places in shown for place in places])
    return ids, owner, step, touch, view


def _opening(role: Literal["system", "user", "assistant"]) -> str:
    return f"{TURN}{role}\n"


def _mark(tokenizer: Tokenizer, mark: str) -> int:
    ids = tokenizer.encode(mark)
    if len(ids) != 1:
        raise ValueError(
            f"tokenizer splits {mark} into {len(ids)} tokens: must have it as a special token; use the tokenizer.json "
            "of a Qwen2.5-VL checkpoint"
        )
    return ids[0]
