"""The command that reads a checkpoint, and what it refuses."""

import json
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.models.checkpoint import PICTURES, write_checkpoint
from tests.touchr1_jax.models.qwen import cases
from touchr1_jax.models.load import Load, load_checkpoint
from touchr1_jax.models.qwen.pictures import PixelBudget
from touchr1_jax.models.qwen.safetensors import read_header

pytestmark = pytest.mark.long


@pytest.fixture
def directory(tmp_path):
    write_checkpoint(tmp_path)
    return tmp_path


def test_everything_of_a_directory_is_read(directory):
    found = load_checkpoint(directory, jnp.float32)
    assert found.config.decoder.vocab_size == found.tokenizer.vocab_size == 512
    assert found.tokenizer.decode(found.tokenizer.encode("not so hard é 触")) == "not so hard é 触"
    assert found.tokenizer.banned[-1]  # a row without a word
    assert found.budget == PixelBudget(least=64, most=4096)
    table = cases.tensor("text.embed_tokens.weight", (512, 64))
    np.testing.assert_array_equal(found.params["decoder"]["embedding"]["embedding"], table)


def test_command_says_what_it_found(directory, capsys):
    assert Load(directory=directory).run() == 0
    said = capsys.readouterr().out
    count = sum(x.size for x in jax.tree.leaves(load_checkpoint(directory).params))
    assert f"{count:,} parameters" in said
    assert "2 layers of 64, 4 heads over 2, 512 tokens, head tied" in said
    assert "windows of 16 px, none in (1, 3)" in said


def test_command_names_the_misfit_and_fails(directory, capsys):
    config = json.loads((directory / "config.json").read_text()) | {"num_hidden_layers": 1}
    (directory / "config.json").write_text(json.dumps(config))
    assert Load(directory=directory).run() == 1
    assert "extra: model.layers.1.mlp.down_proj.weight" in capsys.readouterr().err


def test_ctrl_c_is_no_traceback(directory, monkeypatch):
    monkeypatch.setattr("touchr1_jax.models.load.load_checkpoint", Mock(side_effect=KeyboardInterrupt))
    assert Load(directory=directory).run() == 130


def test_weights_that_are_no_numbers_are_named(directory, capsys):
    entry = read_header(directory / "model.safetensors")["visual.patch_embed.proj.weight"]
    content = bytearray((directory / "model.safetensors").read_bytes())
    content[entry.start : entry.start + 4] = np.float32("nan").tobytes()
    (directory / "model.safetensors").write_bytes(content)
    assert Load(directory=directory).run() == 1
    assert "visual.patch_embed.proj.weight holds NaN or infinity as bfloat16: must be finite" in capsys.readouterr().err


@pytest.mark.parametrize("file", ["tokenizer.json", "preprocessor_config.json"])
@pytest.mark.parametrize("content", ["{", "[1]"])
def test_a_file_that_was_damaged_is_named(directory, capsys, file, content):
    (directory / file).write_text(content)
    assert Load(directory=directory).run() == 1
    assert f"{file} is no " in capsys.readouterr().err


@pytest.mark.parametrize(
    "file", ["config.json", "tokenizer.json", "chat_template.jinja", "model.safetensors", "preprocessor_config.json"]
)
def test_every_file_is_needed(directory, file):
    (directory / file).unlink()
    with pytest.raises(FileNotFoundError):
        load_checkpoint(directory)


def test_ids_must_be_those_of_the_tokenizer(directory):
    config = json.loads((directory / "config.json").read_text()) | {"video_token_id": 3}
    (directory / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"video_token_id is 3 in config\.json and \[\d+\] in tokenizer\.json"):
        load_checkpoint(directory)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"patch_size": 14}, "patch_size is 14: must be 4"),
        ({"image_mean": [0.5, 0.5, 0.5]}, "image_mean is .*: must be"),
        ({"max_pixels": None}, "names neither min_pixels and max_pixels nor"),
        ({"min_pixels": "a"}, r"min_pixels, max_pixels are 'a', \d+: must be whole"),
        ({"min_pixels": 2**40}, "must be whole, 1 ≤ min ≤ max"),
        ({"max_pixels": None, "size": 3}, "names neither min_pixels and max_pixels nor"),
    ],
)
def test_picture_settings_must_be_those_computed(directory, change, message):
    settings = PICTURES | change
    (directory / "preprocessor_config.json").write_text(json.dumps(settings))
    with pytest.raises(ValueError, match=message):
        load_checkpoint(directory)


def test_newer_picture_settings_are_read(directory):
    settings = {"size": {"shortest_edge": 100, "longest_edge": 200}, "min_pixels": None, "patch_size": None}
    (directory / "preprocessor_config.json").write_text(json.dumps(settings))
    assert load_checkpoint(directory).budget == PixelBudget(least=100, most=200)


def test_the_settings_of_newer_folders_are_read(directory):
    (directory / "preprocessor_config.json").unlink()
    settings = PICTURES | {"min_pixels": 128}
    (directory / "processor_config.json").write_text(json.dumps({"image_processor": settings, "video_processor": {}}))
    assert load_checkpoint(directory).budget == PixelBudget(least=128, most=4096)
    (directory / "processor_config.json").write_text(json.dumps({"video_processor": {}}))
    with pytest.raises(ValueError, match="is no JSON object with settings of pictures"):
        load_checkpoint(directory)
