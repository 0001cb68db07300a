"""The tables of the paper, shrunk: every rung and baseline answers, stands in the report and beside the paper."""

import dataclasses
from pathlib import Path

import pytest

from experiments.bench.draw import Quota
from experiments.core.artifacts import read_json
from experiments.core.context import read_metrics
from experiments.paper import ablation_cumulative, ablation_leave_one_out, conflict, main_table, qualitative, scaling
from experiments.paper.ladder_arms import LADDER, OMISSIONS
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk

STUDY = dataclasses.replace(tiny.STUDY, grpo_steps=1, share=False)
FEW = Quota(identify=8, scale=0, compose=3, compare=2, order=0, one_sensor=8, conflict=0)


def run(module, config, home: Path, cache_dir: Path) -> Path:
    return run_shrunk(module, config, home, "--cache-dir", str(cache_dir))


@pytest.mark.slow
def test_every_baseline_stands_in_the_main_table(tmp_path, cache_dir):
    directory = run(main_table, main_table.MainConfig(study=STUDY, quota=FEW), tmp_path, cache_dir)
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == ["sft", "full"]
    assert set(results["baselines"]) == {*main_table.TOUCHLESS, "encoder_probe", "nearest_fields"}
    for row in {**results["arms"], **results["baselines"]}.values():
        assert {"h_acc", "omae", "l2_em", "csc"} <= set(row)  # a single pair has no interval
    beside, pooled, reliability, tiers, differs = results["tables"]
    assert [row[0] for row in beside["rows"]][-1] == "Touch-R1-7B (paper)"
    assert beside["rows"][-1][1:5] == [76.8, 68.4, 65.1, 74.6]
    assert [row[2] for row in tiers["rows"]] == [8, 3, 2, 8]
    assert [row[0] for row in pooled["rows"]][:2] == ["sft", "full"]
    assert {row[0].split(":")[0] for row in reliability["rows"]} == {"sft", "full"}
    assert len(differs["rows"]) > 3
    assert results["requirements"][0]["met"]
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert all(name in page for name in ("nearest_fields", "What differs from the paper", "Touch-R1-7B (paper)"))


@pytest.mark.slow
def test_every_rung_stands_beside_the_papers(tmp_path, cache_dir):
    directory = run(ablation_cumulative, STUDY, tmp_path, cache_dir)
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == [r.name for r in LADDER[1:]]
    rungs, changes, attributes, pooled, reliability, _ = results["tables"]
    assert [row[0] for row in rungs["rows"]] == [r.name for r in LADDER] == [row[0] for row in attributes["rows"]]
    assert rungs["rows"][3][3] == 0.31
    assert len(changes["rows"]) == 3 * (len(LADDER) - 1)
    assert {row[7] for row in changes["rows"]} <= {"reproduced", "opposite", "undecided", "not in the paper"}
    assert [row[0] for row in pooled["rows"]] == list(results["arms"])
    assert len(reliability["rows"]) == 9 * len(results["arms"])
    assert len(results["requirements"]) == 3
    assert "changes.svg" in [path.name for path in (directory / "plots").iterdir()]


@pytest.mark.slow
def test_every_component_is_left_out(tmp_path, cache_dir):
    results = read_json(run(ablation_leave_one_out, STUDY, tmp_path, cache_dir) / "results.json")
    names = [o.name for o in OMISSIONS]
    assert set(results["arms"]) == {"sft", "full", *names}
    assert len(results["tables"][0]["rows"]) == 3 * len(names)


@pytest.mark.slow
def test_conflict_asks_with_and_without_touch(tmp_path, cache_dir):
    directory = run(conflict, STUDY, tmp_path, cache_dir)
    results = read_json(directory / "results.json")
    contrasts, uses, _ = results["tables"]
    assert contrasts["rows"][0][0] == "all questions"
    assert uses["rows"][0][0] == "full, all"
    assert results["requirements"][-1]["name"] == "least gain from touch, all questions"
    assert len(list((directory / "answers").glob("*-under-*.npz"))) == 2 * 2 * 4


@pytest.mark.slow
def test_three_sizes_stand_beside_the_papers(tmp_path, cache_dir):
    wide = dataclasses.replace(tiny.MODEL, tactile=dataclasses.replace(tiny.MODEL.tactile, width=32))
    study = dataclasses.replace(STUDY, grpo_steps=2)  # the first step of a stage is not timed
    config = scaling.ScalingConfig(study=study, small=tiny.MODEL, large=wide, quota=FEW, rounds=1)
    directory = run(scaling, config, tmp_path, cache_dir)
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == ["small", "default", "large"]
    sizes, growth, beside, *_ = results["tables"]
    counts = [row[1] for row in sizes["rows"]]
    assert counts[0] == counts[1] < counts[2]
    assert all(value > 0 for row in sizes["rows"] for value in row[3:])
    assert "full model: OMAE" in [row[0] for row in growth["rows"]]
    assert [row[0] for row in beside["rows"]][3:] == [f"Touch-R1-{n}B (paper)" for n in (3, 7, 14)]
    assert beside["rows"][4][1] == 76.8
    assert beside["rows"][5][1] is None
    stages = {line["stage"] for line in read_metrics(directory)}
    assert {"sft/small/0", "grpo/large/1", "blind/default/1"} <= stages


@pytest.mark.slow
def test_the_browser_shows_cases_and_items(tmp_path, cache_dir):
    study = dataclasses.replace(STUDY, seeds=1)
    directory = run(qualitative, qualitative.QualitativeConfig(study=study, quota=FEW), tmp_path, cache_dir)
    common = read_json(directory / "results.json")["tables"][0]["rows"]
    assert len(common) == 10
    assert all(row[1] <= row[2] for row in common)
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert "<summary><b>" in page
    assert "another object&#x27;s touch" in page
    assert "Tier 3, compare: " in page
