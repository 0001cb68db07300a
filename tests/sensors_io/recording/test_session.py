"""Sessions led by prompts, stopped, killed and gone on with."""

import dataclasses
import os
import pathlib
import signal
import subprocess
import sys

import numpy as np
import pytest

from sensors_io.devices.errors import DeviceLostError
from sensors_io.force import ForceError, GravityModel
from sensors_io.recording.book import ATTEMPTS
from sensors_io.recording.coach import CoachConfig, Stage, protocol
from sensors_io.recording.session import SessionConfig, record_session
from sensors_io.records import RecordStore
from sensors_io.schema import Flag
from tests.sensors_io.recording.hand import Camera, Hand, Scale

BIAS = GravityModel(
    bias_n=np.array([0, 0, 1.0]), bias_nmm=np.zeros(3), weight_n=0.0, first_moment_nmm=np.zeros(3), rms_n=0, rms_nmm=0,
    poses=6,
)  # fmt: skip
CONFIG = SessionConfig(
    object_id="cup", gravity=BIAS, coach=CoachConfig(move_s=0.2, hold_s=0.2, settle_s=0.05, clear_s=0.1)
)
SHORT = dataclasses.replace(CONFIG, stages=(protocol()[0], Stage(motion="slide_x", force_n=2.0)))


def session(out, hand, config=CONFIG, **rest):
    return record_session(out, config, Camera(hand), Scale(hand), show=hand.show, **rest)


def test_the_whole_protocol_of_a_site(tmp_path):
    hand = Hand()
    report = session(tmp_path, hand)
    store = RecordStore(tmp_path)
    assert (report.contacts, report.incomplete, report.recovered) == (19, 0, 0)
    assert [(k.motion, k.trial // ATTEMPTS) for k in store.contacts] == [(s.motion, s.level) for s in protocol()]
    for i, stage in enumerate(protocol()):
        made = store.contact(i)["gelsight_mini"]
        peak = -made.force_n[:, 2].min()
        assert 0.94 * stage.force_n <= peak <= 1.05 * stage.force_n
        assert made.target_force_n[0] == np.float32(stage.force_n)
        counter = made.frames[:, 0, 0, 0].astype(int)
        assert np.all(np.diff(counter) % 256 == 1)  # no frame lost, none twice
        assert made.camera["settings"] == {"exposure": 100.0}
        assert not made.camera["recording"]["torn"]
        assert not np.any(made.flags)
    phases = [sorted(set(store.contact(i)["gelsight_mini"].phase.tolist())) for i in (0, 1, 5, 6)]
    assert phases == [[0, 1], [0, 1, 2, 3, 4], [0, 1, 3], [0, 1, 2, 3]]
    assert not list((tmp_path / ".journals").iterdir())
    prompts = {s.advice.prompt for s in hand.statuses}
    assert {"keep clear of the gel", "hold 5 N", "release slowly", "done: release"} <= prompts


def test_a_contact_let_go_too_early_is_kept_and_asked_for_again(tmp_path):
    hand = Hand(slips_at=(1,))
    report = session(tmp_path, hand, SHORT)
    assert (report.contacts, report.incomplete) == (3, 1)
    store = RecordStore(tmp_path)
    assert [(k.motion, k.trial) for k in store.contacts] == [("press", 0), ("slide_x", 0), ("slide_x", 1)]
    assert store.meta.notes["incomplete"] == [["cup", 0, "slide_x", 0]]
    assert session(tmp_path, Hand(), SHORT).contacts == 0


def test_a_stopped_session_goes_on_behind_what_is_done(tmp_path):
    hand = Hand()
    first = session(tmp_path, hand, stop=lambda: hand.contacts >= 4)
    second = session(tmp_path, Hand())
    assert first.contacts == 4
    assert second.contacts == 15
    assert len(RecordStore(tmp_path)) == 19


def test_a_device_that_fails_for_good_leaves_its_contact_in_the_records(tmp_path):
    class Failing(Camera):
        def drain(self):
            if self.count > 40:
                raise DeviceLostError("unplugged")
            return super().drain()

    hand = Hand()
    with pytest.raises(DeviceLostError):
        record_session(tmp_path, SHORT, Failing(hand), Scale(hand), show=hand.show)
    assert not list((tmp_path / ".journals").iterdir())
    report = session(tmp_path, Hand(), SHORT)
    assert (report.contacts, report.recovered, report.incomplete) == (2, 0, 0)
    store = RecordStore(tmp_path)
    assert len(store.contact(0)["gelsight_mini"]) > 20
    assert not store.contact(0)["gelsight_mini"].camera["recording"]["end"]["complete"]
    assert [(k.motion, k.trial) for k in store.contacts] == [("press", 0), ("press", 1), ("slide_x", 0)]


def test_a_protocol_without_any_force_is_refused(tmp_path):
    hand = Hand()
    with pytest.raises(ForceError, match="gelsight_mini tells no force"):
        record_session(tmp_path, SHORT, Camera(hand), None, show=hand.show)


def test_free_motion_needs_no_force_sensor(tmp_path):
    hand = Hand()
    config = dataclasses.replace(CONFIG, free_s=0.5)
    report = record_session(tmp_path, config, Camera(hand), None, show=hand.show)
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    assert report.contacts == 1
    assert made.key.motion == "free"
    assert len(made) == 51
    assert made.force_n is None


def test_a_gap_of_the_camera_is_flagged(tmp_path):
    class Gappy(Camera):
        def drain(self):
            if self.count == 40:
                self.count += 1
            return super().drain()

    hand = Hand()
    record_session(tmp_path, dataclasses.replace(CONFIG, free_s=0.6), Gappy(hand), Scale(hand), show=hand.show)
    flags = RecordStore(tmp_path).contact(0)["gelsight_mini"].flags
    assert np.flatnonzero(flags & np.uint32(Flag.TIME_GAP)).tolist() == [40]


CHILD = """
import sys, time
import tests.sensors_io.recording.hand as hand_
from sensors_io.recording.session import record_session
from tests.sensors_io.recording.test_session import CONFIG
hand = hand_.Hand()
def show(status):
    hand.show(status)
    print(status.frames, flush=True)
    time.sleep(0.002)
record_session(sys.argv[1], CONFIG, hand_.Camera(hand), hand_.Scale(hand), show=show)
"""


def test_a_kill_loses_no_frame_that_was_shown(tmp_path):
    """SIGKILL in the middle of the press; every frame that the session had reported is in the records afterwards."""
    root = pathlib.Path(__file__).resolve().parents[3]
    code = CHILD.replace("sys.argv[1]", "__import__('pathlib').Path(sys.argv[1])")
    environment = os.environ | {"PYTHONPATH": str(root)}
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True, env=environment, cwd=root
    )
    shown = 0
    while shown < 30:
        shown = int(child.stdout.readline())
    child.send_signal(signal.SIGKILL)
    rest = child.stdout.read().split("\n")
    assert child.wait() == -signal.SIGKILL
    child.stdout.close()
    last = max([shown, *(int(line) for line in rest[:-1])])
    hand = Hand()
    report = session(tmp_path, hand, SHORT)
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    assert report.recovered == 1
    assert last <= len(made) <= last + 1
    assert np.all(np.diff(made.frames[:, 0, 0, 0].astype(int)) % 256 == 1)
