"""`record`, `view` and `devices` from the command line, on replays."""

import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from sensors_io import __main__ as cli
from sensors_io.calibration.geometry import Geometry
from sensors_io.commands.record import load_gravity
from sensors_io.devices.tac3d_messages import load_recording
from sensors_io.force import ForceError
from sensors_io.records import RecordStore

ROOT = pathlib.Path(__file__).resolve().parents[3]


@pytest.fixture
def press(tmp_path):
    """A Tac3D recording of 1.2 s: untouched, then a press to 3 N."""
    load = np.concatenate([np.zeros(70), np.linspace(0, 3, 50)])
    resultant = np.zeros((120, 1, 3))
    resultant[:, 0, 2] = -load
    path = tmp_path / "A1.npz"
    np.savez(
        path,
        index=np.arange(120),
        sendTimestamp=np.arange(120) * 0.01,
        **{"3D_Displacements": np.zeros((120, 400, 3)), "3D_ResultantForce": resultant},
    )
    assert len(load_recording(path).index) == 120
    return path


def test_free_motion_is_recorded_from_a_replay(tmp_path, press):
    out = tmp_path / "records"
    args = ["record", "--out", out, "--object-id", "cup", "--free-s", "0.3", "replay", "--path", press]
    assert cli.main([*map(str, args), "no-force"]) == 0
    made = RecordStore(out).contact(0)["tac3d"]
    assert 25 <= len(made) <= 40
    assert made.depth_mm.shape[1:] == (20, 20)


def test_a_replay_that_ends_leaves_its_contact_in_the_records(tmp_path, press, capsys):
    """The protocol asks for 20 N, the recording ends at 3: kept as incomplete, with the force of the sensor itself."""
    out = tmp_path / "records"
    args = ["record", "--out", out, "--object-id", "cup", "replay", "--path", press]
    assert cli.main([*map(str, args), "no-force"]) == 0
    store = RecordStore(out, allow_incomplete=True)
    made = store.contact(0)["tac3d"]
    assert made.key.motion == "press"
    assert set(made.phase.tolist()) == {0, 1}
    assert -made.force_n[:, 2].min() == pytest.approx(3.0, abs=0.1)


def test_ctrl_c_ends_a_recording_cleanly(tmp_path, press):
    out = tmp_path / "records"
    command = [sys.executable, "-m", "sensors_io", "record", "--out", str(out), "--object-id", "cup"]
    command += ["--free-s", "60", "replay", "--path", str(press), "--seconds", "60", "no-force"]
    child = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"JAX_PLATFORMS": "cpu"}, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(out.glob(".journals/*")) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(0.5)
    child.send_signal(signal.SIGINT)
    assert child.wait(timeout=60) == 0
    assert len(RecordStore(out).contact(0)["tac3d"]) > 10
    assert not list(out.glob(".journals/*"))


def test_view_serves_and_ends(press, capsys):
    args = ["view", "--port", "0", "--seconds", "0.4", "replay", "--path", press, "no-force"]
    assert cli.main(list(map(str, args))) == 0


def test_view_extracts_fields_of_a_camera(tmp_path, capsys):
    """Presses of a real Mini without calibration: no depth and no shear can be told, and the view says so."""
    gelslam = ROOT / "tests" / "data" / "gelslam"
    args = ["view", "--port", "0", "--seconds", "0.3", "--background", gelslam / "background.png", "replay"]
    assert cli.main([*map(str, args), "--path", str(gelslam), "--seconds", "30", "no-force"]) == 0
    assert "not shown: depth_mm: without a calibration" in capsys.readouterr().out


def test_devices_says_what_is_absent(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    assert cli.main(["devices", "--wait-s", "0.1", "--netft-host", "127.0.0.1", "--tac3d-port", str(port)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "nothing heard" in said
    assert "does not answer" in said


def test_an_absent_sensor_is_one_line(capsys):
    assert cli.main(["view", "uvc", "--serial", "none", "no-force"]) == 1
    assert "no camera answers to it" in capsys.readouterr().err.replace("\n", " ")


def test_a_gravity_file_is_read_and_checked(tmp_path):
    path = tmp_path / "g.json"
    tree = {"bias_n": [0, 0, 1], "bias_nmm": [0, 0, 0], "first_moment_nmm": [0, 0, 0], "weight_n": 0.5, "rms_n": 0.01}
    path.write_text(json.dumps(tree | {"rms_nmm": 0.1, "poses": 6, "down": [0, 0, -1]}))
    model, down = load_gravity(path)
    assert model.weight_n == 0.5
    assert down.tolist() == [0, 0, -1]
    path.write_text(json.dumps(tree))
    with pytest.raises(ForceError, match="holds no gravity model"):
        load_gravity(path)


def test_a_pin_board_gives_a_geometry(tmp_path):
    board = ROOT / "tests" / "data" / "9DTact"
    args = [
        "geometry",
        board / "board_sample.png",
        "--background",
        board / "board_ref.png",
        "--rows",
        7,
        "--columns",
        9,
    ]
    assert cli.main([*map(str, args), "--pitch-mm", "2.5", "--out", str(tmp_path / "g.json")]) == 0
    assert Geometry.load(tmp_path / "g.json").held_out_mm < 0.07
    assert cli.main([*map(str, args), "--pitch-mm", "-1", "--out", str(tmp_path / "h.json")]) == 1
    assert not (tmp_path / "h.json").exists()
