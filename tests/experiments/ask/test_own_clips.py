"""The three commands of the README, from somebody's own clips to a trained policy that is asked."""

import dataclasses

import pytest

from experiments.ask.command import run_asking
from experiments.core.runner import run_experiment
from experiments.paper import ablation_ordinal
from experiments.study.ablation import ablation_experiment
from sensors_io.__main__ import main
from tests.experiments import tiny
from tests.sensors_io.importers.films import film


@pytest.mark.slow
def test_clips_become_a_policy_that_is_asked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clips").mkdir()
    lines = ["clip,hardness,roughness,protrusion,material"]
    for n in range(16):
        film(tmp_path / "clips" / f"press_{n}.avi", frames=6)
        lines.append(f"press_{n},{n % 3},{n // 3 % 3},{n // 5 % 3},wood")
    (tmp_path / "labels.csv").write_text("\n".join(lines))
    imported = ["import", "videos", "clips", "--labels", "labels.csv", "--sensor", "gelsight_mini", "--out", "records"]
    assert main(imported) == 0
    arms = {"ordinal": ablation_ordinal.ABLATION.arms["ordinal"]}
    ablation = dataclasses.replace(ablation_ordinal.ABLATION, arms=arms, pairs=())
    small = ablation_experiment("ablation_ordinal", ablation)
    small = dataclasses.replace(small, config=dataclasses.replace(tiny.STUDY, seeds=1))
    assert run_experiment(small, ["--data", "records", "--data-dir", "records"], "about") == 0
    asked = ["ask", "runs/ablation_ordinal/latest", "clips/press_0.avi", "--sensor", "gelsight_mini"]
    assert run_asking(asked) == 0
    assert "hard" in capsys.readouterr().out
