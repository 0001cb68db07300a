"""The experiment, shrunk: every sample is accounted for, the vendor's gaps are found."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.faults import stability_devices
from experiments.faults.tac3d_recordings import recordings
from tests.experiments.shrunk import run_shrunk

TINY = dataclasses.replace(
    stability_devices.SMOKE,
    seconds=20.0,
    traced_seconds=8.0,
    sweep_seconds=4.0,
    rounds=3,
    watch_seconds=0.4,
    browsers=(1,),
    bridge_frames=12,
)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    home = tmp_path_factory.mktemp("runs")
    data = tmp_path_factory.mktemp("data")
    (data / "tac3d").mkdir()
    index = np.array([7, 8, 9, 12, 13, 20])
    arrays = {"3D_Displacements": np.zeros((6, 400, 3)), "3D_ResultantForce": np.zeros((6, 1, 3))}
    np.savez(data / "tac3d" / "AD2-1.npz", index=index, sendTimestamp=index * 0.0327, **arrays)
    directory = run_shrunk(stability_devices, dataclasses.replace(TINY, data_dir=data), home)
    return read_json(directory / "results.json")


@pytest.mark.long
def test_all_counts_are_exact(results):
    timed = {  # by the clock, by the process
        "Tac3D message decoded",
        "memory gained from the first tenth to the last",
        "age of what a browser shows, p95, worst",
        "pictures of 640 × 480 through a bridge",
    }
    assert {r["name"]: r["measured"] for r in results["requirements"] if not r["met"] and r["name"] not in timed} == {}
    for name in (stability_devices.BY_COUNTER, stability_devices.SLOW):
        assert set(results["data"][name].values()) == {0}


@pytest.mark.long
def test_every_replay_and_recording_is_reported(results):
    accounts, recorded, decoders, watched, carried = results["tables"]
    assert len(accounts["rows"]) == 3
    assert recorded["rows"][0][:4] == ["AD2-1", 6, 8, 8]
    assert decoders["rows"][0][0] == "cached layout"
    assert [row[0] for row in watched["rows"]] == ["no page", "1 browser"]
    assert all(row[-1] == 0 < row[-2] for row in watched["rows"])
    assert carried["rows"][0][1] > 0


def test_a_directory_without_recordings_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="must hold tac3d"):
        recordings(tmp_path)
    assert recordings(None) == []
