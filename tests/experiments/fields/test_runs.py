"""The experiments on fields as a user runs them, shrunken."""

import dataclasses
import pathlib
import shutil

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.fields import pareto_fields, real_sensors, stability_fields
from sensors_io.calibration.published import FOLDERS, read_folder
from tests.experiments.shrunk import run_shrunk

CLIPS = pathlib.Path(__file__).parents[2] / "data" / "gelslam"
CLIP = FOLDERS["gelslam"]._replace(path=".", pattern="press_*.png", mm_per_px=0.1902)
"""14 presses of gelslam at a third of their size."""


def test_errors_of_fields_keep_their_bounds(tmp_path):
    config = dataclasses.replace(pareto_fields.EXPERIMENT.scales["smoke"], rounds=2)
    results = read_json(run_shrunk(pareto_fields, config, tmp_path) / "results.json")
    scale = results["requirements"][0]
    assert scale["met"], scale
    assert results["tables"][0]["rows"][0][0] == "this, Neumann"


@pytest.mark.slow
def test_no_method_of_the_package_breaks_without_a_flag(tmp_path):
    directory = run_shrunk(stability_fields, stability_fields.SMOKE, tmp_path)
    results = read_json(directory / "results.json")
    assert {r["name"]: r["measured"] for r in results["requirements"] if not r["met"]} == {}
    assert set(results["data"]) == {f"silent, {method}" for method in stability_fields.SMOKE.methods}
    charts = {f"stability_{field}.svg" for field in ("tracking", "shear", "depth")}
    assert {p.name for p in (directory / "plots").iterdir()} >= charts


@pytest.mark.slow
def test_a_folder_of_presses_is_calibrated_and_drawn():
    config = real_sensors.RealConfig(shown=3, folds=2)
    row, _, picture = real_sensors.folder_report("clips", CLIP, CLIPS, config)
    assert (row["folder"], row["gel"], row["pictures"]) == ("clips", "bare", 14)
    assert row["depth rmse"] < 30
    assert len(picture.content) > 10_000


def test_a_folder_without_a_ball_is_reported_without_depth(tmp_path):
    data = tmp_path / "data" / FOLDERS["FeelAnyForce, untouched"].path
    (data / "tactile").mkdir(parents=True)
    shutil.copy(CLIPS / "background.png", data)
    shutil.copy(CLIPS / "background.png", data / "tactile" / "0.png")
    config = real_sensors.RealConfig(data_dir=tmp_path / "data", shown=1)
    results = read_json(run_shrunk(real_sensors, config, tmp_path / "runs") / "results.json")
    (row,), (note,) = (table["rows"] for table in results["tables"])
    assert row[:8] == ["FeelAnyForce, untouched", "bare", 1, None, None, None, 1, 0]
    assert note == ["FeelAnyForce, untouched", "no ball of known diameter"]


def test_a_folder_without_its_pictures_is_refused():
    with pytest.raises(FileNotFoundError, match="must hold the recording"):
        read_folder(CLIP._replace(pattern="*.bmp"), CLIPS)
    frames, names, background = read_folder(CLIP, CLIPS)
    assert frames.shape[1:] == background.shape
    assert len(names) == len(frames) == 14
    assert not np.array_equal(frames[0], background)
