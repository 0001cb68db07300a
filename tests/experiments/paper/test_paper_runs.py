"""The paper's experiments, shrunk: `ablation_ordinal` from scenes to the report and again from its answers, each arm by
its own algorithm, every table with the paper's rows; scales."""

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
    conflict,
    main_table,
    presets,
    qualitative,
    scaling,
)
from experiments.paper.components import BASE, COMPONENTS
from experiments.study.policies import find_policy
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.rl.config import TactileUse

PLAIN = (ablation_consistency, ablation_format, ablation_grounding)
MODULES = (*PLAIN, ablation_cumulative, ablation_leave_one_out, ablation_ordinal, ablation_tactile_use)
CONTROLS = ["sft", "sft_continued"]
TRAINED = ["zero_one", "ordinal", "debiased"]
ARMS = [*CONTROLS, *TRAINED]
BASELINES = ["tactile_blind", "constant", "constant_joint", "constant_middle", "force_only"]


@pytest.mark.parametrize("module", MODULES)
def test_arms_and_pairs_fit_together(module):
    ablation = module.ABLATION
    assert {arm for pair in ablation.pairs for arm in pair} <= {*ablation.arms, "sft"}
    assert {*ablation.algorithms, ablation.example} <= {*ablation.arms, ""}
    assert {variant.of for variant in ablation.variants.values()} <= {*ablation.arms, "sft"}
    assert module.EXPERIMENT.name == module.__name__.rpartition(".")[2]


def run_ablation(module, home, cache_dir, steps):
    config = dataclasses.replace(tiny.STUDY, grpo_steps=7, samples=2)
    return run_shrunk(module, config, home, "--cache-dir", str(cache_dir), "--grpo-steps", str(steps))


@pytest.fixture(scope="module")
def home(tmp_path_factory, cache_dir):
    """Runs of the shrunk `ablation_ordinal`, one of them finished."""
    home = tmp_path_factory.mktemp("runs")
    run_ablation(ablation_ordinal, home, cache_dir, 2)
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
    (sampled,) = (table for table in results["tables"] if table["title"] == "Sampled answers")
    assert [column["name"] for column in sampled["columns"]] == ["policy", "greedy", "pass@1", "pass@2", "maj@2", "ECE"]
    assert [row[0] for row in sampled["rows"]] == [*ARMS, "tactile_blind"]
    assert (directory / "plots" / "calibration.svg").exists()


def test_every_policy_of_every_seed_is_saved_and_found(directory, home):
    saved = {str(path.relative_to(directory / "policies")) for path in (directory / "policies").glob("*/*")}
    assert saved == {f"{name}/{seed}" for name in ARMS for seed in (0, 1)}
    found = find_policy("ablation_ordinal/latest/ordinal/1", home)
    assert found.saved.notes["name"] == "ablation_ordinal, ordinal, seed 1"


def test_comparisons_pair_arms_by_seed_and_baselines_by_object(directory):
    results = read_json(directory / "results.json")
    both, pairs = results["arms"] | results["baselines"], {over: set() for over in ("seeds", "objects")}
    for c in results["comparisons"]:
        pairs[c["over"]].add((c["arm"], c["against"]))
        if c["metric"] != "reward_trained":
            a, b = (both[c[side]][c["metric"]]["mean"] for side in ("arm", "against"))
            assert c["difference"] == pytest.approx(a - b, abs=1e-6)
    arms = {("ordinal", "zero_one"), ("debiased", "zero_one"), ("debiased", "ordinal")}
    assert pairs["seeds"] == arms | {(arm, control) for arm in TRAINED for control in CONTROLS}
    controlled = {c["metric"] for c in results["comparisons"] if c["against"] == "sft_continued"}
    assert {"acc", "omae", "h_acc", "mat_acc", "csc"} <= controlled
    assert pairs["objects"] == {("sft", name) for name in BASELINES}
    own = [c for c in results["comparisons"] if c["metric"] == "reward_trained"]
    assert [(c["arm"], c["against"]) for c in own] == [(arm, "sft") for arm in TRAINED]
    assert len(results["verdict"]) == 1 + len(arms) + 2 * len(TRAINED)


def test_results_tell_data_and_the_time_of_every_stage(directory):
    results = read_json(directory / "results.json")
    assert results["data"]["source"] == "generated"
    assert results["data"]["test_objects"] == 5
    phases = (
        "encoders",
        "sft",
        "blind",
        *(f"decoder/{name}" for name in CONTROLS),
        *(f"grpo/{arm}" for arm in TRAINED),
    )
    stages = {f"{phase}/{seed}" for phase in phases for seed in (0, 1)}
    asked = {f"ask/{name}/{seed}" for name in (*ARMS, "tactile_blind") for seed in (0, 1)}
    inside = {f"{what}/{stage}" for what in (STEPPING, WAITING) for stage in stages}
    assert set(results["timing"]) - inside == stages | asked | {"data", "total"}
    assert results["timing"]["total"] >= sum(results["timing"][s] for s in stages | asked)
    logged = [line["stage"] for line in read_metrics(directory)]
    assert (logged.count("sft/0"), logged.count("decoder/sft/0"), logged.count("grpo/ordinal/1")) == (3, 2, 2)
    assert all("held_out" in line for line in read_metrics(directory) if line["stage"].startswith("decoder/"))


def test_a_run_without_results_goes_on_from_the_answers(home, cache_dir, directory):
    answers = sorted((directory / "answers").glob("*.npz"))
    assert len(answers) == 2 * (len(ARMS) + 1)
    before = [path.stat().st_mtime_ns for path in answers]
    first, log = read_json(directory / "results.json"), (directory / "metrics.jsonl").read_bytes()
    (directory / "results.json").unlink()
    shutil.rmtree(directory / "checkpoints")  # nothing is trained again, so nothing of them is needed
    assert run_ablation(ablation_ordinal, home, cache_dir, 2) == directory
    assert [path.stat().st_mtime_ns for path in sorted((directory / "answers").glob("*.npz"))] == before
    assert (directory / "metrics.jsonl").read_bytes() == log
    second = read_json(directory / "results.json")
    assert all(second[part] == first[part] for part in ("arms", "baselines", "comparisons", "data"))


def test_damaged_answers_are_made_again(home, cache_dir, directory, capsys):
    first, (path, *_) = read_json(directory / "results.json"), sorted((directory / "answers").glob("*.npz"))
    path.write_bytes(path.read_bytes()[:-40])
    (directory / "results.json").unlink()
    assert run_ablation(ablation_ordinal, home, cache_dir, 2) == directory
    assert f"{path.name} is damaged" in capsys.readouterr().out.replace("\n", "")
    second = read_json(directory / "results.json")
    assert all(second[part] == first[part] for part in ("arms", "baselines", "comparisons"))


@pytest.mark.slow
def test_every_arm_of_tactile_use_is_trained_by_its_own_algorithm(tmp_path, cache_dir):
    directory = run_ablation(ablation_tactile_use, tmp_path, cache_dir, 1)
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == [*CONTROLS, "none", "literal", "recommended"]
    assert results["settings"]["preset of literal"].startswith("paper with anchor=1.0, tactile_use=literal")
    lines = {line["stage"]: line for line in read_metrics(directory) if line["stage"].endswith("/0")}
    assert "touch_score" not in lines["grpo/none/0"]
    for arm in (TactileUse.LITERAL, TactileUse.RECOMMENDED):
        assert {"touch_score", "control_drop", "control_noise", "control_order"} <= set(lines[f"grpo/{arm.value}/0"])


@pytest.mark.slow
@pytest.mark.parametrize("module", PLAIN)
def test_every_ablation_runs(module, tmp_path, cache_dir):
    results = read_json(run_ablation(module, tmp_path, cache_dir, 1) / "results.json")
    assert list(results["arms"]) == [*CONTROLS, *module.ABLATION.arms]


STUDY = dataclasses.replace(tiny.STUDY, grpo_steps=1, share=False)
FEW = Quota(identify=8, scale=0, compose=3, compare=2, order=0, one_sensor=8, conflict=0)


@pytest.fixture
def run(tmp_path, cache_dir):
    """Runs an experiment shrunk; its directory and results."""

    def once(module, config):
        directory = run_shrunk(module, config, tmp_path, "--cache-dir", str(cache_dir))
        return directory, read_json(directory / "results.json")

    return once


@pytest.mark.slow
def test_the_main_table_has_every_baseline(run):
    _, results = run(main_table, main_table.MainConfig(study=STUDY, quota=FEW))
    assert list(results["arms"]) == [*CONTROLS, "full"]
    assert set(results["baselines"]) == {*main_table.TOUCHLESS, "encoder_probe", "nearest_fields"}
    for row in {**results["arms"], **results["baselines"]}.values():
        assert {"h_acc", "omae", "l2_em", "csc"} <= set(row)  # a single pair has no interval
    comparison, pooled, reliability, seconds, kinds, differences = (table["rows"] for table in results["tables"])
    assert comparison[-1][1:5] == [76.8, 68.4, 65.1, 74.6]
    assert [row[2] for row in kinds] == [8, 3, 2, 8]
    assert [row[0] for row in pooled][:3] == [*CONTROLS, "full"]
    assert {row[0].split(":")[0] for row in reliability} == {*CONTROLS, "full"}
    assert {row[0] for row in seconds} >= {"sft_continued", "full"}
    compared = {(c["arm"], c["against"]) for c in results["comparisons"]}
    assert compared == {("full", "sft"), ("full", "sft_continued"), ("sft", "encoder_probe")}
    assert len(differences) > 3
    assert results["requirements"][0]["met"]


@pytest.mark.slow
def test_the_ladder_has_every_arm_and_the_papers_rows(run):
    directory, results = run(ablation_cumulative, STUDY)
    names = [c.added.name for c in COMPONENTS]
    assert list(results["arms"]) == [*CONTROLS, *names[1:]]
    assert "untrained" in results["baselines"]
    ladder, effects, attributes, pooled, reliability, *_ = (table["rows"] for table in results["tables"])
    assert [row[0] for row in ladder] == [BASE, *names] == [row[0] for row in attributes]
    assert ladder[3][3] == 0.31
    assert len(effects) == 3 * len(names)
    assert {row[7] for row in effects} <= {"reproduced", "opposite", "undecided", "not in the paper"}
    assert [row[0] for row in pooled] == [*CONTROLS, *names[1:]]
    assert len(reliability) == 9 * (len(names) + 1)
    assert len(results["requirements"]) == 3
    assert (directory / "plots" / "changes.svg").exists()


@pytest.mark.slow
def test_every_component_is_left_out(run):
    _, results = run(ablation_leave_one_out, STUDY)
    names = [c.omitted.name for c in COMPONENTS]
    assert set(results["arms"]) == {*CONTROLS, "full", *names}
    assert len(results["tables"][0]["rows"]) == 3 * len(names)


@pytest.mark.slow
def test_conflict_evaluates_with_and_without_touch(run):
    directory, results = run(conflict, STUDY)
    contrasts, gains, *_ = (table["rows"] for table in results["tables"])
    assert contrasts[0][0] == "all questions"
    assert gains[0][0] == "full, all"
    assert results["requirements"][-1]["name"] == "least gain from touch, all questions"
    assert {(c["arm"], c["against"]) for c in results["comparisons"]} == {("full", "sft_continued")}
    assert len(list((directory / "answers").glob("*-under-*.npz"))) == 2 * 2 * 4


@pytest.mark.slow
def test_three_sizes_are_trained_and_timed(run):
    wide = dataclasses.replace(tiny.MODEL, tactile=dataclasses.replace(tiny.MODEL.tactile, width=32))
    study = dataclasses.replace(STUDY, grpo_steps=2)  # the first step of a stage is not timed
    directory, results = run(
        scaling, scaling.ScalingConfig(study=study, small=tiny.MODEL, large=wide, quota=FEW, rounds=1)
    )
    assert list(results["arms"]) == ["small", "default", "large"]
    sizes, trends, comparison, *_ = (table["rows"] for table in results["tables"])
    counts = [row[1] for row in sizes]
    assert counts[0] == counts[1] < counts[2]
    assert all(value > 0 for row in sizes for value in row[3:])
    assert "full model: OMAE" in [row[0] for row in trends]
    assert [row[0] for row in comparison][3:] == [f"Touch-R1-{n}B (paper)" for n in (3, 7, 14)]
    assert (comparison[4][1], comparison[4][5], set(comparison[5][1:])) == (76.8, 0.24, {None})
    stages = {line["stage"] for line in read_metrics(directory)}
    assert {"sft/small/0", "grpo/large/1", "blind/default/1"} <= stages


@pytest.mark.slow
def test_the_browser_shows_cases_and_items(run):
    study = dataclasses.replace(STUDY, seeds=1)
    directory, results = run(qualitative, qualitative.QualitativeConfig(study=study, quota=FEW))
    common = results["tables"][0]["rows"]
    assert len(common) == 10
    assert all(row[1] <= row[2] for row in common)
    assert "Tier 3, compare: " in (directory / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "module", [ablation_cumulative, ablation_leave_one_out, conflict, main_table, qualitative, scaling]
)
def test_a_large_scale_needs_a_machine(module):
    experiment = module.EXPERIMENT
    large = set(experiment.scales) - {"smoke"}
    assert large >= {"gpu"}
    assert experiment.needs == {name: presets.NEEDS[name] for name in large}


def test_the_papers_scale_has_the_papers_numbers():
    study = presets.PAPER
    assert (study.scenes.objects, study.scenes.sequences, study.scenes.image_px) == (1000, 14_700, 448)
    assert study.scenes.split_shares[2] * study.scenes.objects == 200
    assert (study.model.frames, study.model.image_px, study.grpo.group) == (8, 448, 8)
    decoder = study.model.decoder
    assert (decoder.hidden_size, decoder.num_layers, decoder.mrope_section) == (3584, 28, (16, 24, 24))
    asked = study.sft.steps * study.sft.batch_size * study.sft.questions
    assert 240_000 - 256 < asked <= 240_000
    assert 120_000 - 128 < study.grpo_steps * study.grpo.prompts <= 120_000
