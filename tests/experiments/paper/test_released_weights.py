"""Released weights on disk: a run continues with the weights that it began with; a policy is written and read back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.paper.released_weights import (
    TOUCH_FILE,
    file_fingerprint,
    least_merged,
    merged_shares,
    read_policy,
    require_same,
    write_policy,
)

from experiments.core.loops import KEPT
from experiments.paper.tiny_checkpoint import published_config
from experiments.paper.touch_r1 import ARM
from experiments.study.study import BLIND, SFT
from tests.experiments import tiny
from touchr1_jax.models.load import Load, WeightsError, load_checkpoint
from touchr1_jax.models.qwen.config import parse_config, released


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
    folder = tmp_path_factory.mktemp("run") / "weights" / "0"
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


def test_a_folder_is_replaced_whole(folder, trained, weights, tmp_path):
    target = tmp_path / "0"
    target.mkdir()
    (target / "left.json").write_text("{}")
    write_policy(target, weights, trained)
    assert {path.name for path in target.iterdir()} == {path.name for path in folder.iterdir()}


def test_a_release_alone_is_no_policy(weights):
    with pytest.raises(FileNotFoundError, match=f"holds no {TOUCH_FILE}: must be a folder that `touch_r1` wrote"):
        read_policy(weights, jnp.float32)


def test_weights_that_do_not_fit_are_one_kind_of_error(folder, tmp_path):
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "config.json").write_text('{"model_type": "qwen3_vl"}')
    with pytest.raises(WeightsError, match="model_type is 'qwen3_vl': must be 'qwen2_5_vl'"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("at", [0, 2**20 - 1, 3 * 2**20 - 1])
def test_weights_of_the_same_size_with_another_byte_at_either_end_are_refused(tmp_path, context, at):
    shard = np.zeros(3 * 2**20, np.uint8)
    (tmp_path / "config.json").write_text("{}")
    shard.tofile(tmp_path / "model.safetensors")
    for _ in range(2):
        require_same(tmp_path, context)
    shard[at] = 1
    shard.tofile(tmp_path / "model.safetensors")
    with pytest.raises(WeightsError, match=r"not what this run began with: model\.safetensors changed; put it back"):
        require_same(tmp_path, context)


def test_a_file_that_came_later_is_named(tmp_path, context):
    (tmp_path / "config.json").write_text("{}")
    require_same(tmp_path, context)
    (tmp_path / "model.safetensors").write_bytes(b"0")
    with pytest.raises(WeightsError, match=r"model\.safetensors changed"):
        require_same(tmp_path, context)


def test_a_fingerprint_is_the_size_and_the_checksums_of_both_ends(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"123456789")
    assert file_fingerprint(file) == [9, 0xCBF43926, 0xCBF43926]  # the check value of CRC-32
    file.write_bytes(b"")
    assert file_fingerprint(file) == [0, 0, 0]


def test_what_merging_keeps_is_the_least_of_all_seeds(context):
    shares = {"sft": (0.97, 0.95), f"grpo/{ARM}": (0.4, 0.99), "blind": (1.0, 1.0)}
    for stage, of_seeds in shares.items():
        for seed, share in enumerate(of_seeds):
            context.save_stage(f"{KEPT}/{stage}/{seed}", share)
    found = merged_shares(ARM, 2, context)
    assert found == {SFT: 0.95, ARM: 0.4, BLIND: 1.0}
    least = least_merged(found)
    assert least.measured == 0.4
    assert not least.met
    assert least_merged({SFT: 0.95}).met
