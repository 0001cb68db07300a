"""Descriptions of videos: each of its own file, and of what the file holds now."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments.core.errors import ConfigurationError
from experiments.recordings import descriptions
from experiments.recordings.descriptions import describe_files, describe_source, families, videos_of
from tests.sensors_io.importers.films import film, uneven_film


@pytest.fixture
def described(monkeypatch, context):
    """Describes videos by the number that each file holds."""
    monkeypatch.setattr(descriptions, "read_touch", lambda file, frames: float(file.read_text()))
    monkeypatch.setattr(descriptions, "describe", lambda touch: np.full(len(families()), touch, np.float32))
    return lambda files: describe_files(files, 8, context)


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def test_videos_of_one_name_are_told_apart_and_one_that_is_named_twice_counts_once(described, tmp_path):
    files = [write(tmp_path / folder / "press.mov", number) for folder, number in (("a", "1"), ("b", "2"))]
    other = write(tmp_path / "b" / "other.mov", "3")
    found = described(videos_of([*files, tmp_path / "b"]))
    assert found.names.tolist() == [str(files[0]), str(files[1]), other.name]
    assert found.x[:, 0].tolist() == [1, 2, 3]


def test_a_video_that_was_recorded_anew_or_is_read_by_other_kernels_is_described_anew(described, tmp_path, monkeypatch):
    file = write(tmp_path / "press.mov", "1")
    assert described([file]).x[0, 0] == 1
    os.utime(write(file, "2"), ns=(0, 10**18))  # of the same size
    assert described([file]).x[0, 0] == 2
    monkeypatch.setattr(descriptions, "describe", lambda touch: np.full(len(families()), 3, np.float32))
    assert described([file]).x[0, 0] == 2
    monkeypatch.setenv("OPENCV_IPP", "disabled")
    assert described([file]).x[0, 0] == 3


def test_videos_that_are_left_out_and_copies_are_named_before_anything_is_learned(tmp_path, context):
    press, still = film(tmp_path / "press.avi"), uneven_film(tmp_path / "still.mp4", [0, 40, 80, 120])
    shutil.copy(press, copy := tmp_path / "copy.avi")
    assert describe_files([press, still, copy], 2, context).names.tolist() == ["press.avi", "copy.avi"]
    printed = context.console.file.getvalue()
    assert "left out: still.mp4 shows one picture in all of its 4 frames: a touch changes them; record" in printed
    assert "the same video of several objects, left in: press.avi, copy.avi\n" in printed


def test_a_run_does_not_go_on_with_other_videos_labels_or_ratings(described, tmp_path, context):
    levels = {"hardness": 0, "roughness": 1, "bumps": 2, "material": "wood"}
    entry = {"object": "block", "name": "a block", "split": "train", **levels, "videos": ["press.mov"]}
    video, table = write(tmp_path / "videos" / "press.mov", "1"), tmp_path / "labels.json"
    changes = (
        lambda: os.utime(write(video, "2"), ns=(0, 10**18)),
        lambda: write(table, json.dumps({"objects": [entry | {"hardness": 2}]})),
        lambda: write(tmp_path / "ratings.json", json.dumps({"objects": {"block": {"hardness": 7}}})),
    )
    for change in changes:
        shutil.rmtree(context.directory / "stages", ignore_errors=True)  # a run of its own
        write(table, json.dumps({"objects": [entry]}))
        assert describe_source(tmp_path, 8, context).x[0, 0] == describe_source(tmp_path, 8, context).x[0, 0]
        change()
        with pytest.raises(ConfigurationError, match=r"videos, labels or ratings of .* changed since this run began"):
            describe_source(tmp_path, 8, context)
