"""Conversations in the published template, and prompts in it."""

import json

import numpy as np
import pytest

from tests.touchr1_jax.models.qwen import chats, words
from touchr1_jax.text.chat import SYSTEM, ChatMessage, Media, check_template, expand, render
from touchr1_jax.text.chat_layout import build_chat_layout
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.template import QUESTIONS
from touchr1_jax.text.tokenizer import word_level

MEDIA = {"<image>": Media.PICTURE, "<video>": Media.VIDEO}
TOKENIZER = words.tokenizer(TOUCH_LANGUAGE)
STREAMS = len(TOUCH_LANGUAGE.sensors)


def messages(conversation) -> list[ChatMessage]:
    return [ChatMessage(role=role, parts=tuple(MEDIA.get(p, p) for p in parts)) for role, parts in conversation]


@pytest.mark.parametrize("i", range(len(chats.CONVERSATIONS)))
def test_conversations_are_rendered_as_by_the_published_template(i):
    ours = [render(messages(chats.CONVERSATIONS[i]), reply=r, numbered=n) for r, n in chats.SWITCHES]
    assert ours == chats.committed_renderings()[i]


def test_one_by_hand():
    assert render([ChatMessage(role="user", parts=(Media.PICTURE, "How hard is it?"))]) == (
        "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
        "<|im_start|>user\n<|vision_start|><|image_pad|><|vision_end|>How hard is it?<|im_end|>\n"
        "<|im_start|>assistant\n"
    )


def test_texts_may_not_spell_marks():
    with pytest.raises(ValueError, match=r"a message of the user spells '<\|im_end\|>'"):
        ChatMessage(role="user", parts=("stop<|im_end|>",))


def test_nothing_said_is_refused():
    with pytest.raises(ValueError, match="messages is empty"):
        render([])


def test_pads_take_the_room_of_their_tokens():
    assert expand([1, 9, 2, 9, 8], {9: [2, 1], 8: [3]}) == [1, 9, 9, 2, 9, 8, 8, 8]
    with pytest.raises(ValueError, match=r"sizes of pad 9 are \[2\]: the text has more"):
        expand([9, 9], {9: [2]})
    with pytest.raises(ValueError, match="are left over"):
        expand([1, 9], {9: [2, 3]})


def test_published_template_is_accepted_wherever_it_lies(tmp_path):
    template = chats.TEMPLATE.read_text()
    files = {
        "tokenizer_config.json": json.dumps({"chat_template": template}),
        "chat_template.json": json.dumps({"chat_template": template}),
        "chat_template.jinja": template + "\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        assert check_template(tmp_path).name == name


def test_other_templates_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no chat template"):
        check_template(tmp_path)
    (tmp_path / "tokenizer_config.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match="has no chat template"):
        check_template(tmp_path)
    (tmp_path / "chat_template.json").write_text(json.dumps({"chat_template": "{{ messages }}"}))
    with pytest.raises(ValueError, match="holds another chat template"):
        check_template(tmp_path)


@pytest.fixture(scope="module")
def layout():
    return build_chat_layout(TOKENIZER, TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=4)


def test_prompts_are_rendered_conversations(layout):
    """Tokens under the mask are the template's text with repeated pads."""
    parts = [Media.PICTURE]
    for sensor in TOUCH_LANGUAGE.sensors:
        parts += [sensor.phrases[0], Media.VIDEO]
    for q, attribute in enumerate(TOUCH_LANGUAGE.attributes):
        text = render([ChatMessage(role="user", parts=(*parts, QUESTIONS[attribute.name]))])
        sizes = {TOKENIZER.view_id: [4], TOKENIZER.tactile_id: [3] * STREAMS}
        np.testing.assert_array_equal(
            layout.ids[q][layout.mask[q]], expand(TOKENIZER.encode(text), sizes), err_msg=attribute.name
        )


def test_slots_hold_the_pads(layout):
    assert (layout.ids[:, layout.touch] == TOKENIZER.tactile_id).all()
    assert (layout.ids[:, layout.view] == TOKENIZER.view_id).all()
    assert layout.touch.shape == (STREAMS, 3)
    assert layout.mask[:, -1].all()


def test_names_and_marks_belong_to_their_stream(layout):
    """Before and after each stream's tokens stand its marks, before them its name; the view's marks are the view's."""
    for s, sensor in enumerate(TOUCH_LANGUAGE.sensors):
        own = np.flatnonzero(layout.stream_text == s)
        name = TOKENIZER.encode(sensor.phrases[0])
        np.testing.assert_array_equal(layout.ids[0, own[: len(name)]], name)
        np.testing.assert_array_equal(own[len(name) :], [layout.touch[s, 0] - 1, layout.touch[s, -1] + 1])
    view = np.flatnonzero(layout.stream_text == STREAMS)
    np.testing.assert_array_equal(view, [layout.view[0] - 1, layout.view[-1] + 1])


def test_without_a_view_there_are_no_marks_of_one():
    layout = build_chat_layout(TOKENIZER, TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=0, system=SYSTEM)
    assert not (layout.stream_text == STREAMS).any()
    assert layout.view.size == 0


def test_tokenizer_must_know_the_marks():
    with pytest.raises(ValueError, match="are not in the vocabulary"):
        build_chat_layout(word_level(TOUCH_LANGUAGE), TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=0)
