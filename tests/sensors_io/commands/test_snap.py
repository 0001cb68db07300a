"""`snap` on a replayed camera: rest picture, guided presses, and a calibration from nothing else."""

import pathlib

import numpy as np
import pytest

from sensors_io.__main__ import main
from sensors_io.calibration.guide import Guidance, GuideConfig, PressGuide
from sensors_io.calibration.presses import BallPresses
from sensors_io.commands.snap import Snap, _write
from sensors_io.devices.base import Sample
from sensors_io.devices.errors import DeviceDataError
from sensors_io.devices.replay import Replay, ReplayConfig
from sensors_io.fields.sources import read_picture
from sensors_io.fields.types import CalibrationError
from sensors_io.locks import write_lock
from tests.sensors_io import fakes
from tests.sensors_io.calibration.synthetic import press_ball, spread_touches
from tests.sensors_io.checks import refused

TOUCHES = spread_touches(10)
QUICK = GuideConfig(presses=10, cover=0.1, rest_frames=3, steady_frames=2)


@pytest.fixture(scope="module")
def presses() -> BallPresses:
    return press_ball(TOUCHES)


def test_each_press_is_taken_once_where_it_is(presses: BallPresses) -> None:
    guide = PressGuide(presses.radius_mm, presses.mm_per_px, QUICK)
    lifted = [presses.background]  # the gel at rest, then each press for three frames and a lift
    frames = lifted * 4 + [frame for picture in presses.pictures for frame in [picture] * 3 + lifted]
    said = [guide.look(frame) for frame in frames]
    np.testing.assert_array_equal(np.stack([s.taken for s in said if s.taken is not None]), presses.pictures)
    assert np.abs(np.stack(guide.touches)[:, :2] - TOUCHES[:, :2]).max() < 3
    assert guide.done
    prompts = [s.prompt for s in said]
    assert prompts[0].startswith("touch nothing")
    assert prompts[3].startswith("0 of 10 presses cover 0%: press the ball in the middle")
    assert prompts[4] == "hold it still"
    assert prompts[6] == "taken; lift the ball"


def test_a_moving_or_shallow_or_saturated_contact_is_not_taken(presses: BallPresses) -> None:
    def prompts(*frames: np.ndarray, **config: float) -> list[str]:
        guide = PressGuide(presses.radius_mm, presses.mm_per_px, GuideConfig(**config), presses.background)
        return [guide.look(frame).prompt for frame in frames]

    assert set(prompts(*presses.pictures)) == {"hold it still"}
    shallow = press_ball(np.array([[50.0, 40.0, 3.0]])).pictures
    assert prompts(*shallow, least_radius=0.4) == ["press deeper"]
    brighter = lambda picture: np.minimum(picture * 2.1, 255).astype(np.uint8)
    guide = PressGuide(presses.radius_mm, presses.mm_per_px, QUICK, brighter(presses.background))
    assert "saturated" in guide.look(brighter(presses.pictures[0])).prompt


class Taking(PressGuide):
    """A guide that takes every frame for a press."""

    def look(self, frame: np.ndarray) -> Guidance:
        self.touches.append(np.zeros(3))
        return Guidance(prompt="", taken=frame)


def resumed(folder: pathlib.Path, presses: BallPresses, guide: type[PressGuide] = Taking) -> tuple[Snap, PressGuide]:
    """A session that goes on in a folder with a rest picture and presses 1 and 3, for 2 was bad and was removed."""
    snap = Snap(device=ReplayConfig(path=folder), out=folder, ball_diameter_mm=2 * presses.radius_mm)
    begun = guide(presses.radius_mm, presses.mm_per_px, QUICK, presses.background)
    for picture in presses.pictures[:3]:
        snap._see(begun, picture)
    (folder / "presses" / "press_002.png").unlink()
    again = guide(presses.radius_mm, presses.mm_per_px, QUICK, presses.background)
    again.touches = [np.zeros(3)] * 2
    return snap, again


def test_a_session_that_goes_on_overwrites_no_press(tmp_path: pathlib.Path, presses: BallPresses) -> None:
    snap, guide = resumed(tmp_path, presses)
    snap._see(guide, presses.pictures[5])
    kept = {path.name: read_picture(path) for path in (tmp_path / "presses").iterdir()}
    assert sorted(kept) == ["press_001.png", "press_003.png", "press_004.png"]
    np.testing.assert_array_equal(kept["press_003.png"], presses.pictures[2])
    np.testing.assert_array_equal(kept["press_004.png"], presses.pictures[5])


def test_pictures_of_another_size_are_named(tmp_path: pathlib.Path, presses: BallPresses) -> None:
    snap, guide = resumed(tmp_path, presses)
    with pytest.raises(CalibrationError, match=r"the camera's picture is .*background.png .*: must be equal; give the"):
        snap._see(guide, presses.pictures[0][:-1])


def test_guides_that_take_no_press_are_refused() -> None:
    refused(ValueError, r"cover is 1\.1: must be ≤ 1", GuideConfig, cover=1.1)
    refused(ValueError, r"least_radius is 0\.95: must be < most_radius, 0\.95", GuideConfig, least_radius=0.95)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "shots has been replayed to its end, before a press was taken"),
        (["--mm-per-px", "0"], "mm_per_px is 0.0, ball_diameter_mm 4: must lie in (0, 1)"),
        (["--mm-per-px", "5"], "mm_per_px is 5.0, ball_diameter_mm 4: must lie in (0, 1)"),
        (["--out", "records"], "--out is records: holds records, and nothing else may"),
    ],
)
def test_a_session_that_takes_too_little_or_spoils_records_fails(tmp_path, presses, capsys, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    fakes.write(tmp_path / "records", 1)
    _write(tmp_path / "shots" / "1.png", presses.background)
    words = ["--out", "out", "--ball-diameter-mm", "4", "--mm-per-px", "0.1", "--port", "0", *options]
    assert main(["snap", *words, "replay", "--path", "shots"]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "records" / "presses").exists()


def test_a_broken_sample_is_counted_and_ends_no_session(tmp_path, presses, capsys, monkeypatch):
    """Nor does a picture of another size while the gel at rest is looked at."""
    for n, size in enumerate((None, -2, None)):
        _write(tmp_path / "shots" / f"{n}.png", presses.background[:size])
    reads, read = iter(range(9)), Replay.read

    def flaky(replay: Replay, timeout_s: float) -> Sample:
        if next(reads) == 1:
            raise DeviceDataError("a message is cut off")
        return read(replay, timeout_s)

    monkeypatch.setattr(Replay, "read", flaky)
    words = ["--out", str(tmp_path / "out"), "--ball-diameter-mm", "4", "--mm-per-px", "0.1", "--port", "0"]
    assert main(["snap", *words, "replay", "--path", str(tmp_path / "shots")]) == 1
    captured = capsys.readouterr()
    assert "1 broken samples were left out" in captured.out
    assert "has been replayed to its end" in captured.err


def test_two_sessions_do_not_take_their_pictures_into_one_folder(tmp_path, presses, capsys):
    """Each would overwrite the gel at rest that the presses of the other are compared with."""
    _write(tmp_path / "1.png", presses.background)
    (tmp_path / "out").mkdir()
    with write_lock(tmp_path / "out"):
        words = ["--out", str(tmp_path / "out"), "--ball-diameter-mm", "4", "--mm-per-px", "0.1", "--port", "0"]
        assert main(["snap", *words, "replay", "--path", str(tmp_path / "1.png")]) == 1
    assert "is being written by another process; wait for it or choose another path" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".lock"]
