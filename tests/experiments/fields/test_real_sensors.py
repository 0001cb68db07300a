"""Fields of a folder of recordings, on a tiny one."""

import pathlib
import shutil

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.runner import main
from experiments.fields import real_sensors
from experiments.fields.recording_folders import RecordingFolder, read_folder

CLIPS = pathlib.Path(__file__).parents[2] / "data"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    shutil.copytree(CLIPS / "gelslam", tmp_path / "data" / "clips")
    found = RecordingFolder(
        name="clips",
        path="clips",
        pattern="press_*.png",
        background="background.png",
        mm_per_px=0.1902,
        ball_diameter_mm=6.31,
    )
    monkeypatch.setattr(real_sensors, "FOLDERS", (found,))
    return found


@pytest.mark.slow
def test_a_folder_becomes_a_row_and_a_picture(folder, tmp_path):
    arguments = ["real_sensors", "--scale", "smoke", "--data-dir", str(tmp_path / "data"), "--runs-dir", str(tmp_path)]
    assert main(arguments) == 0
    (directory,) = (p for p in (tmp_path / "real_sensors").iterdir() if not p.is_symlink())
    (row,) = read_json(directory / "results.json")["tables"][0]["rows"]
    assert row[:3] == ["clips", "bare", 14]
    assert row[3] < 30
    assert (directory / "plots" / "clips.png").stat().st_size > 10_000


def test_an_empty_folder_says_so(folder, tmp_path):
    nothing = RecordingFolder(name="x", path="clips", pattern="*.bmp", background="background.png", mm_per_px=1)
    with pytest.raises(FileNotFoundError, match="must hold the recording"):
        read_folder(nothing, tmp_path / "data")
    frames, names, background = read_folder(folder, tmp_path / "data")
    assert frames.shape[1:] == background.shape
    assert len(names) == len(frames) == 14
    assert not np.array_equal(frames[0], background)
