"""Conversations, and what the published chat template makes of them."""

import json
from pathlib import Path
from typing import Any

from experiments.paper import tiny_checkpoint as tiny

DATA = Path(__file__).resolve().parents[3] / "data" / "qwen"
TEMPLATE, GOLDEN = tiny.TEMPLATE, DATA / "chats.json"

CONVERSATIONS: list[list[tuple[str, list[str]]]] = [
    [("user", ["How hard is it?"])],
    [("system", ["You feel.\nBe brief."]), ("user", ["<image>", "How hard is it?"])],
    [
        ("user", ["<image>", "left, ", "<video>", " right\n", "<image>", "<video>", "same?"]),
        ("assistant", ["é 触 no."]),
    ],
    [("user", ["{{ text }}{% if %} "]), ("assistant", ["  ok \n"]), ("user", ["<video>"]), ("assistant", [""])],
]
"""Roles and parts; <image> and <video> stand for what is shown."""

SWITCHES = [(reply, numbered) for reply in (False, True) for numbered in (False, True)]


def reference_renderings() -> list[list[str]]:
    """Every conversation under every (reply, numbered), by transformers."""
    from transformers.utils.chat_template_utils import render_jinja_template

    template = TEMPLATE.read_text(encoding="utf-8")
    render = lambda c, reply, numbered: render_jinja_template(
        [as_dicts(c)], chat_template=template, add_generation_prompt=reply, add_vision_id=numbered
    )[0][0]
    return [[render(c, *switch) for switch in SWITCHES] for c in CONVERSATIONS]


def as_dicts(conversation: list[tuple[str, list[str]]]) -> list[dict[str, Any]]:
    kinds = {"<image>": {"type": "image"}, "<video>": {"type": "video"}}
    return [
        {"role": role, "content": [kinds.get(part, {"type": "text", "text": part}) for part in parts]}
        for role, parts in conversation
    ]


def committed_renderings() -> list[list[str]]:
    return json.loads(GOLDEN.read_text(encoding="utf-8"))
