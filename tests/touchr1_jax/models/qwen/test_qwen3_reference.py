"""Qwen3-VL against transformers' own files, gradients, greedy answers and processor."""

import importlib.util
import subprocess
import sys

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.models.qwen import cases, tiny, words
from tests.touchr1_jax.models.qwen.cases import CASES
from touchr1_jax.models.qwen import names
from touchr1_jax.models.qwen.config_file import read_config
from touchr1_jax.models.qwen.model import QwenVL
from touchr1_jax.models.qwen.pictures import patchify
from touchr1_jax.models.qwen.safetensors import read_header, read_tensor
from touchr1_jax.models.qwen.weights import load_params, row_of, save_params
from touchr1_jax.models.token_cache import empty_caches
from touchr1_jax.text.chat import VISION, VISION_END, build_chat_layout, timestamps
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.text.template import QUESTIONS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not importlib.util.find_spec("transformers") or not importlib.util.find_spec("torch"),
        reason="the parity extra is not installed",
    ),
]
QUESTION = QUESTIONS[TOUCH_LANGUAGE.attributes[0].name]


@pytest.fixture(scope="module", params=[f"qwen3_mixed_{i}" for i in range(len(cases.SHAPES))])
def reference(request, tmp_path_factory):
    """Name of the case, folder, and what transformers computed."""
    folder = tmp_path_factory.mktemp("reference")
    program = "tests.touchr1_jax.models.qwen.qwen3_reference"
    command = [sys.executable, "-W", "ignore", "-m", program, str(folder), request.param, QUESTION]
    subprocess.run(command, check=True, timeout=600)
    with np.load(folder / "reference.npz") as arrays:
        return request.param, folder, dict(arrays)


def test_a_checkpoint_of_transformers_is_read_and_written_back(reference, tmp_path):
    name, folder, _ = reference
    config = read_config(folder / "checkpoint")
    assert config == tiny.config_of(CASES[name])
    save_params(tmp_path, load_params(folder / "checkpoint", config, jnp.float32), config)
    theirs, ours = (read_header(path / "model.safetensors") for path in (folder / "checkpoint", tmp_path))
    assert theirs.keys() == ours.keys()
    for key, entry in theirs.items():
        np.testing.assert_array_equal(read_tensor(entry), read_tensor(ours[key]), err_msg=key)


def test_gradients_are_those_of_transformers(reference):
    name, folder, found = reference
    config, inputs, grids = tiny.config_of(CASES[name]), tiny.inputs_of(name), tiny.grids_of(CASES[name])
    params = load_params(folder / "checkpoint", config, jnp.float32)

    def loss(p):
        logits = QwenVL(config).apply({"params": p}, inputs, grids)
        chosen = jnp.take_along_axis(jax.nn.log_softmax(logits[:-1]), inputs.ids[1:, None], -1)
        return -jnp.mean(chosen)

    flat = flax.traverse_util.flatten_dict(jax.device_get(jax.jit(jax.grad(loss))(params)))
    ours = {names.nested(s.key): names.write(row_of(flat, s), s) for s in names.sources(config).values()}
    theirs = {key.removeprefix("grad "): x for key, x in found.items() if key.startswith("grad ")}
    assert theirs.keys() == ours.keys()
    largest = max(np.abs(x).max() for x in theirs.values())
    worst = max(np.abs(ours[key] - x).max() for key, x in theirs.items()) / largest
    assert worst < 2e-5
    assert all(np.abs(x).max() > 0 for key, x in theirs.items() if "deepstack" in key and "weight" in key)


def test_greedy_answers_are_those_of_transformers(reference):
    name, folder, found = reference
    config, inputs, grids = tiny.config_of(CASES[name]), tiny.inputs_of(name), tiny.grids_of(CASES[name])
    model, c, length = QwenVL(config), config.decoder, len(found["greedy"])
    params = load_params(folder / "checkpoint", config, jnp.float32)
    run = lambda method, *args: model.apply({"params": params}, *args, method=method)
    logits, prefix = jax.jit(lambda x: run(QwenVL.prefill, x, grids))(inputs)
    caches = empty_caches(c, length)
    tokens: list[jax.Array] = []
    step = jax.jit(lambda token, t, caches: run(QwenVL.decode, token, t, prefix, caches))
    for t in range(length):
        tokens.append(jnp.argmax(logits))
        logits, caches = step(tokens[-1], jnp.int32(t), caches)
    assert [int(x) for x in tokens] == found["greedy"].tolist()


@pytest.mark.parametrize("frames", [4, 5])
def test_prompts_and_patches_are_those_of_the_processor(reference, frames):
    """An even number of frames, and an odd one, whose last is repeated.

    The processor of the release, of transformers 4.57, writes the steps in place of the template's two marks around a
    video; 5.23 leaves these, which are the ones without a pad next to them.
    """
    name, _, found = reference
    vision = tiny.config_of(CASES[name]).vision
    for key, shown in (("picture", cases.video(1)), ("video", cases.video(frames))):
        np.testing.assert_allclose(patchify(shown, vision), found[f"{key}_{frames}"], atol=1e-6)
    tokens, times = cases.SIDE**2 // vision.cell_px**2, timestamps(range(frames), 2.0, vision.patch_frames)
    tokenizer = words.tokenizer(TOUCH_LANGUAGE)
    layout = build_chat_layout(
        tokenizer,
        TOUCH_LANGUAGE,
        tactile_tokens=len(times) * tokens,
        view_tokens=tokens,
        system="Be brief.",
        times=times,
    )
    theirs = found[f"ids_{frames}"].tolist()
    pads = {tokenizer.tactile_id, tokenizer.view_id}
    start, end = (tokenizer.encode(mark)[0] for mark in (VISION, VISION_END))
    around = zip(theirs, [-1, *theirs[:-1]], [*theirs[1:], -1], strict=True)
    stray = lambda x, last, after: (x == start and after not in pads) or (x == end and last not in pads)
    released = [x for x, last, after in around if not stray(x, last, after)]
    assert len(theirs) - len(released) in (0, 2 * len(TOUCH_LANGUAGE.sensors))
    assert layout.ids[0][layout.mask[0]].tolist() == released
