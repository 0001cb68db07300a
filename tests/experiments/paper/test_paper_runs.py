"""`ablation_ordinal` with two arms, shrunk: from scenes to the report and again from its answers; large scales."""

import dataclasses
import importlib
import shutil
from types import SimpleNamespace

import pytest

from experiments.core.artifacts import read_json
from experiments.core.loops import STEPPING, WAITING
from experiments.core.metric_log import read_metrics
from experiments.paper import ablation_ordinal, presets
from experiments.study.ablation import ablation_experiment
from experiments.study.policies import find_policy
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk

CONTROLS = ["sft", "sft_continued"]
TRAINED = ["zero_one", "ordinal"]
ARMS = [*CONTROLS, *TRAINED]
BASELINES = ["tactile_blind", "constant", "constant_joint", "constant_middle", "force_only"]
TWO = dataclasses.replace(
    ablation_ordinal.ABLATION,
    arms={name: ablation_ordinal.ABLATION.arms[name] for name in TRAINED},
    pairs=(("ordinal", "zero_one"),),
)
SMALL = SimpleNamespace(EXPERIMENT=ablation_experiment("ablation_ordinal", TWO), __doc__=ablation_ordinal.__doc__)


@pytest.mark.parametrize(
    "name", ["consistency", "cumulative", "format", "grounding", "leave_one_out", "ordinal", "tactile_use"]
)
def test_arms_and_pairs_fit_together(name):
    ablation = importlib.import_module(f"experiments.paper.ablation_{name}").ABLATION
    assert {arm for pair in ablation.pairs for arm in pair} <= {*ablation.arms, "sft"}
    assert {*ablation.algorithms, ablation.example} <= {*ablation.arms, ""}
    assert {variant.of for variant in ablation.variants.values()} <= {*ablation.arms, "sft"}


def run_ablation(home, cache_dir):
    config = dataclasses.replace(tiny.STUDY, grpo_steps=7, samples=2)
    return run_shrunk(SMALL, config, home, "--cache-dir", str(cache_dir), "--grpo-steps", "2")


@pytest.fixture(scope="module")
def home(tmp_path_factory, cache_dir):
    """Runs, one of them finished."""
    home = tmp_path_factory.mktemp("runs")
    run_ablation(home, cache_dir)
    return home


@pytest.fixture
def directory(home):
    return (home / "ablation_ordinal" / "latest").resolve()


@pytest.fixture
def results(directory):
    return read_json(directory / "results.json")


@pytest.mark.long
def test_results_and_policies_of_every_arm_and_baseline_are_kept(results, directory, home):
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
    assert (directory / "plots" / "calibration.svg").exists()
    saved = {str(path.relative_to(directory / "policies")) for path in (directory / "policies").glob("*/*")}
    assert saved == {f"{name}/{seed}" for name in ARMS for seed in (0, 1)}
    found = find_policy("ablation_ordinal/latest/ordinal/1", home)
    assert found.saved.notes["name"] == "ablation_ordinal, ordinal, seed 1"


@pytest.mark.long
def test_comparisons_pair_arms_by_seed_and_baselines_by_object(results):
    both, pairs = results["arms"] | results["baselines"], {over: set() for over in ("seeds", "objects")}
    for c in results["comparisons"]:
        pairs[c["over"]].add((c["arm"], c["against"]))
        if c["metric"] != "reward_trained":
            a, b = (both[c[side]][c["metric"]]["mean"] for side in ("arm", "against"))
            assert c["difference"] == pytest.approx(a - b, abs=1e-6)
    assert pairs["seeds"] == {*TWO.pairs, *((arm, control) for arm in TRAINED for control in CONTROLS)}
    controlled = {c["metric"] for c in results["comparisons"] if c["against"] == "sft_continued"}
    assert {"acc", "omae", "h_acc", "mat_acc", "csc"} <= controlled
    assert pairs["objects"] == {("sft", name) for name in BASELINES}
    own = [c for c in results["comparisons"] if c["metric"] == "reward_trained"]
    assert [(c["arm"], c["against"]) for c in own] == [(arm, "sft") for arm in TRAINED]


@pytest.mark.long
def test_results_tell_data_and_the_time_of_every_stage(results, directory):
    assert results["data"]["source"] == "generated"
    assert results["data"]["test_objects"] == 5
    phases = [f"decoder/{name}" for name in CONTROLS] + [f"grpo/{arm}" for arm in TRAINED]
    stages = {f"{phase}/{seed}" for phase in ("encoders", "sft", "blind", *phases) for seed in (0, 1)}
    asked = {f"ask/{name}/{seed}" for name in (*ARMS, "tactile_blind") for seed in (0, 1)}
    inside = {f"{what}/{stage}" for what in (STEPPING, WAITING) for stage in stages}
    assert set(results["timing"]) - inside == stages | asked | {"data", "total"}
    for seed in ("0", "1"):  # which may be trained at the same time
        own = [stage for stage in stages | asked if stage.endswith(f"/{seed}")]
        assert results["timing"]["total"] >= sum(results["timing"][stage] for stage in own)
    logged = [line["stage"] for line in read_metrics(directory)]
    assert (logged.count("sft/0"), logged.count("decoder/sft/0"), logged.count("grpo/ordinal/1")) == (3, 2, 2)
    assert all("held_out" in line for line in read_metrics(directory) if line["stage"].startswith("decoder/"))


@pytest.mark.long
def test_a_run_without_results_goes_on_from_the_answers_that_are_whole(results, home, cache_dir, directory, capsys):
    damaged, *answers = sorted((directory / "answers").glob("*.npz"))
    assert len(answers) == 2 * (len(ARMS) + 1) - 1
    damaged.write_bytes(damaged.read_bytes()[:-40])
    before = [path.stat().st_mtime_ns for path in answers]
    log = (directory / "metrics.jsonl").read_bytes()
    (directory / "results.json").unlink()
    shutil.rmtree(directory / "checkpoints")  # nothing is trained again, so nothing of them is needed
    assert run_ablation(home, cache_dir) == directory
    assert f"{damaged.name} is damaged" in capsys.readouterr().out.replace("\n", "")
    assert [path.stat().st_mtime_ns for path in answers] == before
    assert (directory / "metrics.jsonl").read_bytes() == log
    second = read_json(directory / "results.json")
    assert all(second[part] == results[part] for part in ("arms", "baselines", "comparisons", "data"))


@pytest.mark.parametrize(
    "name", ["ablation_cumulative", "ablation_leave_one_out", "conflict", "main_table", "qualitative", "scaling"]
)
def test_a_large_scale_needs_a_machine(name):
    experiment = importlib.import_module(f"experiments.paper.{name}").EXPERIMENT
    large = set(experiment.scales) - {"smoke"}
    assert large >= {"gpu"}
    assert experiment.needs == {name: presets.NEEDS[name] for name in large}
