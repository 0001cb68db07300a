"""The ablations by configuration, shrunk: every arm trains under its own algorithm and stands in the report."""

import dataclasses
from pathlib import Path

import pytest

from experiments.core.artifacts import read_json
from experiments.core.context import read_metrics
from experiments.paper import ablation_consistency, ablation_format, ablation_grounding, ablation_tactile_use
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.rl.config import TactileUse

MODULES = {
    "ablation_consistency": ablation_consistency,
    "ablation_format": ablation_format,
    "ablation_grounding": ablation_grounding,
    "ablation_tactile_use": ablation_tactile_use,
}


def run(name: str, home: Path, cache_dir: Path) -> Path:
    """One shrunk ablation on the command line; its run directory."""
    config = dataclasses.replace(tiny.STUDY, grpo_steps=1)
    return run_shrunk(MODULES[name], config, home, "--cache-dir", str(cache_dir))


@pytest.mark.parametrize("name", MODULES)
def test_arms_and_pairs_fit_together(name):
    ablation = MODULES[name].ABLATION
    assert {arm for pair in ablation.pairs for arm in pair} <= set(ablation.arms)
    assert set(ablation.algorithms) <= set(ablation.arms)
    assert MODULES[name].EXPERIMENT.name == name


@pytest.mark.slow
def test_every_arm_of_tactile_use_is_trained_by_its_own_algorithm(tmp_path, cache_dir):
    directory = run("ablation_tactile_use", tmp_path, cache_dir)
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == ["sft", "none", "literal", "recommended"]
    assert results["settings"]["preset of literal"].startswith("paper with tactile_use=literal")
    lines = {line["stage"]: line for line in read_metrics(directory) if line["stage"].endswith("/0")}
    assert "touch_score" not in lines["grpo/none/0"]
    for arm in (TactileUse.LITERAL, TactileUse.RECOMMENDED):
        line = lines[f"grpo/{arm.value}/0"]
        assert {"touch_score", "control_drop", "control_noise", "control_order"} <= set(line)
    assert {(c["arm"], c["against"]) for c in results["comparisons"]} >= {("literal", "none"), ("recommended", "sft")}
    assert "recommended against literal" in " ".join(results["verdict"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ablation_consistency", "ablation_format", "ablation_grounding"])
def test_every_ablation_runs(name, tmp_path, cache_dir):
    results = read_json(run(name, tmp_path, cache_dir) / "results.json")
    assert list(results["arms"]) == ["sft", *MODULES[name].ABLATION.arms]
