"""Conversations in the text format that Qwen2.5-VL was trained on.

    <|im_start|>system
    You are a helpful assistant.<|im_end|>
    <|im_start|>user
    <|vision_start|><|image_pad|><|vision_end|>How hard is it?<|im_end|>
    <|im_start|>assistant

A picture or video is one pad between two marks here; `expand` repeats the pad once per token.  The published template
is a Jinja program; its result is written directly, so that no template engine is needed, and `check_template` rejects a
checkpoint with another template.
"""

import dataclasses
import enum
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

Role = Literal["system", "user", "assistant"]

TURN, TURN_END = "<|im_start|>", "<|im_end|>"
VISION, VISION_END = "<|vision_start|>", "<|vision_end|>"
MARKS = (TURN, TURN_END, VISION, VISION_END, "<|image_pad|>", "<|video_pad|>", "<|endoftext|>")
"""Special tokens, which no text may contain."""

SYSTEM = "You are a helpful assistant."
"""System message of a conversation that does not begin with one."""

TEMPLATE_SHA256 = "a0bc6f6fc7a29a80017a433e8f03a1cc1236e838a944a2d034295a60c4f2fddb"
"""Digest of the published template without surrounding white space, the same for all released sizes."""


class Media(enum.Enum):
    """Picture or video in a message."""

    PICTURE = "image"
    VIDEO = "video"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChatMessage:
    """A turn of a conversation: texts, pictures and videos in order.

    Raises:
      ValueError: a text that contains a special token.
    """

    role: Role
    parts: tuple[str | Media, ...]

    def __post_init__(self) -> None:
        for part in self.parts:
            spelled = [mark for mark in MARKS if isinstance(part, str) and mark in part]
            if spelled:
                raise ValueError(
                    f"a message of the {self.role} spells {spelled[0]!r}: special tokens are not for texts"
                )


def render(messages: Sequence[ChatMessage], *, reply: bool = True, numbered: bool = False) -> str:
    """The text of a conversation, by the published template of Qwen2.5-VL.

    Args:
      messages: the turns; a system message may only be the first one, and is `SYSTEM` by default.
      reply: open the assistant's turn.
      numbered: name pictures and videos "Picture 1: ", "Video 1: " and so on.

    Raises:
      ValueError: no message.
    """
    if not messages:
        raise ValueError("messages is empty: a conversation has at least one turn; add it")
    count = dict.fromkeys(Media, 0)
    text = "" if messages[0].role == "system" else turn("system", SYSTEM)
    for message in messages:
        body = ""
        for part in message.parts:
            if isinstance(part, Media):
                count[part] += 1
                body += _number(part, count[part]) if numbered else ""
                body += f"{VISION}<|{part.value}_pad|>{VISION_END}"
            else:
                body += part
        text += turn(message.role, body)
    return text + (opening("assistant") if reply else "")


def turn(role: Role, body: str) -> str:
    """A complete turn."""
    return f"{opening(role)}{body}{TURN_END}\n"


def opening(role: Role) -> str:
    """The beginning of a turn."""
    return f"{TURN}{role}\n"


def expand(ids: Sequence[int], sizes: Mapping[int, Sequence[int]]) -> list[int]:
    """Repeat the n-th occurrence of a pad as often as the n-th picture or video has tokens.

    Args:
      ids: tokens of a rendered conversation.
      sizes: for each pad's id the numbers of tokens, in order.

    Raises:
      ValueError: more or fewer sizes than pads.
    """
    left = {pad: list(numbers) for pad, numbers in sizes.items()}
    expanded: list[int] = []
    for i in ids:
        if i in left and not left[i]:
            raise ValueError(f"sizes of pad {i} are {list(sizes[i])}: the text has more of them; give each its size")
        expanded += [i] * left[i].pop(0) if i in left else [i]
    if any(left.values()):
        raise ValueError(f"sizes {left} are left over: the text has fewer pads; show every picture and video in it")
    return expanded


def check_template(directory: Path) -> Path:
    """File with the chat template of a checkpoint, which must be the published one.

    Raises:
      FileNotFoundError: the checkpoint has none.
      ValueError: it is another one, so that `render` would write other texts.
    """
    for name in ("chat_template.jinja", "chat_template.json", "tokenizer_config.json"):
        path = directory / name
        if not path.is_file():
            continue
        text = path.read_text(encoding="utf-8")
        template = text if path.suffix == ".jinja" else json.loads(text).get("chat_template")
        if template is None:
            continue
        digest = hashlib.sha256(template.strip().encode()).hexdigest()
        if digest != TEMPLATE_SHA256:
            raise ValueError(
                f"{path} holds another chat template (SHA-256 {digest[:12]}…, published {TEMPLATE_SHA256[:12]}…): "
                "render would not write what the model was trained on; use a released Qwen2.5-VL Instruct checkpoint"
            )
        return path
    raise FileNotFoundError(f"{directory} has no chat template: fetch chat_template.json or tokenizer_config.json")


def _number(media: Media, n: int) -> str:
    return f"{'Picture' if media is Media.PICTURE else 'Video'} {n}: "
