"""The ablations, shrunk: arms and pairs, `ablation_ordinal` from generated scenes to the report and again from its
answers, and each arm trained by its own algorithm."""

import dataclasses
import shutil

import pytest

from experiments.core.artifacts import read_json
from experiments.core.context import read_metrics
from experiments.core.loops import STEPPING, WAITING
from experiments.paper import (
    ablation_consistency,
    ablation_cumulative,
    ablation_format,
    ablation_grounding,
    ablation_leave_one_out,
    ablation_ordinal,
    ablation_tactile_use,
)
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.rl.config import TactileUse

PLAIN = (ablation_consistency, ablation_format, ablation_grounding)
MODULES = (*PLAIN, ablation_cumulative, ablation_leave_one_out, ablation_ordinal, ablation_tactile_use)
ARMS = ["sft", "zero_one", "ordinal", "debiased"]
BASELINES = ["tactile_blind", "constant", "constant_joint", "constant_middle", "force_only"]


@pytest.mark.parametrize("module", MODULES)
def test_arms_and_pairs_fit_together(module):
    ablation = module.ABLATION
    assert {arm for pair in ablation.pairs for arm in pair} <= {*ablation.arms, "sft"}
    assert {*ablation.algorithms, ablation.example} <= {*ablation.arms, ""}
    assert {variant.of for variant in ablation.variants.values()} <= {*ablation.arms, "sft"}
    assert module.EXPERIMENT.name == module.__name__.rpartition(".")[2]


def run(module, home, cache_dir, steps):
    config = dataclasses.replace(tiny.STUDY, grpo_steps=7)
    return run_shrunk(module, config, home, "--cache-dir", str(cache_dir), "--grpo-steps", str(steps))


@pytest.fixture(scope="module")
def home(tmp_path_factory, cache_dir):
    """Runs of the shrunk `ablation_ordinal`, one of them finished."""
    home = tmp_path_factory.mktemp("runs")
    run(ablation_ordinal, home, cache_dir, 2)
    return home


@pytest.fixture
def directory(home):
    return (home / "ablation_ordinal" / "latest").resolve()


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
    assert results["config"]["grpo_steps"] == 2
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in (*ARMS, *BASELINES))


def test_comparisons_pair_arms_by_seed_and_baselines_by_object(directory):
    results = read_json(directory / "results.json")
    both, pairs = results["arms"] | results["baselines"], {over: set() for over in ("seeds", "objects")}
    for c in results["comparisons"]:
        pairs[c["over"]].add((c["arm"], c["against"]))
        if c["metric"] != "reward_trained":
            a, b = (both[c[side]][c["metric"]]["mean"] for side in ("arm", "against"))
            assert c["difference"] == pytest.approx(a - b, abs=1e-6)
    arms = {("ordinal", "zero_one"), ("debiased", "zero_one"), ("debiased", "ordinal")}
    assert pairs["seeds"] == arms | {(arm, "sft") for arm in ARMS[1:]}
    assert pairs["objects"] == {("sft", name) for name in BASELINES}
    own = [c for c in results["comparisons"] if c["metric"] == "reward_trained"]
    assert [(c["arm"], c["against"]) for c in own] == [(arm, "sft") for arm in ARMS[1:]]
    assert len(results["verdict"]) == 1 + len(arms) + len(ARMS[1:])


def test_results_tell_data_and_the_time_of_every_stage(directory):
    results = read_json(directory / "results.json")
    assert results["data"]["source"] == "generated"
    assert results["data"]["test_objects"] == 5
    stages = {f"{stage}/{seed}" for stage in ("sft", "blind", *(f"grpo/{arm}" for arm in ARMS[1:])) for seed in (0, 1)}
    asked = {f"ask/{name}/{seed}" for name in (*ARMS, "tactile_blind") for seed in (0, 1)}
    inside = {f"{what}/{stage}" for what in (STEPPING, WAITING) for stage in stages}
    assert set(results["timing"]) - inside == stages | asked | {"data", "total"}
    assert results["timing"]["total"] >= sum(results["timing"][s] for s in stages | asked)
    logged = [line["stage"] for line in read_metrics(directory)]
    assert (logged.count("sft/0"), logged.count("grpo/ordinal/1")) == (3, 2)


def test_a_run_without_results_goes_on_from_the_answers(home, cache_dir, directory):
    answers = sorted((directory / "answers").glob("*.npz"))
    assert len(answers) == 2 * (len(ARMS) + 1)
    before = [path.stat().st_mtime_ns for path in answers]
    first, log = read_json(directory / "results.json"), (directory / "metrics.jsonl").read_bytes()
    (directory / "results.json").unlink()
    shutil.rmtree(directory / "checkpoints")  # nothing is trained again, so nothing of them is needed
    assert run(ablation_ordinal, home, cache_dir, 2) == directory
    assert [path.stat().st_mtime_ns for path in sorted((directory / "answers").glob("*.npz"))] == before
    assert (directory / "metrics.jsonl").read_bytes() == log
    second = read_json(directory / "results.json")
    assert all(second[part] == first[part] for part in ("arms", "baselines", "comparisons", "data"))


@pytest.mark.slow
def test_every_arm_of_tactile_use_is_trained_by_its_own_algorithm(tmp_path, cache_dir):
    directory = run(ablation_tactile_use, tmp_path, cache_dir, 1)
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == ["sft", "none", "literal", "recommended"]
    assert results["settings"]["preset of literal"].startswith("paper with tactile_use=literal")
    lines = {line["stage"]: line for line in read_metrics(directory) if line["stage"].endswith("/0")}
    assert "touch_score" not in lines["grpo/none/0"]
    for arm in (TactileUse.LITERAL, TactileUse.RECOMMENDED):
        assert {"touch_score", "control_drop", "control_noise", "control_order"} <= set(lines[f"grpo/{arm.value}/0"])


@pytest.mark.slow
@pytest.mark.parametrize("module", PLAIN)
def test_every_ablation_runs(module, tmp_path, cache_dir):
    results = read_json(run(module, tmp_path, cache_dir, 1) / "results.json")
    assert list(results["arms"]) == ["sft", *module.ABLATION.arms]
