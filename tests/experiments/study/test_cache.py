"""A policy that one experiment made is found by the next, and by none that differs in anything that matters."""

import ast
import dataclasses
import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.core.runs import ROOT
from experiments.study.cache import LATER, NEVER, USED, cached_grpo, cached_sft, fingerprint, source_digest
from experiments.study.stages import EncodedContacts, StudySFT, make_arm, run_sft
from sensors_io.records import RecordStore
from tests.experiments import tiny
from touchr1_jax.training.loop import LoopConfig

CONFIG = StudySFT(steps=2, batch_size=4)


@pytest.fixture(scope="module")
def evidence(data):
    """Evidence that says nothing."""
    return np.zeros((len(data.store), len(data.clip.sensors), data.label.shape[1], 9), np.float32)


@pytest.fixture(scope="module")
def make(policy, data, evidence, tmp_path_factory):
    """SFT of a run by its name; all runs have one cache."""
    home = tmp_path_factory.mktemp("shared")

    def run(name: str, config: StudySFT = CONFIG, *, seed: int = 0, train=run_sft) -> tuple[Path, object]:
        (home / name).mkdir(exist_ok=True)
        context = Context(home / name, home / "cache", Console(quiet=True))
        try:
            stage = f"sft/{seed}"
            return home / name, cached_sft(policy, data, evidence, config, context, seed=seed, stage=stage, train=train)
        finally:
            context.close()

    return run


@pytest.fixture(scope="module")
def first(make):
    return make("first")


def test_another_run_finds_the_parameters_and_the_log(make, first):
    directory, params = make("second", train=None)  # training would fail
    jax.tree.map(np.testing.assert_array_equal, params, first[1])
    assert jax.tree.structure(params) == jax.tree.structure(first[1])
    log = (directory / "metrics.jsonl").read_bytes()
    assert log == (first[0] / "metrics.jsonl").read_bytes()
    assert log.count(b"\n") == CONFIG.steps


def test_a_resumed_run_keeps_the_order_of_its_log(make, first):
    log = first[0] / "metrics.jsonl"
    before = log.read_bytes() + b'{"stage": "grpo/a/0", "step": 0}\n'
    log.write_bytes(before)
    make("first")
    assert log.read_bytes() == before


def test_another_setting_is_another_checkpoint(make, first):
    for config, seed in ((dataclasses.replace(CONFIG, steps=3), 0), (CONFIG, 1)):
        with pytest.raises(TypeError):
            make("other", config, seed=seed, train=None)


@pytest.fixture
def reinforce(policy, params, data, tmp_path):
    """An arm in a run of its own, and the stages that were trained; training adds one to the decoder and logs it."""
    trained = []

    def add_one(policy, arm, contacts, params, context, *, seed, stage):
        trained.append(stage)
        context.log(stage, step=0, reward=0.5)
        return {**params, "decoder": jax.tree.map(lambda x: x + 1, params["decoder"])}

    def run(name: str, *, weights=(("accuracy", 1.0),), moved: float = 0.0, steps: int = 1, seed: int = 0):
        (tmp_path / name).mkdir()
        context = Context(tmp_path / name, tmp_path / "cache", Console(quiet=True))
        felt = tiny.features(2)
        felt = dataclasses.replace(felt, touch=felt.touch + moved)
        asked = EncodedContacts(
            features=felt, label=np.zeros((2, 4), int), truth=np.zeros((2, 4), int), noise=np.zeros((1, 4, 2, 8))
        )
        loop = LoopConfig(steps=steps, save_every=1)
        arm = make_arm(policy, dict(weights), data.prior(), tiny.STUDY.grpo, loop)
        made = cached_grpo(policy, arm, asked, params, context, seed=seed, stage="grpo/a/0", train=add_one)
        context.close()
        return made, (tmp_path / name / "metrics.jsonl").read_bytes()

    return run, trained


def test_another_experiment_finds_the_same_arm_with_its_log(reinforce, params):
    run, trained = reinforce
    (first, log), (again, told) = run("first"), run("again")
    assert trained == ["grpo/a/0"]
    assert told == log
    assert jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b), first, again))
    moved = jax.tree.map(lambda a, b: np.allclose(a - b, 1, atol=1e-5), again["decoder"], params["decoder"])
    assert jax.tree.all(moved)


@pytest.mark.parametrize(
    "other",
    [
        {"weights": (("accuracy", 0.5),)},
        {"weights": (("exact", 1.0),)},
        {"moved": 1e-6},
        {"steps": 2},
        {"seed": 1},
    ],
    ids=str,
)
def test_an_arm_that_differs_in_anything_is_trained(reinforce, other):
    run, trained = reinforce
    run("first")
    run("other", **other)
    assert len(trained) == 2


def test_other_records_are_another_checkpoint(data, tmp_path):
    """The same touch may come with other pictures: the index knows, by its configuration and its shards' sizes."""
    shutil.copytree(data.store.path, tmp_path / "other")
    index = tmp_path / "other" / "index.json"
    assert RecordStore(tmp_path / "other").digest == data.store.digest
    tree = json.loads(index.read_text())
    tree["meta"]["config_hash"] += "0"
    index.write_text(json.dumps(tree))
    assert RecordStore(tmp_path / "other").digest != data.store.digest


def test_every_value_and_number_counts():
    x = {"x": np.arange(3.0)}
    same = fingerprint({"config": CONFIG}, x, "s")
    assert same == fingerprint({"config": CONFIG}, {"x": np.arange(3.0)}, "s")
    others = (
        fingerprint({"config": CONFIG, "seed": 1}, x, "s"),
        fingerprint({"config": CONFIG}, {"x": np.array([0, 1, 2 + 1e-9])}, "s"),
        fingerprint({"config": CONFIG}, {"x": np.arange(3)}, "s"),
        fingerprint({"config": CONFIG}, {"y": np.arange(3.0)}, "s"),
        fingerprint({"config": CONFIG}, x, "other"),
    )
    assert len({same, *others}) == 6


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


def test_what_was_compiled_quickly_is_another_checkpoint():
    """Its numbers differ by rounding, and a report must not show them as those of a program that was compiled well."""
    name = "jax_disable_most_optimizations"
    before, found = jax.config.values[name], []
    try:
        for quickly in (False, True):
            jax.config.update(name, quickly)
            found.append(fingerprint({}, {}, "source"))
    finally:
        jax.config.update(name, before)
    assert found[0] != found[1]
