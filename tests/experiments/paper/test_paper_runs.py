"""The paper's tables, shrunk: every arm and baseline answers and stands in the report with the paper's rows; scales."""

import dataclasses

import pytest

from experiments.bench.draw import Quota
from experiments.core.artifacts import read_json
from experiments.core.context import read_metrics
from experiments.paper import (
    ablation_cumulative,
    ablation_leave_one_out,
    conflict,
    main_table,
    presets,
    qualitative,
    scaling,
)
from experiments.paper.components import BASE, COMPONENTS
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk

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
    directory, results = run(main_table, main_table.MainConfig(study=STUDY, quota=FEW))
    assert list(results["arms"]) == ["sft", "full"]
    assert set(results["baselines"]) == {*main_table.TOUCHLESS, "encoder_probe", "nearest_fields"}
    for row in {**results["arms"], **results["baselines"]}.values():
        assert {"h_acc", "omae", "l2_em", "csc"} <= set(row)  # a single pair has no interval
    comparison, pooled, reliability, kinds, differences = (table["rows"] for table in results["tables"])
    assert comparison[-1][1:5] == [76.8, 68.4, 65.1, 74.6]
    assert [row[2] for row in kinds] == [8, 3, 2, 8]
    assert [row[0] for row in pooled][:2] == ["sft", "full"]
    assert {row[0].split(":")[0] for row in reliability} == {"sft", "full"}
    assert len(differences) > 3
    assert results["requirements"][0]["met"]
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in ("nearest_fields", "Touch-R1-7B (paper)"))


@pytest.mark.slow
def test_the_ladder_has_every_arm_and_the_papers_rows(run):
    directory, results = run(ablation_cumulative, STUDY)
    names = [c.added.name for c in COMPONENTS]
    assert list(results["arms"]) == names
    assert "untrained" in results["baselines"]
    ladder, effects, attributes, pooled, reliability, _ = (table["rows"] for table in results["tables"])
    assert [row[0] for row in ladder] == [BASE, *names] == [row[0] for row in attributes]
    assert ladder[3][3] == 0.31
    assert len(effects) == 3 * len(names)
    assert {row[7] for row in effects} <= {"reproduced", "opposite", "undecided", "not in the paper"}
    assert [row[0] for row in pooled] == names
    assert len(reliability) == 9 * len(names)
    assert len(results["requirements"]) == 3
    assert (directory / "plots" / "changes.svg").exists()


@pytest.mark.slow
def test_every_component_is_left_out(run):
    _, results = run(ablation_leave_one_out, STUDY)
    names = [c.omitted.name for c in COMPONENTS]
    assert set(results["arms"]) == {"sft", "full", *names}
    assert len(results["tables"][0]["rows"]) == 3 * len(names)


@pytest.mark.slow
def test_conflict_evaluates_with_and_without_touch(run):
    directory, results = run(conflict, STUDY)
    contrasts, gains, _ = (table["rows"] for table in results["tables"])
    assert contrasts[0][0] == "all questions"
    assert gains[0][0] == "full, all"
    assert results["requirements"][-1]["name"] == "least gain from touch, all questions"
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
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert "another object&#" in page
    assert "Tier 3, compare: " in page


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
