"""A policy that one experiment made is found by the next, and by none that differs in anything that matters."""

import ast
import dataclasses
import io
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from experiments.core.artifacts import write_arrays
from experiments.core.context import Context
from experiments.core.runs import ROOT
from experiments.study.cache import LATER, NEVER, USED, fingerprint, read_policy, source_digest
from experiments.study.seed import StudySeed
from experiments.study.stages import EncodedContacts, make_arm
from sensors_io.arrays import ArraysError
from sensors_io.records import RecordStore
from tests.experiments import tiny
from tests.sensors_io.checks import refused
from touchr1_jax.training.loop import LoopConfig

CONFIG = tiny.STUDY.sft  # whose program other tests compile too


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Runs by their names, and the one cache of all."""
    return tmp_path_factory.mktemp("shared")


def within(home, name: str, train):
    """The result of a stage in a run, and the policies in the cache afterwards."""
    (home / name).mkdir(exist_ok=True)
    context = Context(home / name, home / "cache", Console(quiet=True))
    try:
        return train(context), {path.name for path in (home / "cache").glob("*/*.npz")}
    finally:
        context.close()


@pytest.fixture(scope="module")
def sft(policy, data, home):
    of = {"config": tiny.STUDY, "data": data, "policy": policy, "share": True}
    of |= {"evidence": np.zeros((len(data.store), len(data.clip.sensors), data.label.shape[1], 9), np.float32)}
    return lambda name, config=CONFIG, seed=0: within(
        home, name, lambda context: StudySeed(**of, context=context, seed=seed).run_sft(config, "sft")
    )


@pytest.fixture(scope="module")
def first(sft):
    return sft("first")


@pytest.mark.long
def test_another_run_finds_the_parameters_and_the_log(sft, first, home):
    params, files = sft("second")
    assert files == first[1]
    assert not (home / "second" / "checkpoints").exists()  # nothing was trained
    jax.tree.map(np.testing.assert_array_equal, params, first[0])
    assert jax.tree.structure(params) == jax.tree.structure(first[0])
    log = (home / "second" / "metrics.jsonl").read_bytes()
    assert log == (home / "first" / "metrics.jsonl").read_bytes()
    assert log.count(b"\n") == CONFIG.steps


@pytest.mark.long
def test_a_damaged_file_of_the_cache_is_made_again(sft, first, home):
    (path,) = (home / "cache" / "sft").glob("*.npz")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] + bytes([whole[len(whole) // 2] ^ 1]) + whole[len(whole) // 2 + 1 :])
    params, _ = sft("mended")
    jax.tree.map(np.testing.assert_array_equal, params, first[0])
    assert np.load(path).files == np.load(io.BytesIO(whole)).files
    assert sft("found again")[0].keys() == params.keys()


def test_a_policy_of_another_hash_is_not_taken(tmp_path):
    made = {"metrics": np.frombuffer(b"[]", np.uint8), "w": np.ones(2)}
    write_arrays(tmp_path / "0.npz", made, of="1")
    refused(ArraysError, "is of 1: must be of 0", read_policy, tmp_path / "0.npz")


@pytest.mark.long
@pytest.mark.parametrize(("steps", "seed"), [(0, 0), (3, 1)])
def test_another_setting_is_another_checkpoint(sft, first, steps, seed):
    before = sft("second")[1]
    assert len(sft("other", dataclasses.replace(CONFIG, steps=steps), seed)[1] - before) == 1


@pytest.fixture
def grpo(policy, params, data, tmp_path):
    """An arm of a run; one of no steps is trained at once."""

    def run(name, weights=(("accuracy", 1.0),), moved=0.0, steps=0, seed=0, validated=False):
        features = tiny.features(2)
        features = dataclasses.replace(features, touch=features.touch + moved)
        noise, label = jnp.asarray(tiny.features(1, seed=1).touch), np.zeros((2, 4), np.int32)
        evidence = np.zeros((2, *features.stream_mask.shape[1:], 4, 9), np.float32)
        contacts = EncodedContacts(features=features, label=label, truth=label, noise=noise, evidence=evidence)
        loop = LoopConfig(steps=steps, save_every=1)
        arm = make_arm(policy, dict(weights), data.prior(), tiny.STUDY.grpo, loop)
        of = {"config": tiny.STUDY, "data": data, "policy": policy, "evidence": evidence, "seed": seed, "share": True}
        more = {"validation": (features, label)} if validated else {}
        train = lambda context: StudySeed(**of, context=context).run_grpo(arm, "grpo/a", contacts, params, **more)
        return within(tmp_path, name, train)

    return run


@pytest.mark.long
@pytest.mark.parametrize(
    ("other", "trained"),
    [
        ({}, 0),
        ({"weights": (("accuracy", 0.5),)}, 1),
        ({"weights": (("exact", 1.0),)}, 1),
        ({"moved": 1e-6}, 1),
        pytest.param({"steps": 1}, 1, marks=pytest.mark.slow),  # compiles the step, as the paper's runs do
        ({"seed": 1}, 1),
        ({"validated": True}, 1),
    ],
    ids=str,
)
def test_an_arm_that_differs_in_anything_is_trained(grpo, other, trained):
    params, before = grpo("first")
    found, after = grpo("other", **other)
    assert len(after - before) == trained
    changed = not jax.tree.all(jax.tree.map(np.array_equal, params["decoder"], found["decoder"]))
    assert changed == ("steps" in other)


def test_every_value_and_number_counts_and_how_programs_are_compiled():
    """Numbers of programs that were compiled quickly differ by rounding: no report may show them as the others'."""
    x = {"x": np.arange(3.0)}
    same = fingerprint({"config": CONFIG}, x, "s")
    assert same == fingerprint({"config": CONFIG}, {"x": np.arange(3.0)}, "s")
    others = [
        fingerprint({"config": CONFIG, "seed": 1}, x, "s"),
        fingerprint({"config": CONFIG}, {"x": np.array([0, 1, 2 + 1e-9])}, "s"),
        fingerprint({"config": CONFIG}, {"x": np.arange(3)}, "s"),
        fingerprint({"config": CONFIG}, {"y": np.arange(3.0)}, "s"),
        fingerprint({"config": CONFIG}, x, "other"),
    ]
    name = "jax_disable_most_optimizations"
    before = jax.config.values[name]
    try:
        jax.config.update(name, not before)
        others.append(fingerprint({"config": CONFIG}, x, "s"))
    finally:
        jax.config.update(name, before)
    assert len({same, *others}) == 7


def test_the_source_of_rewards_counts_for_grpo_alone_and_that_of_models_for_both(tmp_path):
    for name in ("touchr1_jax/models/lm.py", "touchr1_jax/rewards/mine.py", "touchr1_jax/rl/losses.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("one")
    digest = lambda without=LATER: source_digest.__wrapped__(without, tmp_path)
    start, reinforced = digest(), digest(NEVER)
    (tmp_path / "touchr1_jax/rewards/mine.py").write_text("two")
    assert digest() == start
    assert digest(NEVER) != reinforced
    for name in ("touchr1_jax/models/lm.py", "touchr1_jax/rl/losses.py"):
        before = digest()
        (tmp_path / name).write_text("two")
        assert digest() != before


@pytest.mark.long
def test_the_source_that_sft_is_built_on_counts():
    """No library file that counts imports one that does not."""
    for path in (*(ROOT / "touchr1_jax").rglob("*.py"), *(ROOT / "sensors_io").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        if name.startswith(LATER) or path.name == "__main__.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                imported = (node.module or "").replace(".", "/")
                counts = not f"{imported}/".startswith(LATER) and not f"{imported}.py".startswith(LATER)
                assert counts or f"{imported}.py" in USED, f"{name} imports {node.module}"


@pytest.mark.long
def test_a_resumed_run_keeps_the_order_of_its_log(sft, first, home):
    log = home / "first" / "metrics.jsonl"
    before = log.read_bytes() + b'{"stage": "grpo/a/0", "step": 0}\n'
    log.write_bytes(before)
    sft("first")
    assert log.read_bytes() == before


def test_other_records_are_another_checkpoint(data, tmp_path):
    """The same touch may come with other pictures: the index knows, by its configuration and its shards' sizes."""
    shutil.copytree(data.store.path, tmp_path / "other")
    index = tmp_path / "other" / "index.json"
    assert RecordStore(tmp_path / "other").digest == data.store.digest
    tree = json.loads(index.read_text())
    tree["meta"]["config_hash"] += "0"
    del tree["crc32"]
    index.write_text(json.dumps(tree))
    assert RecordStore(tmp_path / "other").digest != data.store.digest
