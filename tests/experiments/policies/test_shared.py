"""A checkpoint that one experiment made is found by the next, and by none that differs in anything that matters."""

import ast
import dataclasses
import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.policies import shared
from experiments.policies.shared import LATER, USED, fingerprint, shared_sft, source_digest
from experiments.policies.stages import SFTConfig
from experiments.running.context import Context
from experiments.running.runs import ROOT
from sensors_io.records import RecordStore

CONFIG = SFTConfig(steps=2, batch_size=4)


@pytest.fixture(scope="module")
def evidence(data):
    """Evidence that says nothing."""
    return np.zeros((len(data.store), len(data.clip.sensors), data.label.shape[1], 9), np.float32)


@pytest.fixture(scope="module")
def make(assembly, data, evidence, tmp_path_factory):
    """SFT of a run by its name; all runs have one cache."""
    home = tmp_path_factory.mktemp("shared")

    def run(name: str, config: SFTConfig = CONFIG, *, seed: int = 0) -> tuple[Path, object]:
        (home / name).mkdir(exist_ok=True)
        context = Context(home / name, home / "cache", Console(quiet=True))
        try:
            return home / name, shared_sft(assembly, data, evidence, config, context, seed=seed, stage=f"sft/{seed}")
        finally:
            context.close()

    return run


@pytest.fixture(scope="module")
def first(make):
    return make("first")


def test_another_run_finds_the_parameters_and_the_log(make, first, monkeypatch):
    monkeypatch.setattr(shared, "run_sft", None)  # training would fail
    directory, params = make("second")
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


def test_another_setting_is_another_checkpoint(make, first, monkeypatch):
    monkeypatch.setattr(shared, "run_sft", None)
    for config, seed in ((dataclasses.replace(CONFIG, steps=3), 0), (CONFIG, 1)):
        with pytest.raises(TypeError):
            make("other", config, seed=seed)


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
    same = fingerprint({"config": CONFIG}, x)
    assert same == fingerprint({"config": CONFIG}, {"x": np.arange(3.0)})
    others = (
        fingerprint({"config": CONFIG, "seed": 1}, x),
        fingerprint({"config": CONFIG}, {"x": np.array([0, 1, 2 + 1e-9])}),
        fingerprint({"config": CONFIG}, {"x": np.arange(3)}),
        fingerprint({"config": CONFIG}, {"y": np.arange(3.0)}),
    )
    assert len({same, *others}) == 5


def test_the_source_of_rewards_does_not_count_and_that_of_models_does(tmp_path):
    for name in ("touchr1_jax/models/lm.py", "touchr1_jax/rewards/mine.py", "touchr1_jax/rl/losses.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("one")
    digest = lambda: source_digest.__wrapped__(tmp_path)
    start = digest()
    (tmp_path / "touchr1_jax/rewards/mine.py").write_text("two")
    assert digest() == start
    for name in ("touchr1_jax/models/lm.py", "touchr1_jax/rl/losses.py"):
        before = digest()
        (tmp_path / name).write_text("two")
        assert digest() != before


def test_what_sft_is_built_on_counts():
    """No file that counts imports one that does not, but for `experiments.policies`, whose rewards come after SFT."""
    later = tuple(folder.replace("/", ".") for folder in LATER)
    used = {name.removesuffix(".py").replace("/", ".") for name in USED}
    for package in ("touchr1_jax", "sensors_io"):
        for path in (ROOT / package).rglob("*.py"):
            name = path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
            if name.startswith(later) or path.name == "__main__.py":
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(later):
                    assert node.module in used, f"{name} imports {node.module}"
