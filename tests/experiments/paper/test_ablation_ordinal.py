"""The whole experiment, shrunk: from generated scenes to the report, and again from what the first run left."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from experiments.core.artifacts import read_json
from experiments.core.loops import STEPPING, WAITING
from experiments.core.runner import main
from experiments.paper import ablation_ordinal
from tests.experiments import tiny

ARMS = ["sft", "zero_one", "ordinal", "debiased"]
BASELINES = ["tactile_blind", "constant", "constant_joint", "constant_middle", "force_only"]


def run(home: Path, cache_dir: Path) -> Path:
    """The experiment on the command line; returns its one run directory."""
    paths = ["--runs-dir", str(home), "--cache-dir", str(cache_dir)]
    assert main(["ablation_ordinal", *paths, "--grpo-steps", "2"]) == 0
    (directory,) = (p for p in (home / "ablation_ordinal").iterdir() if not p.is_symlink())
    return directory


@pytest.fixture(scope="module")
def home(tmp_path_factory, cache_dir):
    """Runs of the shrunk experiment, one of them finished."""
    home = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        small = dataclasses.replace(ablation_ordinal.EXPERIMENT, config=dataclasses.replace(tiny.STUDY, grpo_steps=7))
        patch.setattr(ablation_ordinal, "EXPERIMENT", small)
        run(home, cache_dir)
        yield home


@pytest.fixture
def directory(home):
    (directory,) = (p for p in (home / "ablation_ordinal").iterdir() if not p.is_symlink())
    return directory


def test_results_hold_every_arm_and_baseline(directory):
    results = read_json(directory / "results.json")
    assert (list(results["arms"]), list(results["baselines"])) == (ARMS, BASELINES)
    for name, row in {**results["arms"], **results["baselines"]}.items():
        seeds = 2 if name in (*ARMS, "tactile_blind") else 1
        assert {"acc", "omae", "middle_rate", "parse_rate", "reward", "h_bacc"} <= set(row)
        assert all(len(estimate["per_seed"]) == seeds for estimate in row.values()), name
        assert row["acc"]["ci95"][0] <= row["acc"]["mean"] <= row["acc"]["ci95"][1]
    assert all("csc" in results["arms"][arm] for arm in ARMS)
    assert "csc" not in results["baselines"]["tactile_blind"]
    assert results["baselines"]["constant_middle"]["middle_rate"]["mean"] == 100
    assert results["settings"]["preset"].startswith("paper with")
    assert results["config"]["grpo_steps"] == 2


def test_comparisons_pair_arms_by_seed_and_baselines_by_object(directory):
    results = read_json(directory / "results.json")
    pairs = {over: set() for over in ("seeds", "objects")}
    for c in results["comparisons"]:
        pairs[c["over"]].add((c["arm"], c["against"]))
        if c["metric"] != "reward_trained":
            both = results["arms"] | results["baselines"]
            means = both[c["arm"]][c["metric"]]["mean"], both[c["against"]][c["metric"]]["mean"]
            assert c["difference"] == pytest.approx(means[0] - means[1], abs=1e-6)
    arms = {("ordinal", "zero_one"), ("debiased", "zero_one"), ("debiased", "ordinal")}
    assert pairs["seeds"] == arms | {(arm, "sft") for arm in ARMS[1:]}
    assert pairs["objects"] == {("sft", name) for name in BASELINES}
    assert len(results["verdict"]) == 5


def test_data_and_timing_are_told(directory):
    results = read_json(directory / "results.json")
    assert results["data"]["source"] == "generated"
    assert results["data"]["test_objects"] == 5
    stages = {f"{stage}/{seed}" for stage in ("sft", "blind", *(f"grpo/{arm}" for arm in ARMS[1:])) for seed in (0, 1)}
    asked = {f"ask/{name}/{seed}" for name in (*ARMS, "tactile_blind") for seed in (0, 1)}
    inside = {f"{what}/{stage}" for what in (STEPPING, WAITING) for stage in stages}
    assert set(results["timing"]) - inside == stages | asked | {"data", "total"}
    assert results["timing"]["total"] >= sum(results["timing"][s] for s in stages | asked)


def test_the_report_names_every_arm(directory):
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in (*ARMS, *BASELINES))
    assert "paper with" in page


def test_an_arm_starts_from_its_sft_and_asks_the_same_questions_in_the_same_order(directory):
    lines = (directory / "metrics.jsonl").read_text().splitlines()
    assert sum('"sft/0"' in line for line in lines) == 3
    assert sum('"grpo/ordinal/1"' in line for line in lines) == 2


def test_a_run_without_results_goes_on_from_the_answers(home, cache_dir, directory):
    answers = sorted((directory / "answers").glob("*.npz"))
    assert len(answers) == 2 * (len(ARMS) + 1)
    before = [(path.name, path.stat().st_mtime_ns) for path in answers]
    first, log = read_json(directory / "results.json"), (directory / "metrics.jsonl").read_bytes()
    (directory / "results.json").unlink()
    shutil.rmtree(directory / "checkpoints")  # nothing is trained again, so nothing of them is needed
    assert run(home, cache_dir) == directory
    assert [(path.name, path.stat().st_mtime_ns) for path in sorted((directory / "answers").glob("*.npz"))] == before
    assert (directory / "metrics.jsonl").read_bytes() == log
    second = read_json(directory / "results.json")
    for part in ("arms", "baselines", "comparisons", "data"):
        assert second[part] == first[part]
