"""Adapters on disk are PEFT's: names, turned factors and settings by hand, and the same logits where peft is there."""

import dataclasses
import importlib.util
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.models.qwen import tiny
from tests.touchr1_jax.models.qwen.cases import CASES
from touchr1_jax.models.lora import LoraConfig, adapted, init_adapters
from touchr1_jax.models.qwen.model import QwenVL, abstract_params
from touchr1_jax.models.qwen.peft import load_adapters, save_adapters
from touchr1_jax.models.qwen.safetensors import read_header, read_tensor, write_file

pytestmark = pytest.mark.long

NAME = "mixed"
CONFIG = tiny.config_of(CASES[NAME])
LORA = LoraConfig(rank=3, alpha=5.0, rank_stabilised=True, vision_targets=("qkv", "proj", "gate", "merger_in"))
PREFIX = "base_model.model.model."


def loud(lora: LoraConfig = LORA):
    """Adapters that change much, of both towers."""
    rng = np.random.default_rng(0)
    fresh = jax.eval_shape(lambda: init_adapters(jax.random.key(0), abstract_params(CONFIG), lora))
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), fresh)


@pytest.fixture
def folder(tmp_path):
    save_adapters(tmp_path, loud(), CONFIG, LORA, "released")
    return tmp_path


def test_names_and_factors_by_hand(folder):
    """The first of two layers is a row of a stack, the last stands alone; PEFT's factors are [r, in] and [out, r]."""
    header, found = read_header(folder / "adapter_model.safetensors"), loud()
    first = f"{PREFIX}language_model.layers.0.self_attn.q_proj.lora_A.weight"
    last = f"{PREFIX}language_model.layers.1.mlp.down_proj.lora_B.weight"
    seen = f"{PREFIX}visual.blocks.1.attn.qkv.lora_A.weight"
    merger = f"{PREFIX}visual.merger.mlp.0.lora_B.weight"
    theirs = {name: read_tensor(header[name]) for name in (first, last, seen, merger)}
    np.testing.assert_array_equal(theirs[first], found["decoder"]["layers"]["q_proj"]["a"][0].T)
    np.testing.assert_array_equal(theirs[last], found["decoder"]["last_layer"]["mlp"]["down"]["b"].T)
    np.testing.assert_array_equal(theirs[seen], found["vision"]["blocks"]["qkv"]["a"][1].T)
    np.testing.assert_array_equal(theirs[merger], found["vision"]["merger_in"]["b"].T)
    layers, blocks = CONFIG.decoder.num_layers, CONFIG.vision.depth
    assert len(header) == 2 * (7 * layers + 3 * blocks + 1)
    written = json.loads((folder / "adapter_config.json").read_text())
    assert (written["peft_type"], written["r"], written["lora_alpha"], written["use_rslora"]) == ("LORA", 3, 5.0, True)


def test_what_was_saved_is_loaded(folder):
    found, lora = load_adapters(folder, CONFIG)
    jax.tree.map(np.testing.assert_array_equal, found, loud())
    assert (lora.rank, lora.alpha, lora.rank_stabilised) == (3, 5.0, True)


def rewrite(folder, change) -> None:
    tensors = {n: read_tensor(e) for n, e in read_header(folder / "adapter_model.safetensors").items()}
    write_file(folder / "adapter_model.safetensors", change(tensors))


LAST = f"{PREFIX}language_model.layers.1.mlp.down_proj.lora_B.weight"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: {**t, f"{PREFIX}nose.lora_A.weight": np.ones((3, 2), np.float32)},
            "belongs to no layer of the base",
        ),
        (lambda t: {n: x for n, x in t.items() if n != LAST}, r"layers\.1\.mlp\.down_proj\.lora_B\.weight is missing"),
        (lambda t: {**t, LAST: t[LAST][:-1]}, r"must be \(64, 3\) of rank 3"),
        (lambda t: {**t, LAST: t[LAST] * np.float32(np.nan)}, "holds NaN or infinity"),
        (lambda t: {n: x for n, x in t.items() if "blocks.1.attn.qkv" not in n}, "layer 1 has no adapter of qkv"),
        (lambda t: {**t, LAST: t[LAST].astype(np.int8)}, r"is I8 \(64, 3\): must be .* of real numbers"),
        (lambda t: {}, "has no adapter"),
        (lambda t: {**t, LAST.replace("lora_B", "lora_B.default"): t[LAST] * 2}, "or one of them twice"),
    ],
)
def test_misfits_are_named(folder, change, message):
    rewrite(folder, change)
    with pytest.raises(ValueError, match=message):
        load_adapters(folder, CONFIG)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("peft_type", "LOHA", "peft_type is 'LOHA': must be 'LORA'"),
        ("use_dora", True, "use_dora is True: must be False"),
        ("alpha_pattern", {"q_proj": 64}, "alpha_pattern is "),
        ("bias", "all", "bias is 'all': must be 'none'"),
        ("r", 0, "r is 0 and lora_alpha 5.0: must be"),
        ("lora_alpha", float("inf"), "lora_alpha inf: must be"),
        ("lora_alpha", 10**400, "must be a whole number ≥ 1 and a number above 0"),
        ("use_rslora", "false", "use_rslora is 'false': must be true or false"),
        ("alpha_pattern", {"q_proj": 64}, r"alpha_pattern is {'q_proj': 64}: must be {}"),
        ("layer_replication", [[0, 2]], "layer_replication is"),
    ],
)
def test_other_kinds_of_adapters_are_named(folder, field, value, message):
    path = folder / "adapter_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    with pytest.raises(ValueError, match=message):
        load_adapters(folder, CONFIG)


@pytest.mark.parametrize(
    ("text", "message"), [("[]", "must be a JSON object"), ("[" * 100_000, "is no JSON .*; copy it again")]
)
def test_a_config_that_is_no_object_is_named(folder, text, message):
    (folder / "adapter_config.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        load_adapters(folder, CONFIG)


def test_a_missing_file_is_named(folder):
    (folder / "adapter_model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"adapter_model\.safetensors is no file"):
        load_adapters(folder, CONFIG)


THERE = """
import sys, numpy as np, torch
from peft import PeftModel
from tests.touchr1_jax.models.qwen.cases import CASES
from tests.touchr1_jax.models.qwen.make_golden import positions, reference_inputs, reference_model
folder, name = sys.argv[1:]
base = reference_model(CASES[name])
inputs = reference_inputs(name, CASES[name])
ids = positions(base, CASES[name], inputs)
model = PeftModel.from_pretrained(base, folder).eval()
with torch.no_grad():
    np.save(folder + "/logits.npy", model(**inputs, position_ids=ids, use_cache=False).logits[0].numpy())
model.save_pretrained(folder + "/again")
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("peft", "transformers", "torch")),
    reason="the parity extra is not installed",
)
def test_peft_computes_the_same_logits_and_writes_what_is_read_again(folder, tmp_path_factory):
    subprocess.run([sys.executable, "-W", "ignore", "-c", THERE, str(folder), NAME], check=True, timeout=300)
    theirs = np.load(folder / "logits.npy")
    adapters, lora = load_adapters(folder / "again", CONFIG)
    jax.tree.map(np.testing.assert_array_equal, adapters, loud())
    params = tiny.params_of(CASES[NAME], tmp_path_factory.mktemp("checkpoint"))
    with adapted(lora.scale):
        ours = QwenVL(CONFIG).apply(
            {"params": params, "adapters": adapters}, tiny.inputs_of(NAME), tiny.grids_of(CASES[NAME])
        )
    plain = QwenVL(CONFIG).apply({"params": params}, tiny.inputs_of(NAME), tiny.grids_of(CASES[NAME]))
    scale = np.abs(theirs).max()
    assert np.abs(plain - theirs).max() > 0.1 * scale
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5 * scale)
    assert dataclasses.replace(lora, targets=LORA.targets, vision_targets=LORA.vision_targets) == LORA


def test_adapters_of_qwen3_are_named_as_its_modules(tmp_path):
    """The second merger of DeepStack stands alone; MLPs and mergers have layers of one name."""
    config = tiny.config_of(CASES["qwen3_mixed_1"])
    lora = LoraConfig(rank=2, targets=("q_proj",), vision_targets=("qkv", "linear_fc1"))
    shapes = jax.eval_shape(lambda: init_adapters(jax.random.key(0), abstract_params(config), lora))
    rng = np.random.default_rng(0)
    drawn = jax.tree.map(lambda x: jnp.asarray(rng.normal(0, 0.2, x.shape), jnp.float32), shapes)
    save_adapters(tmp_path, drawn, config, lora, "released")
    header = read_header(tmp_path / "adapter_model.safetensors")
    merger = read_tensor(header[f"{PREFIX}visual.deepstack_merger_list.1.linear_fc1.lora_A.weight"])
    np.testing.assert_array_equal(merger, drawn["vision"]["deepstack_merger_list_1"]["linear_fc1"]["a"].T)
    blocks, levels = config.vision.depth, config.vision.levels
    assert len(header) == 2 * (config.decoder.num_layers + 2 * blocks + 1 + levels)
    jax.tree.map(np.testing.assert_array_equal, load_adapters(tmp_path, config)[0], drawn)
