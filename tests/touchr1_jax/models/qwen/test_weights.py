"""Checkpoints in every published layout, and every way in which one does not fit."""

import functools
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.models.qwen import tiny
from tests.touchr1_jax.models.qwen.cases import CASES
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.rules import state_shardings
from touchr1_jax.models.nf4 import quantised
from touchr1_jax.models.qwen.config import released
from touchr1_jax.models.qwen.model import abstract_params, init_params
from touchr1_jax.models.qwen.names import published
from touchr1_jax.models.qwen.safetensors import read_header, write_file
from touchr1_jax.models.qwen.weights import load_params, save_params, save_tensors

pytestmark = pytest.mark.long

CASE = CASES["text_untied"]
CONFIG = tiny.config_of(CASE)


@pytest.fixture
def weights() -> dict[str, np.ndarray]:
    return tiny.tensors(CONFIG)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return tiny.params_of(CASE, tmp_path_factory.mktemp("checkpoint"))


def assert_equal(ours, theirs) -> None:
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


def new_names(weights: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Keys as transformers ≥ 4.52 writes them."""

    def rename(key: str) -> str:
        if key.startswith("visual."):
            return f"model.{key}"
        return key.replace("model.", "model.language_model.", 1) if key.startswith("model.") else key

    return {rename(key): x for key, x in weights.items()}


def write_shards(directory, weights: dict[str, np.ndarray], count: int = 3) -> None:
    names, place = sorted(weights), {}
    for i in range(count):
        file = f"model-{i + 1:05}-of-{count:05}.safetensors"
        write_file(directory / file, {name: weights[name] for name in names[i::count]})
        place |= dict.fromkeys(names[i::count], file)
    (directory / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": place}))


@pytest.mark.parametrize(
    ("size", "count"),
    [
        ("3B", 3_754_622_976),
        ("7B", 8_292_166_656),
        ("32B", 33_452_718_336),
        ("Qwen3-VL-4B", 4_437_815_808),
    ],
)
def test_released_sizes_have_as_many_parameters_as_published(size, count):
    """Half the `total_size` of the released index files, which count bytes of bfloat16."""
    assert sum(math.prod(x.shape) for x in jax.tree.leaves(abstract_params(released(size)))) == count


def test_initial_parameters_have_the_abstract_shapes():
    shape = lambda x: (x.shape, x.dtype)
    fresh = jax.eval_shape(lambda k: init_params(CONFIG, k), jax.random.key(0))
    assert jax.tree.map(shape, fresh) == jax.tree.map(shape, abstract_params(CONFIG))


def test_kernels_lie_with_inputs_first(expected, weights):
    """Published as [out, in], and the patch embedding as a convolution."""
    first, last = (expected["decoder"][name]["mlp"]["down"]["kernel"] for name in ("layers", "last_layer"))
    np.testing.assert_array_equal(first[0], weights["model.layers.0.mlp.down_proj.weight"].T)
    np.testing.assert_array_equal(last, weights["model.layers.1.mlp.down_proj.weight"].T)
    patch = weights["visual.patch_embed.proj.weight"]
    np.testing.assert_array_equal(expected["vision"]["patch_embed"], patch.reshape(len(patch), -1).T)
    np.testing.assert_array_equal(expected["decoder"]["head"]["kernel"], weights["lm_head.weight"].T)


@pytest.mark.parametrize("rename", [dict, new_names])
@pytest.mark.parametrize("sharded", [False, True])
def test_every_layout_gives_the_same_parameters(tmp_path, weights, expected, rename, sharded):
    if sharded:
        write_shards(tmp_path, rename(weights))
    else:
        write_file(tmp_path / "model.safetensors", rename(weights))
    assert_equal(load_params(tmp_path, CONFIG, jnp.float32), expected)


def test_kernels_are_encoded_as_they_are_read(tmp_path, weights, expected):
    write_file(tmp_path / "model.safetensors", weights)
    assert_equal(load_params(tmp_path, CONFIG, jnp.float32, four_bits=True), quantised(expected))


@pytest.mark.parametrize(
    ("stored", "wanted"), [(np.float32, jnp.bfloat16), (np.float16, jnp.float32), (jnp.bfloat16, jnp.float32)]
)
def test_tensors_are_cast(tmp_path, weights, stored, wanted):
    write_file(tmp_path / "model.safetensors", {k: x.astype(stored) for k, x in weights.items()})
    loaded = load_params(tmp_path, CONFIG, wanted)
    assert {x.dtype for x in jax.tree.leaves(loaded)} == {jnp.dtype(wanted)}
    theirs = weights["model.norm.weight"].astype(stored).astype(wanted)
    np.testing.assert_array_equal(loaded["decoder"]["norm"]["scale"], theirs)


def test_parameters_are_saved_as_published(tmp_path, weights, expected):
    save_params(tmp_path, expected, CONFIG)
    assert_equal(load_params(tmp_path, CONFIG, jnp.float32), expected)
    write_file(tmp_path / "reference.safetensors", weights)
    sizes = {path.stat().st_size for path in tmp_path.iterdir()}
    assert len(sizes) == 1


def test_a_checkpoint_is_written_in_shards_one_tensor_at_a_time(tmp_path, weights, expected):
    seen, made = [], []

    def tensor(source):
        made.append(source.key)
        return weights[published(source.key, CONFIG)]

    size = save_tensors(tmp_path, CONFIG, tensor, jnp.dtype(np.float32), lambda *x: seen.append(x), shard_bytes=30_000)
    assert size == sum(x.nbytes for x in weights.values())
    assert len(made) == len(seen) == len(weights)
    assert seen[-1] == (size, size)
    shards = [read_header(path) for path in sorted(tmp_path.glob("*.safetensors"))]
    assert len(shards) > 2
    assert all(len(shard) == 1 or sum(entry.size for entry in shard.values()) <= 30_000 for shard in shards)
    assert_equal(load_params(tmp_path, CONFIG, jnp.float32), expected)
    with pytest.raises(ValueError, match="must be float32"):
        save_tensors(tmp_path, CONFIG, lambda source: tensor(source)[:1], jnp.dtype(np.float32))


def test_only_whole_trees_are_saved(tmp_path, expected):
    with pytest.raises(ValueError, match="params and config differ in decoder/head/kernel"):
        save_params(tmp_path, expected, tiny.config_of(CASES["text"]))


def misfit(tmp_path, weights) -> str:
    """The error of a checkpoint with these tensors."""
    write_file(tmp_path / "model.safetensors", weights)
    with pytest.raises(ValueError, match="does not hold the tensors") as caught:
        load_params(tmp_path, CONFIG)
    return str(caught.value)


def test_everything_that_does_not_fit_is_named(tmp_path, weights):
    """A missing, an extra and a misshapen tensor, in one error, before anything is read."""
    del weights["visual.blocks.2.attn.qkv.bias"]
    weights["model.layers.2.mlp.up_proj.weight"] = np.zeros((80, 64), np.float32)
    weights["model.embed_tokens.weight"] = weights["model.embed_tokens.weight"][:-1]
    lines = misfit(tmp_path, weights).splitlines()
    assert "  missing: visual.blocks.2.attn.qkv.bias (96,)" in lines
    assert "  extra: model.layers.2.mlp.up_proj.weight (80, 64) in model.safetensors" in lines
    assert "  shape: model.embed_tokens.weight is (95, 64), expected (96, 64)" in lines
    assert len(lines) == 5


def test_many_misfits_are_counted(tmp_path, weights):
    text = misfit(tmp_path, {k: x for k, x in weights.items() if not k.startswith("visual.")})
    assert text.count("missing:") == 12
    assert "… and 42 more" in text


def test_tied_head_beside_an_untied_config_is_missing(tmp_path, weights):
    del weights["lm_head.weight"]
    assert "missing: lm_head.weight (96, 64)" in misfit(tmp_path, weights)


def test_a_tied_checkpoint_may_store_its_head(tmp_path, weights):
    """As some libraries write it, and only where it is the embedding."""
    tied, table = tiny.config_of(CASES["text"]), weights["model.embed_tokens.weight"]
    write_file(tmp_path / "model.safetensors", weights | {"lm_head.weight": table})
    assert "head" not in load_params(tmp_path, tied)["decoder"]
    write_file(tmp_path / "model.safetensors", weights | {"lm_head.weight": -table})
    with pytest.raises(ValueError, match=r"lm_head\.weight differs from the embedding"):
        load_params(tmp_path, tied)
    write_file(tmp_path / "model.safetensors", weights | {"lm_head.weight": table[:-1]})
    with pytest.raises(ValueError, match=r"extra: lm_head\.weight"):
        load_params(tmp_path, tied)


def test_types_that_no_weight_has_are_named(tmp_path, weights):
    write_file(tmp_path / "model.safetensors", weights)
    content = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(content.replace(b'"F32"', b'"I32"', 1))
    with pytest.raises(ValueError, match=r"type: .* is I32, expected one of F32, F16, BF16"):
        load_params(tmp_path, CONFIG)


def test_old_and_new_names_together_are_refused(tmp_path, weights):
    both = weights | {k: x for k, x in new_names(weights).items() if "norm.weight" in k}
    write_file(tmp_path / "model.safetensors", both)
    with pytest.raises(ValueError, match="is there twice, under an old and a new name"):
        load_params(tmp_path, CONFIG)


def test_no_weights_are_said_to_be_missing(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds neither model\.safetensors nor"):
        load_params(tmp_path, CONFIG)


SECOND, INDEX = "model-00002-of-00003.safetensors", "model.safetensors.index.json"


def forget_the_norm(folder, weights):
    index = json.loads((folder / INDEX).read_text())
    del index["weight_map"]["model.norm.weight"]
    (folder / INDEX).write_text(json.dumps(index))


def repeat_the_first(folder, weights):
    names = sorted(weights)
    write_file(folder / SECOND, {name: weights[name] for name in [*names[1::3], names[0]]})


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (lambda folder, _: (folder / SECOND).unlink(), FileNotFoundError, f"{SECOND} is named by .* and is not there"),
        (forget_the_norm, ValueError, r"its shards differ in model\.norm\.weight"),
        (repeat_the_first, ValueError, f"{SECOND} holds lm_head.weight, as another shard"),
        (
            lambda folder, _: (folder / INDEX).unlink(),
            FileNotFoundError,
            "holds model-00001-of-00003.safetensors and not .*index.json",
        ),
    ],
)
def test_shards_that_do_not_fit_are_named(tmp_path, weights, damage, error, message):
    write_shards(tmp_path, weights)
    damage(tmp_path, weights)
    with pytest.raises(error, match=message):
        load_params(tmp_path, CONFIG)


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "{}",
        "[]",
        '{"weight_map": 1}',
        '{"weight_map": {"a": 1}}',
        '{"weight_map": {"a": []}}',
        '{"weight_map": {"a": "../b"}}',
    ],
)
def test_index_must_be_one(tmp_path, content):
    (tmp_path / "model.safetensors.index.json").write_text(content)
    with pytest.raises(ValueError, match="is no index: must be JSON with a weight_map"):
        load_params(tmp_path, CONFIG)


def test_loaded_parameters_lie_where_they_are_asked_to(tmp_path, weights, expected):
    write_file(tmp_path / "model.safetensors", weights)
    mesh = MeshConfig().build(jax.devices()[:1])
    place = functools.partial(state_shardings, mesh)
    loaded = load_params(tmp_path, CONFIG, jnp.float32, place)
    assert jax.tree.map(lambda x: x.sharding, loaded) == place(loaded)
    assert_equal(loaded, expected)
