"""The experiments on fields as a user runs them, shrunken."""

import pathlib
import shutil

import pytest

from experiments.core.artifacts import read_json
from experiments.fields import real_sensors
from sensors_io.calibration.published import FOLDERS
from tests.experiments.shrunk import run_shrunk

CLIPS = pathlib.Path(__file__).parents[2] / "data" / "gelslam"
CLIP = FOLDERS["gelslam"]._replace(path=".", pattern="press_*.png", mm_per_px=0.1902)
"""14 presses of gelslam at a third of their size."""


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
