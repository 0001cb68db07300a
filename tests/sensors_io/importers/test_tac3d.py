"""Tac3D recordings: the grid is turned into image order, signs are kept, the counter's gaps are flagged."""

import os
import pathlib

import numpy as np
import pytest

from sensors_io.importers.keep import ImportSourceError, Shares
from sensors_io.importers.tac3d import SIDE, list_tac3d
from sensors_io.schema import Flag
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import imported

ALL_TRAIN = Shares(val_share=0, test_share=0)


def recording(*, index=(7, 8, 11), **changes):
    """A press of 0.8 mm and 5 N at rest point x = 3, y = −4 mm that drags it 0.2 mm to +x; points as the vendor's."""
    n = np.size(index)
    y, x = np.meshgrid(np.linspace(10, -10, SIDE), np.linspace(10, -10, SIDE), indexing="ij")
    rest = np.stack([x, y, np.full_like(x, 9.0)], -1).reshape(-1, 3)
    pressed = np.argmin(np.hypot(rest[:, 0] - 3, rest[:, 1] + 4))
    moved = np.zeros((n, SIDE * SIDE, 3))
    moved[1:, pressed] = (0.2, 0, -0.8)
    force = np.zeros((n, 1, 3))
    force[1:, 0] = (1.0, 0.0, -5.0)
    moment = np.cross([3.0, -4.0, 0.0], force)
    return {
        "3D_Positions": rest + moved,
        "3D_Displacements": moved,
        "3D_ResultantForce": force,
        "3D_ResultantMoment": moment,
        "index": np.array(index, np.int64),
        "sendTimestamp": 68.0 + 0.03 * np.arange(n),
    } | changes


def write(folder, name="example_1_AD2-0065L", **changes):
    folder.mkdir(exist_ok=True)
    arrays = {key: value for key, value in recording(**changes).items() if value is not None}
    np.savez(folder / f"{name}.npz", **arrays)
    return folder


def read(source, out):
    return imported(list_tac3d(source, ALL_TRAIN), out)


def test_a_known_push_lies_where_and_as_it_was_made(tmp_path):
    _, store = read(write(tmp_path / "in"), tmp_path / "out")
    sequence = store.contact(0)["tac3d"]
    row, column = np.unravel_index(sequence.depth_mm[1].argmax(), (SIDE, SIDE))
    axis = np.linspace(-10, 10, SIDE)  # x rises with the column, y with the row
    assert axis[column] == pytest.approx(3, abs=0.6)
    assert axis[row] == pytest.approx(-4, abs=0.6)
    assert sequence.depth_mm[1, row, column] == pytest.approx(0.8, abs=1e-3)
    np.testing.assert_allclose(sequence.deformation_mm[1, row, column], [0.2, 0], atol=1e-3)
    np.testing.assert_allclose(sequence.force_n[1], [1, 0, -5], atol=1e-3)
    np.testing.assert_allclose(sequence.moment_nmm[1], [20, 15, 4], atol=1e-2)  # r × F
    assert sequence.frames is None
    assert sequence.serial == "AD2-0065L"


def test_gaps_of_the_counter_are_flagged_and_counted(tmp_path):
    """The name of the file is of somebody's own making, and the sensor was started anew at the end."""
    source = write(tmp_path / "in", "my cup_A1", index=(7, 8, 11, 12, 20, 0, 1))
    (source / "my cup_A1.npz").rename(source / "my cup_A1.NPZ")
    _, store = read(source, tmp_path / "out")
    sequence = store.contact(0)["tac3d"]
    assert sequence.key.object_id == "my_cup_A1"
    assert np.flatnonzero(sequence.flags & int(Flag.TIME_GAP)).tolist() == [2, 4, 5]
    assert sequence.camera["missing_frames"] == 9


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"3D_ResultantMoment": None}, "lacks 3D_ResultantMoment"),
        ({"3D_Positions": np.zeros((3, 400, 2))}, r"3D_Positions has shape \(3, 400, 2\): must be \(3, 400, 3\)"),
        ({"3D_Positions": recording()["3D_Positions"][:, ::-1]}, "points in another order"),
        ({"recvTimestamp": np.arange(2.0)}, r"recvTimestamp has shape \(2,\): must be \(3,\)"),
        ({"3D_ResultantForce": np.full((3, 1, 3), np.inf)}, "every frame holds values that are not finite"),
        ({"recvTimestamp": np.array([0.5, 0.4, 0.3])}, "has times that run backwards"),
        ({"3D_ResultantMoment": np.full((3, 1, 3), "7")}, "3D_ResultantMoment holds <U1: must hold numbers"),
        ({"index": 7}, r"index has shape \(\): must be \(N,\)"),
        ({"sendTimestamp": 1e12 + np.arange(3)}, "times in ns: reach 1e\\+21, which 64 bits cannot hold"),
    ],
)
def test_another_layout_is_refused(tmp_path, changes, reason):
    refused(ImportSourceError, reason, read, write(tmp_path / "in", **changes), tmp_path / "out")


def test_receive_times_are_host_times_where_they_are_stored(tmp_path):
    write(tmp_path / "in", "a_S1")
    write(tmp_path / "in", "b_S2", recvTimestamp=np.array([0.04, 0.07, 0.52]))
    write(tmp_path / "in", "c_S3", recvTimestamp=np.array([0.04, 0.03, 0.52]))
    _, store = read(tmp_path / "in", tmp_path / "out")
    sent, received, back = (store.contact(i)["tac3d"] for i in range(3))
    np.testing.assert_array_equal(sent.host_time_ns, sent.device_time_ns)
    assert received.host_time_ns.tolist() == [40_000_000, 70_000_000, 520_000_000]
    np.testing.assert_array_equal(received.force_time_ns, received.device_time_ns)
    assert back.host_time_ns.tolist() == [40_000_000, 40_000_000, 520_000_000]
    assert back.flags.tolist() == [0, int(Flag.TIME_GAP), int(Flag.TIME_GAP)]  # the last, by its counter


@pytest.mark.parametrize(
    ("received_s", "back"), [((0.0, 0.1, 0.5, 0.3, 0.4, 0.6), (3, 4)), ((0.1, 0.2, 0.3, 0.4, 0.5, 0.0), (5,))]
)
def test_every_frame_whose_time_runs_back_is_flagged(tmp_path, received_s, back):
    arrays = {name: np.repeat(array[:1], 6, axis=0) for name, array in recording().items()}
    arrays |= {"index": np.arange(6).reshape(arrays["index"].shape), "recvTimestamp": np.array(received_s)}
    _, store = read(write(tmp_path / "in", **arrays), tmp_path / "out")
    assert np.flatnonzero(store.contact(0)["tac3d"].flags).tolist() == list(back)


@pytest.mark.parametrize("value", [np.nan, 1e7, 1e300])
def test_a_frame_of_values_that_no_sensor_measures_is_left_out(tmp_path, value):
    arrays = recording()
    arrays["3D_ResultantForce"][1, 0, 2] = value
    received = np.array([0.1, 0.2, np.nan])
    report, store = read(write(tmp_path / "in", **arrays, recvTimestamp=received), tmp_path / "more")
    assert [skip.name[-7:] for skip in report.skipped] == ["frame 1", "frame 2"]
    report, store = read(write(tmp_path / "in", **arrays), tmp_path / "out")
    assert [skip.name for skip in report.skipped] == ["example_1_AD2-0065L.npz, frame 1"]
    assert store.contact(0)["tac3d"].flags.tolist() == [0, int(Flag.TIME_GAP)]


@pytest.mark.skipif("TOUCHR1_TAC3D" not in os.environ, reason="TOUCHR1_TAC3D does not name the vendor's recordings")
def test_the_real_recordings(tmp_path):
    _, store = read(pathlib.Path(os.environ["TOUCHR1_TAC3D"]), tmp_path)
    missing = {k.object_id: store.contact(i)["tac3d"].camera["missing_frames"] for i, k in enumerate(store.contacts)}
    assert missing == {"example_1_AD2-0065L": 9, "example_2_HDL1-GWH0021": 61}
    hardest = store.contact(0)["tac3d"].force_n[:, 2].argmin()
    assert store.contact(0)["tac3d"].force_n[hardest, 2] == pytest.approx(-7.694, abs=1e-3)
    assert store.contact(0)["tac3d"].depth_mm[hardest].max() == pytest.approx(1.344, abs=1e-3)
