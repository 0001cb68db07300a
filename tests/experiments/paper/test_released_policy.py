"""The policy on released weights: prompts, towers, batches of SFT, refused sizes; its files."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper.released_policy import grpo_shape, require_same
from experiments.paper.tiny_checkpoint import published_config
from experiments.paper.touch_r1 import SMOKE
from experiments.study.stages import StudySFT
from sensors_io.schema import SENSORS
from tests.experiments import tiny
from tests.experiments.paper.conftest import LORA, MODEL
from tests.touchr1_jax.text.vocabularies import character_level
from touchr1_jax.models.adapted_folder import export_merged, read_adapted, save_adapted
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.load import Load, WeightsError, load_checkpoint
from touchr1_jax.models.lora import with_adapters
from touchr1_jax.models.qwen.config import released
from touchr1_jax.models.qwen.config_file import parse_config
from touchr1_jax.models.qwen.safetensors import read_header, read_tensor, write_file
from touchr1_jax.models.qwen.weights import SINGLE
from touchr1_jax.models.released_policy import build_released_policy, instruction, longest_answer, plain_answers
from touchr1_jax.models.saved_policy import PolicyError, PolicyInput, SavedPolicy, digest_of, seal
from touchr1_jax.models.touch_policy import with_lora

SFT = StudySFT(batch_size=3, questions=2, micro_contacts=1)


@pytest.mark.long
def test_the_system_says_what_an_answer_looks_like(policy):
    said = instruction(policy.language)
    assert said in policy.tokenizer.decode(policy.layout.ids[0])
    assert "<perceive> SENSOR LEVEL ... </perceive> <compare> LEVEL </compare> <conclude> LEVEL </conclude>" in said
    assert "hardness: soft, firm, hard;" in said


@pytest.mark.long
def test_no_answer_is_longer_than_the_longest(policy):
    """Letter by letter it is the one that says "protruding" six times."""
    texts = list(plain_answers(policy.language))
    assert len(texts) == 3 + 3 + 3 + 9
    (longest,) = (text for text in texts if text.count("protruding") == len(SENSORS) + 2)
    assert longest_answer(policy.language, character_level()) == len(longest) + 1


@pytest.mark.long
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


@pytest.mark.long
def test_the_released_towers_are_taken_as_they_are(policy, streamed, checkpoint):
    params = policy.init(0, tiny.one_batch(streamed))
    assert params["decoder"] is checkpoint.params["decoder"]
    assert params["vision"]["tower"] is checkpoint.params["vision"]
    assert policy.fns.cache_dtype == jnp.float32 == checkpoint.params["decoder"]["embedding"]["embedding"].dtype
    assert set(params) - set(policy.frozen) == {"tactile", "tactile_norm", "tactile_in", "tactile_out"}
    other = policy.init(1, tiny.one_batch(streamed))
    assert (np.asarray(other["tactile_in"]["kernel"]) != np.asarray(params["tactile_in"]["kernel"])).any()


@pytest.mark.parametrize("size", ["3B", "7B", "32B"])
def test_a_config_is_read_as_it_was_written(size):
    assert parse_config(json.loads(json.dumps(published_config(released(size))))) == released(size)


@pytest.fixture(scope="module")
def saved(policy, streamed):
    """A policy with loud adapters and a tactile encoder that is not the fresh one."""
    rng = np.random.default_rng(0)
    loud = lambda x: x + jnp.asarray(rng.normal(0, 0.1, x.shape), x.dtype)
    params = policy.init(0, tiny.one_batch(streamed))
    params = with_adapters(params, LORA, params, 0)
    params |= {name: jax.tree.map(loud, params[name]) for name in ("adapters", "tactile", "tactile_out")}
    return SavedPolicy(policy=policy, params=params, reads=PolicyInput(), notes={"name": "trial"})


@pytest.fixture(scope="module")
def folder(saved, weights, tmp_path_factory):
    """Written in place of an older one."""
    folder = tmp_path_factory.mktemp("run") / "policies" / "0"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    save_adapted(folder, saved, str(weights))
    return folder


def first_logits(policy, params, batch):
    @jax.jit
    def logits(params, batch):
        features = jax.tree.map(lambda x: x[0], policy.fns.encode(params, batch))
        ids, mask = jnp.asarray(policy.layout.ids[0]), jnp.asarray(policy.layout.mask[0])
        return policy.fns.prefill(params, features, ids, mask)[0]

    return np.asarray(logits(params, batch))


@pytest.mark.long
def test_a_written_policy_describes_itself(folder, saved):
    """Parameters bit by bit, adapters of both towers among them, from the folder and the released weights alone."""
    tensors = {"adapter_model.safetensors", "touch_encoder.safetensors"}
    assert {path.name for path in folder.iterdir()} == {"README.md", "config.json", "adapter_config.json", *tensors}
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    found = read_adapted(folder)
    assert jax.tree.all(jax.tree.map(np.array_equal, found.params, saved.params))
    assert (found.policy.fns.lora, found.policy.model) == (LORA, saved.policy.model)
    assert (found.reads, found.notes, found.sensors) == (saved.reads, saved.notes, saved.sensors)


@pytest.mark.long
def test_a_policy_in_four_bits_is_read_again_and_exported_from_the_released_weights(saved, weights, streamed, tmp_path):
    found = load_checkpoint(weights, jnp.float32, four_bits=True)
    model = dataclasses.replace(saved.policy.model, four_bits=True)
    policy = with_lora(build_released_policy(model, found, streamed.clip.sensors), LORA)
    params = {**saved.params, "decoder": found.params["decoder"]}
    stored = dataclasses.replace(saved, policy=policy, params=params)
    save_adapted(tmp_path / "policy", stored, str(weights))
    again, batch = read_adapted(tmp_path / "policy"), tiny.one_batch(streamed)
    ours, theirs = (first_logits(x.policy, x.params, batch) for x in (stored, again))
    np.testing.assert_array_equal(ours, theirs)
    assert np.abs(ours - first_logits(saved.policy, saved.params, batch)).max() > 1e-3
    export_merged(tmp_path / "ours", again, jnp.dtype(jnp.float32))
    export_merged(tmp_path / "theirs", saved, jnp.dtype(jnp.float32))
    assert (tmp_path / "ours" / SINGLE).read_bytes() == (tmp_path / "theirs" / SINGLE).read_bytes()


@pytest.mark.long
def test_an_export_computes_the_same_from_the_released_format(folder, saved, streamed, tmp_path, capsys):
    kept = export_merged(tmp_path / "merged", saved, jnp.dtype(jnp.float32))
    assert kept == pytest.approx(1, abs=1e-5)
    assert Load(directory=tmp_path / "merged", dtype="float32").run() == 0
    assert "1 layers of 64" in capsys.readouterr().out
    again, batch = load_checkpoint(tmp_path / "merged", jnp.float32).params, tiny.one_batch(streamed)
    merged = {**saved.params, "vision": {"tower": again["vision"]}, "decoder": again["decoder"]}
    del merged["adapters"]
    ours, theirs = (first_logits(saved.policy, p, batch) for p in (saved.params, merged))
    writable = ~saved.policy.tokenizer.banned
    np.testing.assert_allclose(ours[writable], theirs[writable], atol=1e-5 * np.abs(theirs[writable]).max())
    base = {name: x for name, x in saved.params.items() if name != "adapters"}
    assert np.abs(first_logits(saved.policy, base, batch) - ours)[writable].max() > 0.01
    with pytest.raises(PolicyError, match="it exists and is not empty"):
        export_merged(tmp_path / "merged", saved, jnp.dtype(jnp.float32))


@pytest.mark.long
@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("adapter_model.safetensors", r"adapter_model\.safetensors is missing or damaged; copy the folder again"),
        ("config.json", "was changed after it was written"),
    ],
)
def test_a_damaged_folder_is_named(folder, tmp_path, file, message):
    shutil.copytree(folder, tmp_path / "copy")
    content = (tmp_path / "copy" / file).read_bytes()
    old, new = (b"qkv", b"pkv") if file == "config.json" else (b"lora_A", b"lora_a")
    (tmp_path / "copy" / file).write_bytes(content.replace(old, new, 1))
    with pytest.raises(PolicyError, match=message):
        read_adapted(tmp_path / "copy")


@pytest.mark.long
@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "touch_encoder.safetensors",
            lambda t: {n: x[:-1] for n, x in t.items()},
            "parameters differ from this version's",
        ),
        ("touch_encoder.safetensors", lambda t: {}, "parameters differ from this version's"),
        ("touch_encoder.safetensors", lambda t: {n: x * np.nan for n, x in t.items()}, "are? not finite"),
        ("adapter_model.safetensors", lambda t: {n: x for n, x in t.items() if "q_proj" not in n}, "adapters are of"),
        ("adapter_model.safetensors", lambda t: {n: x[:1] for n, x in t.items()}, "of rank 2"),
        ("config.json", lambda c: {n: x for n, x in c.items() if n != "notes"}, "its config does not fit .*'notes'"),
        ("config.json", lambda c: c | {"questions": []}, "its config does not fit"),
        ("config.json", lambda c: c | {"files": {}}, "its config does not fit"),
        ("config.json", lambda c: c | {"lora": c["lora"] | {"rank_stabilised": True}}, "must be the same"),
    ],
)
def test_a_folder_of_another_version_is_named(folder, tmp_path, file, change, message):
    """Its checksums hold."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    config = json.loads((copy / "config.json").read_text())
    del config["checksum"]
    if file == "config.json":
        config = change(config)
    else:
        write_file(copy / file, change({n: read_tensor(e) for n, e in read_header(copy / file).items()}))
        config["files"][file] = digest_of(copy / file)
    (copy / "config.json").write_text(seal(config))
    with pytest.raises(PolicyError, match=message):
        read_adapted(copy)


@pytest.mark.long
def test_released_weights_that_are_missing_or_others_are_named(saved, weights, tmp_path):
    save_adapted(tmp_path / "policy", saved, "nowhere")
    with pytest.raises(PolicyError, match=r"its released weights are not in .*nowhere; say where by --weights DIR"):
        read_adapted(tmp_path / "policy")
    assert read_adapted(tmp_path / "policy", weights).notes == saved.notes
    shutil.copytree(weights, tmp_path / "other")
    (tmp_path / "other" / "config.json").write_text((weights / "config.json").read_text() + " ")
    with pytest.raises(PolicyError, match=r"config\.json in .*other are not what it was trained on"):
        read_adapted(tmp_path / "policy", tmp_path / "other")


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


@pytest.mark.long
def test_completions_must_have_room_for_an_answer(checkpoint):
    model = dataclasses.replace(MODEL, completion_tokens=20)
    with pytest.raises(SizeError, match=r"model\.completion_tokens is 20: the longest answer takes \d+ tokens"):
        build_released_policy(model, checkpoint, SENSORS)
