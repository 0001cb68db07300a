"""The policy on released weights: prompts, towers, batches of SFT, refused sizes; its files, and what merging keeps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.loops import KEPT
from experiments.paper.released_policy import (
    TOUCH_FILE,
    build_released_policy,
    grpo_shape,
    instruction,
    longest_answer,
    merged_shares,
    plain_answers,
    read_policy,
    require_same,
    write_policy,
)
from experiments.paper.tiny_checkpoint import published_config
from experiments.paper.touch_r1 import ARM, SMOKE
from experiments.study.stages import StudySFT
from experiments.study.study import BLIND
from experiments.study.study import SFT as SFT_NAME
from sensors_io.schema import SENSORS
from tests.experiments import tiny
from tests.experiments.paper.conftest import MODEL
from tests.touchr1_jax.text.vocabularies import character_level
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.load import Load, WeightsError, load_checkpoint
from touchr1_jax.models.qwen.config import parse_config, released

SFT = StudySFT(batch_size=3, questions=2, micro_contacts=1)


def test_the_system_says_what_an_answer_looks_like(policy):
    said = instruction(policy.language)
    assert said in policy.tokenizer.decode(policy.layout.ids[0])
    assert "<perceive> SENSOR LEVEL ... </perceive> <compare> LEVEL </compare> <conclude> LEVEL </conclude>" in said
    assert "hardness: soft, firm, hard;" in said


def test_no_answer_is_longer_than_the_longest(policy):
    """Letter by letter it is the one that says "protruding" six times."""
    texts = list(plain_answers(policy.language))
    assert len(texts) == 3 + 3 + 3 + 9
    (longest,) = (text for text in texts if text.count("protruding") == len(SENSORS) + 2)
    assert longest_answer(policy.language, character_level()) == len(longest) + 1


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ((1, 2, 1), r"micro_prompts is 1: must be a multiple of data · fsdp = 2"),
        ((1, 1, 4), r"num_kv_heads is 2: must be a multiple of mesh tensor = 4"),
    ],
)
def test_a_mesh_that_cannot_share_the_work_is_named_before_there_is_data(policy, mesh, message):
    assert grpo_shape(SMOKE, policy, (1, 1, 2)).mesh.tensor == 2
    with pytest.raises(SizeError, match=f"GRPO cannot be shared by the devices of the mesh: {message}"):
        grpo_shape(SMOKE, policy, mesh)


def test_the_released_towers_are_taken_as_they_are(policy, streamed, checkpoint):
    params = policy.init(0, tiny.one_batch(streamed))
    assert params["decoder"] is checkpoint.params["decoder"]
    assert params["vision"]["tower"] is checkpoint.params["vision"]
    assert policy.fns.cache_dtype == jnp.float32 == checkpoint.params["decoder"]["embedding"]["embedding"].dtype
    assert set(params) - set(policy.frozen) == {"tactile", "tactile_norm", "tactile_in", "tactile_out"}
    other = policy.init(1, tiny.one_batch(streamed))
    assert (np.asarray(other["tactile_in"]["kernel"]) != np.asarray(params["tactile_in"]["kernel"])).any()


@pytest.mark.parametrize("size", ["3B", "7B"])
def test_a_config_is_read_as_it_was_written(size):
    assert parse_config(published_config(released(size))) == released(size)


@pytest.fixture(scope="module")
def trained(policy, streamed):
    """Parameters none of which is the checkpoint's any more."""
    params = policy.init(0, tiny.one_batch(streamed))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.1, x.shape), x.dtype), params)


@pytest.fixture(scope="module")
def folder(trained, weights, tmp_path_factory):
    """Written in place of an older one."""
    folder = tmp_path_factory.mktemp("run") / "weights" / "0"
    folder.mkdir(parents=True)
    (folder / "left.json").write_text("{}")
    write_policy(folder, weights, trained)
    return folder


def test_the_folder_is_a_release(folder, weights, capsys):
    assert Load(directory=folder, dtype="float32").run() == 0
    assert "1 layers of 64" in capsys.readouterr().out
    assert {path.name for path in folder.iterdir()} == {path.name for path in weights.iterdir()} | {TOUCH_FILE}
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


def test_what_was_written_gives_the_same_logits(folder, trained, policy, streamed):
    """Of the whole policy from its folder, and of the released towers alone from the loader of releases."""
    read = read_policy(folder, jnp.float32)
    assert jax.tree.all(jax.tree.map(np.array_equal, read, trained))
    again = load_checkpoint(folder, jnp.float32).params
    batch, layout = tiny.one_batch(streamed), policy.layout

    @jax.jit
    def logits(params):
        features = jax.tree.map(lambda x: x[0], policy.fns.encode(params, batch))
        return policy.fns.prefill(params, features, jnp.asarray(layout.ids[0]), jnp.asarray(layout.mask[0]))[0]

    ours = np.asarray(logits(trained))
    assert np.isfinite(ours[~policy.tokenizer.banned]).all()
    np.testing.assert_array_equal(logits(read), ours)
    towers = {**trained, "vision": {"tower": again["vision"]}, "decoder": again["decoder"]}
    np.testing.assert_array_equal(logits(towers), ours)
    assert (np.asarray(logits({**trained, "decoder": policy.checkpoint.params["decoder"]})) != ours).any()


@pytest.mark.parametrize("at", [0, 2**20 - 1, 3 * 2**20 - 1])
def test_weights_of_the_same_size_with_another_byte_at_either_end_are_refused(tmp_path, context, at):
    shard = np.zeros(3 * 2**20, np.uint8)
    (tmp_path / "config.json").write_text("{}")
    shard.tofile(tmp_path / "model.safetensors")
    for _ in range(2):
        require_same(tmp_path, context)
    (tmp_path / "later.json").write_text("{}")
    with pytest.raises(WeightsError, match=r"later\.json changed"):
        require_same(tmp_path, context)
    (tmp_path / "later.json").unlink()
    shard[at] = 1
    shard.tofile(tmp_path / "model.safetensors")
    with pytest.raises(WeightsError, match=r"not what this run began with: model\.safetensors changed; put it back"):
        require_same(tmp_path, context)


def test_what_merging_keeps_is_the_least_of_all_seeds(context):
    shares = {"sft": (0.97, 0.95), f"grpo/{ARM}": (0.4, 0.99), "blind": (1.0, 1.0)}
    for stage, of_seeds in shares.items():
        for seed, share in enumerate(of_seeds):
            context.save_stage(f"{KEPT}/{stage}/{seed}", share)
    assert merged_shares(ARM, 2, context) == {SFT_NAME: 0.95, ARM: 0.4, BLIND: 1.0}


def test_completions_must_have_room_for_an_answer(checkpoint):
    model = dataclasses.replace(MODEL, completion_tokens=20)
    with pytest.raises(SizeError, match=r"model\.completion_tokens is 20: the longest answer takes \d+ tokens"):
        build_released_policy(model, checkpoint, SENSORS)


def test_a_release_alone_is_no_policy(weights):
    with pytest.raises(FileNotFoundError, match=f"holds no {TOUCH_FILE}: must be a folder that `touch_r1` wrote"):
        read_policy(weights, jnp.float32)
