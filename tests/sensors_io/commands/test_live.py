"""`record`, `view` and `devices` from the command line, on replays."""

import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from sensors_io import __main__ as cli
from sensors_io.calibration.geometry import CameraGeometry
from sensors_io.offsets import Offset, Offsets
from sensors_io.poses import ForceZero
from sensors_io.records import RecordStore
from tests.sensors_io.fields.test_extract import calibration

ROOT = pathlib.Path(__file__).resolve().parents[3]


def save(path, rate_hz, force, moment=None):
    """A Tac3D recording of total forces [N, 3] on an untouched field."""
    n = len(force)
    arrays = {"3D_Displacements": np.zeros((n, 400, 3)), "3D_ResultantForce": force[:, None]}
    if moment is not None:
        arrays["3D_ResultantMoment"] = moment[:, None]
    np.savez(path, index=np.arange(n), sendTimestamp=np.arange(n) / rate_hz, **arrays)
    return path


@pytest.fixture
def press(tmp_path):
    """A Tac3D recording of 1.2 s: untouched, then a press to 3 N."""
    load = np.concatenate([np.zeros(70), np.linspace(0, 3, 50)])
    return save(tmp_path / "A1.npz", 100, np.outer(load, [0, 0, -1.0]))


def rate_hz(sequence) -> float:
    """Numbers of frames depend on the load of the machine, the median time between two does not."""
    return 1e9 / float(np.median(np.diff(sequence.host_time_ns)))


@pytest.mark.long
def test_a_replay_that_ends_leaves_its_contact_in_the_records(tmp_path, press, capsys):
    """The protocol asks for 20 N, the recording ends at 3: kept as incomplete, with the force of the sensor itself."""
    out = tmp_path / "records"
    args = ["record", "--out", out, "--object-id", "cup", "replay", "--path", press]
    assert run(*args) == 1
    said = capsys.readouterr()
    assert "1 contacts written, 0 recovered, 1 incomplete" in said.out
    assert "A1.npz has been replayed to its end, before all 19 contacts were complete" in said.err
    store = RecordStore(out, allow_incomplete=True)
    made = store.contact(0)["tac3d"]
    assert made.key.motion == "press"
    assert set(made.phase.tolist()) == {0, 1}
    assert -made.force_n[:, 2].min() == pytest.approx(3.0, abs=0.1)


@pytest.mark.long
def test_ctrl_c_ends_a_recording_cleanly(tmp_path, press):
    out = tmp_path / "records"
    command = [sys.executable, "-m", "sensors_io", "record", "--out", str(out), "--object-id", "cup"]
    command += ["--free-s", "60", "replay", "--path", str(press), "--seconds", "60"]
    child = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"JAX_PLATFORMS": "cpu"}, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(out.glob(".journals/*")) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(0.5)
    child.send_signal(signal.SIGINT)
    assert child.wait(timeout=60) == 0
    assert len(RecordStore(out).contact(0)["tac3d"]) > 10
    assert not list(out.glob(".journals/*"))


def pictures(folder, brightness):
    """A folder of flat pictures."""
    folder.mkdir(parents=True)
    for n, level in enumerate(brightness):
        cv2.imwrite(str(folder / f"{n:04d}.png"), np.full((24, 32, 3), level, np.uint8))
    return folder


def run(*args):
    return cli.main([str(arg) for arg in args])


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["list", "x", "+", "tac3d"], "list takes no device after a \\+"),
        (["view", "netft", "+", "netft"], "2 force sensors are named"),
        (["record", "--out", "x", "--object-id", "cup", "netft"], "no tactile sensor is named"),
        (["sync", "tac3d"], "two or more can be compared"),
        (["view", "uvc", "--serial", "none"], "no camera answers to it"),
        (["force-zero", "--out", "x", "--poses", "3", "netft"], "poses is 3: must be ≥ 4"),
        (["force-zero", "--out", ".", "netft"], "is a folder: must be a file; name one in it"),
        (["sync", "--out", ".", "tac3d", "+", "netft"], "is a folder: must be a file; name one in it"),
        (["sync", "--out", "x", "--check", "y", "tac3d", "+", "netft"], "check y: --check writes no file; leave one"),
        (["sync", "--check", "none.json", "tac3d", "+", "netft"], "none.json"),
    ],
)
def test_benches_that_make_no_sense_are_one_line(args, message, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert cli.main(args) == 1
    assert re.search(message, capsys.readouterr().err.replace("\n", " "))


@pytest.fixture
def poses(tmp_path):
    """A recording of a force sensor held in eight directions, 200 ms each, at 1 kHz; 1.5 N hang on it."""
    down = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
    down = down[[0, 1, 3, 2, 6, 7, 5, 4]].repeat(200, 0)
    moment = np.cross([0, 0, 15.0], 1.5 * down)
    return save(tmp_path / "HDL1.npz", 1000, [1.0, -2.0, 3.0] + 1.5 * down, moment)


@pytest.mark.long
def test_force_zero_from_static_poses(tmp_path, poses, capsys):
    """The recording is repeated until all poses are found, so that readings lost on a busy machine come again."""
    args = ["force-zero", "--out", tmp_path / "g.json", "--hold-s", 0.03, "replay", "--path", poses]
    assert run(*args, "--seconds", 120) == 0
    zero = ForceZero.load(tmp_path / "g.json")
    np.testing.assert_allclose(zero.model.bias_n, [1, -2, 3], atol=1e-5)
    assert zero.model.mass_kg == pytest.approx(1.5 / 9.80665, abs=1e-5)
    np.testing.assert_allclose(zero.model.centre_mm, [0, 0, 15], atol=1e-3)
    assert "153.0 g" in capsys.readouterr().out
    assert run(*args[:3], "--poses", 9, "--hold-s", 0.03, "replay", "--path", poses) == 1
    assert "of 9 poses" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.long
def test_sync_and_its_check(tmp_path, capsys):
    """A film and a force recording of the same taps; the film is replayed with it, so that little is left over."""
    at = np.cumsum([0.3, 0.45, 0.35, 0.5])
    time_s = np.arange(0, 1.9, 0.005)
    past = time_s[:, None] - at
    load = (np.clip(past / 0.02, 0, 1) * np.exp(-np.clip(past - 0.02, 0, None) / 0.05)).sum(-1)
    save(tmp_path / "A1.npz", 200, np.outer(load, [0, 0, -5.0]))
    film = pictures(tmp_path / "film", np.clip(60 + 150 * load, 0, 255).astype(int)[::2])
    bench = ["replay", "--path", tmp_path / "A1.npz", "+", "replay", "--path", film, "--rate-hz", 100]
    assert run("sync", "--seconds", 4, "--out", tmp_path / "s.json", *bench) == 0
    found = Offsets.load(tmp_path / "s.json")
    assert found.reference == "tac3d"
    assert abs(found.sensors["gelsight_mini"].late_s) < 0.15  # the second device opens a little later
    assert found.sensors["gelsight_mini"].events == 4
    off = Offset(late_s=0.5, spread_s=0.0, events=4, by="taps")
    Offsets(reference="tac3d", sensors={"gelsight_mini": off}).save(tmp_path / "off.json")
    assert run("sync", "--seconds", 4, "--check", tmp_path / "off.json", *bench) == 1
    assert "measure again" in capsys.readouterr().out


def test_view_extracts_fields_of_a_camera(tmp_path, capsys):
    """Presses of a real Mini without calibration: no depth and no shear can be computed, and the view says so."""
    gelslam = ROOT / "tests" / "data" / "gelslam"
    args = ["view", "--port", "0", "--seconds", "0.3", "--background", gelslam / "background.png", "replay"]
    assert cli.main([*map(str, args), "--path", str(gelslam), "--seconds", "30"]) == 0
    assert "not shown: depth_mm: without a calibration" in capsys.readouterr().out
    calibration(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "x.npz")
    args[-1:] = ["--calibration", tmp_path / "x.npz", "replay"]
    assert cli.main([*map(str, args), "--path", str(gelslam)]) == 1
    assert "calibration is for 'x', the pictures are of 'gelsight_mini'" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["view --port 0 --seconds 0.1", "sync --seconds 0.1"])
def test_devices_of_one_name_are_refused_at_once(tmp_path, command, press, capsys):
    """Else the page shows the panels of one of them."""
    replay = ["replay", "--path", press]
    assert run(*command.split(), *replay, "+", *replay) == 1
    assert "devices are ['tac3d', 'tac3d']: each name once; name cameras apart" in capsys.readouterr().err


def test_a_recording_of_a_sensor_whose_delay_nobody_measured_is_refused(tmp_path, press, capsys):
    Offsets(reference="netft", sensors={"gelsight_mini": Offset(late_s=0.1, spread_s=0, events=5, by="taps")}).save(
        tmp_path / "s.json"
    )
    args = ["record", "--out", tmp_path / "o", "--object-id", "cup", "--free-s", 0.2, "--sync", tmp_path / "s.json"]
    assert run(*args, "replay", "--path", press) == 1
    assert "s.json knows nothing of tac3d" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize("wrong", ["--fx 0", "--colour-format XX", "--rate-hz 0", "--depth-unit-mm 0", "--width -1"])
def test_a_camera_of_the_object_refuses_numbers_while_the_command_is_read(wrong, capsys):
    with pytest.raises(SystemExit) as stop:
        run("view", "rgbd", "--fx", 600, "--fy", 600, "--cx", 320, "--cy", 240, *wrong.split())
    assert stop.value.code == 2
    assert f"{wrong.split()[0][2:].replace('-', '_').replace('colour', 'pixel')} is" in capsys.readouterr().err


def test_where_a_contact_shows_needs_a_camera_that_shows_it(tmp_path, press, capsys):
    args = ["record", "--out", tmp_path / "o", "--object-id", "cup", "--contact-mm", 0, 0, 300]
    assert run(*args, "replay", "--path", press) == 1
    assert "contact_mm is (0.0, 0.0, 300.0): no RGB-D camera is named" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "o").exists()


def test_devices_says_what_is_absent(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    assert cli.main(["devices", "--wait-s", "0.1", "--netft-host", "127.0.0.1", "--tac3d-port", str(port)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "nothing heard" in said
    assert "does not answer" in said


def test_a_pin_board_gives_a_geometry(tmp_path):
    board = ROOT / "tests" / "data" / "9DTact"
    pins = ["--background", board / "board_ref.png", "--rows", 7, "--columns", 9]
    args = ["geometry", board / "board_sample.png", *pins]
    assert run(*args, "--pitch-mm", 2.5, "--out", tmp_path / "g.json") == 0
    assert CameraGeometry.load(tmp_path / "g.json").held_out_mm < 0.07
    assert run(*args, "--pitch-mm", -1, "--out", tmp_path / "h.json") == 1
    assert not (tmp_path / "h.json").exists()


def test_two_sensors_are_recorded_into_one_contact(tmp_path, press, capsys):
    """Each at its own rate, one offset taken off, with a page of the recording; once more, nothing is missing."""
    out, sync = tmp_path / "records", tmp_path / "s.json"
    late = Offset(late_s=0.1, spread_s=0.001, events=5, by="taps")
    Offsets(reference="tac3d", sensors={"gelsight_mini": late}).save(sync)
    camera = ["replay", "--path", pictures(tmp_path / "film", range(40, 80)), "--rate-hz", 50]
    bench = [*camera, "+", "replay", "--path", press]
    args = ["record", "--out", out, "--object-id", "cup", "--free-s", 0.4, "--sync", sync, "--port", 0, *bench]
    assert run(*args) == 0
    made = RecordStore(out).contact(0)
    assert list(made) == ["gelsight_mini", "tac3d"]
    assert rate_hz(made["gelsight_mini"]) == pytest.approx(50, rel=0.3)
    assert rate_hz(made["tac3d"]) == pytest.approx(100, rel=0.3)
    starts = [s.host_time_ns[0] for s in made.values()]
    assert -0.15e9 < starts[0] - starts[1] < -0.05e9
    assert made["gelsight_mini"].camera["recording"]["late_s"] == 0.1
    assert made["tac3d"].depth_mm.shape[1:] == (20, 20)
    assert "\n1 contacts written, 0 recovered, 0 incomplete" in capsys.readouterr().out  # on a line of its own
    assert run(*args) == 0
    assert "nothing was missing: cup, site 0 is complete; name another --site" in capsys.readouterr().out


def test_the_object_is_looked_at_before_it_is_touched(tmp_path, press):
    """A replayed RGB-D camera: 16-bit depth, and 20 mm at 300 mm seen with f = 30 px."""
    folder = tmp_path / "rgbd"
    pictures(folder / "colour", [90, 91])
    (folder / "depth").mkdir()
    cv2.imwrite(str(folder / "depth" / "0.png"), np.full((24, 32), 600, np.uint16))
    view = ["rgbd", "--replay", folder, "--width", 32, "--height", 24, "--fx", 30, "--fy", 30, "--cx", 16, "--cy", 12]
    out = tmp_path / "records"
    args = ["record", "--out", out, "--object-id", "cup", "--free-s", 0.2, "--contact-mm", 0, 0, 300, "replay"]
    assert run(*args, "--path", press, "+", *view, "--depth-unit-mm", 0.5) == 0
    store = RecordStore(out)
    assert store.objects["cup"].view[0, 0].tolist() == [90, 90, 90]
    assert store.objects["cup"].view_depth_mm[0, 0] == 300
    assert store.contact(0)["tac3d"].contact_region_px == (15, 11, 2, 2)
    away = [*args[:3], "--object-id", "mug", *args[5:8], 0, 0, -300, "replay", "--path", press, "+", *view]
    assert run(*away) == 1
