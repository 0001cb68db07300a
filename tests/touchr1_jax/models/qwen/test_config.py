"""Configs as published and as newer libraries nest them, and what is refused."""

import dataclasses
import json

import pytest

from tests.touchr1_jax.models.qwen.cases import SHAPES, config_json, qwen3_json
from touchr1_jax.models.qwen.config import QwenConfig, QwenVisionConfig, released
from touchr1_jax.models.qwen.config_file import parse_config, read_config

SEVEN_B = {
    "model_type": "qwen2_5_vl",
    "image_token_id": 151655,
    "video_token_id": 151656,
    "vision_start_token_id": 151652,
    "vision_end_token_id": 151653,
    "hidden_act": "silu",
    "hidden_size": 3584,
    "intermediate_size": 18944,
    "num_attention_heads": 28,
    "num_hidden_layers": 28,
    "num_key_value_heads": 4,
    "rms_norm_eps": 1e-06,
    "rope_theta": 1000000.0,
    "rope_scaling": {"type": "mrope", "mrope_section": [16, 24, 24]},
    "sliding_window": 32768,
    "use_sliding_window": False,
    "tie_word_embeddings": False,
    "vocab_size": 152064,
    "vision_config": {
        "depth": 32,
        "hidden_act": "silu",
        "hidden_size": 1280,
        "intermediate_size": 3420,
        "num_heads": 16,
        "in_chans": 3,
        "out_hidden_size": 3584,
        "patch_size": 14,
        "spatial_merge_size": 2,
        "window_size": 112,
        "fullatt_block_indexes": [7, 15, 23, 31],
        "tokens_per_second": 2,
        "temporal_patch_size": 2,
    },
}
"""The fields of the released 7B's file that matter."""

TEXT = ("vocab_size", "hidden_size", "intermediate_size", "num_hidden_layers", "num_attention_heads")
TEXT += ("num_key_value_heads", "hidden_act", "rms_norm_eps", "use_sliding_window", "tie_word_embeddings")


def nested(flat: dict, **changes) -> dict:
    """The same config as transformers ≥ 5 writes it."""
    text = {name: flat[name] for name in TEXT}
    text["rope_parameters"] = {"rope_type": "default", "rope_theta": flat["rope_theta"], **flat["rope_scaling"]}
    vision = {k: v for k, v in flat["vision_config"].items() if k != "in_chans"} | {"in_channels": 3}
    rest = {k: v for k, v in flat.items() if k not in (*TEXT, "rope_theta", "rope_scaling", "vision_config")}
    return rest | {"text_config": text | changes, "vision_config": vision}


def test_released_config_is_read():
    assert parse_config(SEVEN_B) == released("7B")


@pytest.mark.parametrize("flat", [SEVEN_B, config_json(), config_json(tied=False)])
def test_nested_config_is_the_flat_one(flat):
    assert parse_config(nested(flat)) == parse_config(flat)


def test_directory_is_read(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(SEVEN_B))
    assert read_config(tmp_path) == released("7B")


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config\.json is no file"):
        read_config(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ValueError, match="is no JSON"):
        read_config(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model_type": "qwen2_vl"}, "model_type is 'qwen2_vl': must be 'qwen2_5_vl'"),
        ({"hidden_act": "gelu"}, "hidden_act is 'gelu': must be 'silu'"),
        ({"use_sliding_window": True}, "use_sliding_window is true"),
        ({"hidden_size": 3585}, "hidden_size 3585 must be a multiple of num_attention_heads 28"),
        ({"rope_scaling": {"type": "yarn", "mrope_section": [16, 24, 24]}}, r"rope_scaling.type is \['yarn'\]"),
        ({"rope_scaling": {"type": "mrope", "mrope_section": [32, 32]}}, r"mrope_section is \[32, 32\]: must be three"),
        ({"rope_scaling": {"type": "mrope"}}, "lacks rope_scaling.mrope_section"),
        ({"num_key_value_heads": 5}, "num_heads is 28: must be a multiple of num_kv_heads 5"),
        ({"num_hidden_layers": "28"}, "num_hidden_layers is '28': must be a whole number above 0; correct config.json"),
        ({"vision_config": SEVEN_B["vision_config"] | {"depth": 0}}, "vision_config.depth is 0: must be a whole"),
        ({"image_token_id": 151656}, "must be four different ids"),
        ({"video_token_id": 152064}, "must be four different ids below vocab_size 152064"),
        ({"vision_config": SEVEN_B["vision_config"] | {"out_hidden_size": 8}}, "out_size 8 must equal"),
        ({"vision_config": SEVEN_B["vision_config"] | {"in_chans": 1}}, "vision_config.in_chans is 1: must be 3"),
        ({"vision_config": SEVEN_B["vision_config"] | {"window_size": 100}}, "window_px 100 must be a multiple"),
        ({"vision_config": SEVEN_B["vision_config"] | {"num_heads": 7}}, "must be a multiple of 4"),
        ({"vision_config": SEVEN_B["vision_config"] | {"fullatt_block_indexes": [7, 32]}}, r"must lie in 0\.\.31"),
        ({"vision_config": SEVEN_B["vision_config"] | {"fullatt_block_indexes": None}}, "must be a list of whole"),
        ({"vision_config": SEVEN_B["vision_config"] | {"fullatt_block_indexes": [[7]]}}, "must be a list of whole"),
        ({"vision_config": SEVEN_B["vision_config"] | {"tokens_per_second": "2"}}, "'2': must be a number above 0"),
        ({"vision_config": []}, r"vision_config is \[\]: must be an object"),
        ({"text_config": None}, "text_config is None: must be an object"),
        ({"rope_scaling": None}, "rope_scaling is None: must be an object"),
        ({"rope_scaling": {"type": [], "mrope_section": [16, 24, 24]}}, r"rope_scaling.type is \[\[\]\]"),
        ({"rope_scaling": {"type": "mrope", "mrope_section": 3}}, "mrope_section is 3: must be a list"),
        ({"rope_theta": "1e6"}, "rope_theta is '1e6': must be a number above 0"),
        ({"rms_norm_eps": "1e-6"}, "rms_norm_eps is '1e-6': must be a number above 0"),
        ({"rms_norm_eps": 10**400}, "rms_norm_eps is 1000"),
        ({"rms_norm_eps": float("nan")}, "rms_norm_eps is nan: must be a number above 0"),
        ({"hidden_size": [3584]}, r"hidden_size is \[3584\]: must be a whole number"),
    ],
)
def test_what_is_not_computed_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        parse_config(SEVEN_B | change)


@pytest.mark.parametrize("field", ["hidden_size", "num_heads", "patch_px", "patch_frames", "merge"])
def test_a_tower_without_heads_or_patches_is_refused(field):
    with pytest.raises(ValueError, match=f"{field} is 0: must be at least 1; raise it"):
        dataclasses.replace(released("7B").vision, **{field: 0})


@pytest.mark.parametrize("field", [*TEXT[:8], "rope_theta", "rope_scaling", "image_token_id", "vision_config"])
def test_missing_field_is_named(field):
    with pytest.raises(ValueError, match=rf"config\.json lacks {field}"):
        parse_config({k: v for k, v in SEVEN_B.items() if k != field})


def test_a_vision_tower_has_the_published_defaults_where_the_file_says_nothing():
    """As the released 32B and 72B are written, whose towers differ from the others in two sizes."""
    vision = {"hidden_size": 1280, "in_chans": 3, "intermediate_size": 3456, "out_hidden_size": 3584}
    found = parse_config(SEVEN_B | {"vision_config": vision | {"spatial_patch_size": 14, "tokens_per_second": 2}})
    assert found.vision == QwenVisionConfig(out_size=3584, intermediate_size=3456)


@pytest.mark.parametrize("found", [None, [], "qwen2_5_vl", 3])
def test_a_config_that_is_no_object_is_named(found):
    with pytest.raises(ValueError, match=r"config\.json is .*: must be an object"):
        parse_config(found)


def test_missing_nested_field_is_named_in_full():
    broken = nested(SEVEN_B)
    del broken["text_config"]["num_hidden_layers"]
    with pytest.raises(ValueError, match=r"lacks text_config\.num_hidden_layers"):
        parse_config(broken)


QWEN3_4B = qwen3_json(SHAPES[0]) | {
    "image_token_id": 151655,
    "video_token_id": 151656,
    "vision_start_token_id": 151652,
    "vision_end_token_id": 151653,
    "text_config": {
        "attention_bias": False,
        "attention_dropout": 0.0,
        "dtype": "bfloat16",
        "head_dim": 128,
        "hidden_act": "silu",
        "hidden_size": 2560,
        "intermediate_size": 9728,
        "model_type": "qwen3_vl_text",
        "num_attention_heads": 32,
        "num_hidden_layers": 36,
        "num_key_value_heads": 8,
        "rms_norm_eps": 1e-06,
        "rope_scaling": {"mrope_interleaved": True, "mrope_section": [24, 20, 20], "rope_type": "default"},
        "rope_theta": 5000000,
        "tie_word_embeddings": True,
        "vocab_size": 151936,
    },
    "vision_config": {
        "deepstack_visual_indexes": [5, 11, 17],
        "depth": 24,
        "hidden_act": "gelu_pytorch_tanh",
        "hidden_size": 1024,
        "in_channels": 3,
        "intermediate_size": 4096,
        "model_type": "qwen3_vl",
        "num_heads": 16,
        "num_position_embeddings": 2304,
        "out_hidden_size": 2560,
        "patch_size": 16,
        "spatial_merge_size": 2,
        "temporal_patch_size": 2,
    },
}
"""The fields of the released Qwen3-VL-4B's file that matter."""


def test_released_qwen3_config_is_read():
    assert parse_config(QWEN3_4B) == released("Qwen3-VL-4B")


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        (
            "",
            {"model_type": "qwen3_vl_moe"},
            "must be 'qwen2_5_vl' or 'qwen3_vl'; mixtures of experts are not computed",
        ),
        ("text_config", {"attention_bias": True}, "text_config.attention_bias is True: must be False"),
        ("text_config", {"head_dim": 10**400}, r"twice their sum must be head_dim, 10000"),
        ("text_config", {"head_dim": 96}, r"mrope_section is \[24, 20, 20\]: twice their sum must be head_dim, 96"),
        ("text_config", {"head_dim": None}, "text_config.head_dim is None: must be a whole number above 0"),
        (
            "text_config",
            {"num_hidden_layers": 3},
            "names 3 layers: must be fewer than the decoder's",
        ),
        ("text_config", {"rope_scaling": {"mrope_section": [24, 20]}}, "must be three"),
        ("text_config", {"rope_scaling": {"mrope_section": [24, 20, 20], "mrope_interleaved": False}}, "must be True"),
        ("vision_config", {"deepstack_visual_indexes": [5, 24]}, r"is \[5, 24\]: must rise and lie in 0\.\.23"),
        ("vision_config", {"deepstack_visual_indexes": [11, 5]}, r"is \[11, 5\]: must rise"),
        ("vision_config", {"deepstack_visual_indexes": 3}, "must be a list of whole numbers"),
        ("vision_config", {"num_position_embeddings": 2300}, "is 2300: must be a square"),
        ("vision_config", {"hidden_act": "silu"}, "hidden_act is 'silu': must be 'gelu_pytorch_tanh'"),
    ],
)
def test_what_is_not_computed_of_qwen3_is_refused(part, change, message):
    with pytest.raises(ValueError, match=message):
        parse_config(QWEN3_4B | ({part: QWEN3_4B[part] | change} if part else change))


@pytest.mark.parametrize("part", ["text_config", "vision_config"])
def test_a_missing_field_of_qwen3_is_named(part):
    optional = {"attention_bias", "attention_dropout", "dtype", "model_type", "tie_word_embeddings", "in_channels"}
    for field in QWEN3_4B[part].keys() - optional:
        with pytest.raises(ValueError, match=rf"config\.json lacks {part}\.{field}"):
            parse_config(QWEN3_4B | {part: {k: v for k, v in QWEN3_4B[part].items() if k != field}})


def test_unknown_size_is_refused():
    with pytest.raises(ValueError, match="size is '14B': must be one of 3B, 7B"):
        released("14B")


def test_configs_shrink_by_replacement():
    small = dataclasses.replace(released("7B").vision, depth=2, full_layers=(1,))
    assert isinstance(small, QwenVisionConfig)
    assert isinstance(dataclasses.replace(released("7B"), vision=small), QwenConfig)
