"""Prompts in the published chat template, and checkpoints with another one."""

import json

import jinja2
import numpy as np
import pytest

from experiments.paper.tiny_checkpoint import TEMPLATE, TEMPLATE_QWEN3
from tests.touchr1_jax.models.qwen import words
from touchr1_jax.text.chat import build_chat_layout, check_template, timestamps
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.template import QUESTIONS
from touchr1_jax.text.tokenizer import word_level

TOKENIZER = words.tokenizer(TOUCH_LANGUAGE)
TEMPLATES = {"qwen2_5_vl": TEMPLATE, "qwen3_vl": TEMPLATE_QWEN3}
STREAMS = len(TOUCH_LANGUAGE.sensors)


@pytest.mark.parametrize(("model", "file"), TEMPLATES.items())
def test_published_template_is_accepted_wherever_it_lies(tmp_path, model, file):
    template = file.read_text()
    files = {
        "tokenizer_config.json": json.dumps({"chat_template": template}),
        "chat_template.json": json.dumps({"chat_template": template}),
        "chat_template.jinja": template + "\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        assert check_template(tmp_path, model).name == name


def test_other_templates_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no chat template"):
        check_template(tmp_path, "qwen2_5_vl")
    (tmp_path / "tokenizer_config.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match="has no chat template"):
        check_template(tmp_path, "qwen2_5_vl")
    (tmp_path / "chat_template.json").write_text(json.dumps({"chat_template": "{{ messages }}"}))
    with pytest.raises(ValueError, match="holds another chat template"):
        check_template(tmp_path, "qwen2_5_vl")
    (tmp_path / "chat_template.json").write_text(json.dumps({"chat_template": TEMPLATE.read_text()}))
    with pytest.raises(ValueError, match="holds another chat template"):
        check_template(tmp_path, "qwen3_vl")


@pytest.fixture(scope="module")
def layout():
    return build_chat_layout(TOKENIZER, TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=4)


@pytest.mark.parametrize("system", [None, "You feel.\nBe brief."])
@pytest.mark.parametrize("q", range(len(TOUCH_LANGUAGE.attributes)))
def test_prompts_are_what_the_published_template_writes(system, q):
    """Tokens under the mask are the template's text, its pads repeated once per token."""
    layout = build_chat_layout(
        TOKENIZER, TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=4, **({} if system is None else {"system": system})
    )
    content = [{"type": "image"}]
    for sensor in TOUCH_LANGUAGE.sensors:
        content += [{"type": "text", "text": sensor.phrases[0]}, {"type": "video"}]
    content.append({"type": "text", "text": QUESTIONS[TOUCH_LANGUAGE.attributes[q].name]})
    turns = [{"role": "system", "content": system}] * (system is not None) + [{"role": "user", "content": content}]
    template = jinja2.Template(TEMPLATE.read_text(), trim_blocks=True, lstrip_blocks=True)
    text = template.render(messages=turns, add_generation_prompt=True)
    text = text.replace("<|image_pad|>", 4 * "<|image_pad|>").replace("<|video_pad|>", 3 * "<|video_pad|>")
    assert layout.ids[q][layout.mask[q]].tolist() == list(TOKENIZER.encode(text))
    assert layout.asked[q].tolist() == [i == q for i in range(len(TOUCH_LANGUAGE.attributes))]


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
    layout = build_chat_layout(TOKENIZER, TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=0)
    assert not (layout.stream_text == STREAMS).any()
    assert layout.view.size == 0


def test_tokenizer_must_know_the_marks():
    with pytest.raises(ValueError, match="are not in the vocabulary"):
        build_chat_layout(word_level(TOUCH_LANGUAGE), TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=0)


def test_time_is_text_before_each_step():
    """As Qwen3-VL's processor writes it: the mean of a step's first and last frame; the last frame is repeated."""
    assert timestamps(range(5), 2.0, 2) == ("<0.2 seconds>", "<1.2 seconds>", "<2.0 seconds>")
    assert timestamps([0, 12, 30], 24.0, 1) == ("<0.0 seconds>", "<0.5 seconds>", "<1.2 seconds>")
    with pytest.raises(ValueError, match="tactile_tokens is 3: must be a multiple of the 2 times"):
        build_chat_layout(TOKENIZER, TOUCH_LANGUAGE, tactile_tokens=3, view_tokens=4, times=timestamps([0, 1], 2.0, 1))


def test_prompts_of_qwen3_are_what_its_template_writes():
    """Each video of the template becomes, as by the processor, its steps between marks, each after its time."""
    times = timestamps(range(3), 2.0, 2)
    layout = build_chat_layout(
        TOKENIZER, TOUCH_LANGUAGE, tactile_tokens=6, view_tokens=4, system="Be brief.", times=times
    )
    content = [{"type": "image"}]
    for sensor in TOUCH_LANGUAGE.sensors:
        content += [{"type": "text", "text": sensor.phrases[0]}, {"type": "video"}]
    content.append({"type": "text", "text": QUESTIONS[TOUCH_LANGUAGE.attributes[0].name]})
    template = jinja2.Template(TEMPLATE_QWEN3.read_text(), trim_blocks=True, lstrip_blocks=True)
    turns = [{"role": "system", "content": "Be brief."}, {"role": "user", "content": content}]
    text = template.render(messages=turns, add_generation_prompt=True)
    step = "<|vision_start|>" + 3 * "<|video_pad|>" + "<|vision_end|>"
    text = text.replace("<|vision_start|><|video_pad|><|vision_end|>", "".join(time + step for time in times))
    text = text.replace("<|image_pad|>", 4 * "<|image_pad|>")
    assert layout.ids[0][layout.mask[0]].tolist() == list(TOKENIZER.encode(text))
    assert (layout.ids[:, layout.touch] == TOKENIZER.tactile_id).all()
    assert set(layout.step_text) == {-1, *layout.touch[:, ::3].ravel()}
    own = np.flatnonzero(layout.step_text == layout.touch[1, 3])  # the second step of the second stream
    assert TOKENIZER.decode(layout.ids[0, own]) == "<1.0 seconds>"
    assert (layout.stream_text[own] == 1).all()
