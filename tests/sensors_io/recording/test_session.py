"""Sessions led by prompts, stopped, killed and gone on with."""

import dataclasses
import os
import pathlib
import shutil
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest

from sensors_io.__main__ import main
from sensors_io.devices.base import Identity
from sensors_io.devices.errors import DeviceLostError
from sensors_io.force import ForceError, GravityModel
from sensors_io.recording.book import ATTEMPTS, ObjectView
from sensors_io.recording.coach import CoachConfig, ContactStage, protocol
from sensors_io.recording.session import SessionConfig, record_session
from sensors_io.records import RecordsExistError, RecordStore
from sensors_io.schema import Flag, Phase, SchemaError
from tests.sensors_io.checks import refused
from tests.sensors_io.recording.hand import MS, Camera, Hand, Scale, Skin

BIAS = GravityModel(
    bias_n=np.array([0, 0, 1.0]), bias_nmm=np.zeros(3), weight_n=0.0, first_moment_nmm=np.zeros(3), rms_n=0, rms_nmm=0,
    poses=6,
)  # fmt: skip
CONFIG = SessionConfig(
    object_id="cup", gravity=BIAS, coach=CoachConfig(move_s=0.2, hold_s=0.2, settle_s=0.05, clear_s=0.1)
)
SHORT = dataclasses.replace(CONFIG, stages=(protocol()[0], ContactStage(motion="slide_x", force_n=2.0)))


def session(out, hand, config=CONFIG, **rest):
    return record_session(out, config, [Camera(hand)], Scale(hand), show=hand.show, **rest)


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


def test_a_stage_that_no_attempt_completes_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("sensors_io.recording.book.ATTEMPTS", 2)
    report = session(tmp_path, Hand(slips_at=(1, 2)), SHORT)
    assert (report.contacts, report.incomplete, report.given_up) == (3, 2, ["slide_x at 2 N"])
    assert session(tmp_path, Hand(), SHORT).given_up == ["slide_x at 2 N"]


def test_free_motion_alone_needs_no_force_sensor(tmp_path):
    hand = Hand()
    said = "gelsight_mini measures no force.*--free-s 10"
    refused(ForceError, said, record_session, tmp_path / "x", SHORT, [Camera(hand)], None, show=hand.show)
    config = dataclasses.replace(CONFIG, free_s=0.5)
    assert record_session(tmp_path, config, [Camera(hand)], None, show=hand.show).contacts == 1
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    assert (made.key.motion, len(made), made.force_n) == ("free", 51, None)
    assert hand.statuses[0].advice.prompt.endswith("s left; touch nothing yet, for the gel at rest")


CHILD = """
import sys, time
import tests.sensors_io.recording.hand as hand_
from sensors_io.recording.session import record_session
from tests.sensors_io.recording.test_session import CONFIG
hand = hand_.Hand()
def show(status):
    hand.show(status)
    print(*(stream.frames for stream in status.streams), flush=True)
    time.sleep(0.002)
sensors = [hand_.Camera(hand), hand_.Skin(hand)]
record_session(sys.argv[1], CONFIG, sensors, hand_.Scale(hand), show=show)
"""


@pytest.mark.long
def test_a_kill_loses_no_frame_of_any_sensor_that_was_shown(tmp_path):
    """SIGKILL in the middle of the press; every frame that the session had reported is in the records afterwards."""
    root = pathlib.Path(__file__).resolve().parents[3]
    code = CHILD.replace("sys.argv[1]", "__import__('pathlib').Path(sys.argv[1])")
    environment = os.environ | {"PYTHONPATH": str(root)}
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True, env=environment, cwd=root
    )
    shown = [0, 0]
    while shown[0] < 30:
        shown = [int(word) for word in child.stdout.readline().split()]
    child.send_signal(signal.SIGKILL)
    rest = [line.split() for line in child.stdout.read().split("\n")[:-1]]
    assert child.wait() == -signal.SIGKILL
    child.stdout.close()
    last = np.max([shown, *([int(word) for word in line] for line in rest)], axis=0)
    hand = Hand()
    report = record_session(tmp_path, SHORT, [Camera(hand), Skin(hand)], Scale(hand), show=hand.show)
    made = RecordStore(tmp_path).contact(0)
    assert report.recovered == 1
    assert last[0] <= len(made["gelsight_mini"]) <= last[0] + 1
    assert last[1] <= len(made["tac3d"]) <= last[1] + 1
    assert np.all(np.diff(made["gelsight_mini"].frames[:, 0, 0, 0].astype(int)) % 256 == 1)
    assert made["gelsight_mini"].camera["recording"]["torn"]


def both(out, config=SHORT, **rest):
    """A session of a camera, and of a skin that is stamped 30 ms late."""
    hand = Hand()
    sensors = [Camera(hand), Skin(hand, late_ns=30 * MS)]
    report = record_session(out, config, sensors, Scale(hand), show=hand.show, **rest)
    return report, RecordStore(out)


def test_two_sensors_make_one_contact_on_one_clock(tmp_path):
    """The skin feels the hand's force itself: with its lateness taken off it agrees with the force sensor at once."""
    report, store = both(tmp_path, dataclasses.replace(SHORT, late_s={"tac3d": 0.03}))
    assert (report.contacts, report.incomplete) == (2, 0)
    assert store.sensors_of(0) == ("gelsight_mini", "tac3d")
    for i in range(2):
        camera, skin = store.contact(i)["gelsight_mini"], store.contact(i)["tac3d"]
        assert camera.key == skin.key
        assert abs(int(camera.host_time_ns[0]) - int(skin.host_time_ns[0])) <= 10 * MS
        at_camera = np.interp(skin.host_time_ns, camera.host_time_ns, camera.force_n[:, 2])
        inside = (skin.host_time_ns >= camera.host_time_ns[0]) & (skin.host_time_ns <= camera.host_time_ns[-1])
        np.testing.assert_allclose(skin.force_n[inside, 2], at_camera[inside], atol=1e-3)
        assert skin.camera["recording"]["late_s"] == 0.03
        assert skin.camera["recording"]["sensors"] == ["gelsight_mini", "tac3d"]
        assert skin.mm_per_px is None
        assert camera.mm_per_px == 0.0634
    as_stamped = both(tmp_path / "as stamped")[1].contact(0)
    first = [s.host_time_ns[np.argmax(-s.force_n[:, 2] > 0.25)] for s in as_stamped.values()]
    assert first[1] - first[0] == 30 * MS


def test_a_sensor_that_gives_nothing_is_counted(tmp_path):
    class Silent(Camera):
        def drain(self):
            return []

    hand = Hand()
    report = record_session(tmp_path, SHORT, [Camera(hand), Silent(hand, "digit")], Scale(hand), show=hand.show)
    assert (report.contacts, report.absent) == (2, {"digit": 2})


@pytest.mark.parametrize(
    ("stage", "unseen", "again"),
    [
        (ContactStage(motion="slide_x", force_n=2.0), (Phase.MOVE,), 1),
        (ContactStage(motion="slide_x", force_n=2.0), (Phase.UNLOAD,), 0),
        (ContactStage(motion="tap", force_n=20.0), (Phase.LOAD, Phase.UNLOAD), 1),
    ],
)
def test_a_contact_of_which_a_camera_saw_too_little_is_asked_for_again(tmp_path, stage, unseen, again):
    """A motion of half a second but its first moment, not a release of 20 ms; taps whose presses are short."""

    class Blinking(Camera):
        def drain(self):
            samples, shown = super().drain(), self.hand.shown
            gone = shown is not None and not self.hand.contacts and shown.advice.phase in unseen
            return [] if gone else samples

    config = dataclasses.replace(CONFIG, coach=dataclasses.replace(CONFIG.coach, move_s=0.5), stages=(stage,))
    hand = Hand()
    report = record_session(tmp_path, config, [Camera(hand), Blinking(hand, "digit")], Scale(hand), show=hand.show)
    assert (report.contacts, report.incomplete) == (1 + again, again)


class Slow(Camera):
    """Two frames a second, of a camera whose driver does not tell its rate."""

    identity = property(lambda self: Identity(sensor=self.sensor))

    def drain(self):
        return [s for s in super().drain() if s.index % 50 == 0]


class Dark(Slow):
    """As many of a camera that promises a hundred, and exposes for half a second in the dark."""

    identity = Camera.identity


class Late(Camera):
    """A camera whose program gives, and stamps, frames half a second after they were taken."""

    def drain(self):
        return [dataclasses.replace(s, index=s.index - 50) for s in super().drain() if s.index > 50]


@pytest.mark.parametrize(("second", "late_s"), [(Slow, 0.0), (Dark, 0.0), (Late, 0.5)])
def test_a_healthy_sensor_that_is_slow_or_late_completes_its_contacts(tmp_path, second, late_s):
    """The last half second of the late one comes when the contact is over."""
    coach = dataclasses.replace(CONFIG.coach, clear_s=2.0)
    stages = (ContactStage(motion="slide_x", force_n=2.0), ContactStage(motion="tap", force_n=10.0, level=2))
    hand, config = Hand(), dataclasses.replace(CONFIG, stages=stages, late_s={"digit": late_s}, coach=coach)
    report = record_session(tmp_path, config, [Camera(hand), second(hand, "digit")], Scale(hand), show=hand.show)
    assert (report.contacts, report.incomplete, +report.silent) == (2, 0, {})


def test_the_gel_at_rest_and_the_object_are_kept(tmp_path):
    """The gel before each contact, where the force says that nothing touches; extraction finds it by its name."""
    view = ObjectView(
        picture=np.full((6, 8, 3), 90, np.uint8), depth_mm=np.full((6, 8), 300.5, np.float32), region_px=(2, 1, 3, 4)
    )
    coach = dataclasses.replace(CONFIG.coach, clear_s=0.5)
    session(tmp_path, Hand(), dataclasses.replace(SHORT, coach=coach), view=view)
    store = RecordStore(tmp_path)
    made = store.contact(1)["gelsight_mini"]
    name = made.camera["recording"]["background"]
    assert name == "backgrounds/cup-0-slide_x-0-gelsight_mini.png"
    picture = cv2.imread(str(tmp_path / name))
    assert picture.shape == made.frames.shape[1:]
    assert np.all(picture[1:] == 0)
    assert store.objects["cup"].view.tolist() == view.picture.tolist()
    assert store.objects["cup"].view_depth_mm[0, 0] == 300.5
    assert store.contact(0)["gelsight_mini"].contact_region_px == (2, 1, 3, 4)


def test_a_view_completes_the_card_of_an_object_and_a_second_one_is_said_to_be_dropped(tmp_path):
    views = [ObjectView(picture=np.full((6, 8, 3), level, np.uint8)) for level in (90, 120)]
    reports = [
        session(tmp_path, Hand(), dataclasses.replace(SHORT, site=site), view=view)
        for site, view in enumerate([None, *views])
    ]
    assert [report.view_dropped for report in reports] == [False, False, True]
    assert RecordStore(tmp_path).objects["cup"].view[0, 0].tolist() == [90, 90, 90]


def test_records_that_are_refused_get_no_view(tmp_path):
    session(tmp_path, Hand(), SHORT)
    view, other = ObjectView(picture=np.zeros((6, 8, 3), np.uint8)), dataclasses.replace(SHORT, licence="CC0")
    refused(RecordsExistError, "not 'CC0'", session, tmp_path, Hand(), other, view=view)
    assert RecordStore(tmp_path).objects["cup"].view is None


def test_a_force_sensor_out_of_its_range_is_an_alarm_and_a_flag(tmp_path):
    class Strained(Scale):
        def drain(self):
            beyond = self.hand.force_n > 15
            return [
                dataclasses.replace(s, arrays=s.arrays | {"out_of_range": np.array(beyond)}) for s in super().drain()
            ]

    hand = Hand()
    record_session(tmp_path, SHORT, [Camera(hand)], Strained(hand), show=hand.show)
    press, slide = (RecordStore(tmp_path).contact(i)["gelsight_mini"] for i in (0, 1))
    flagged = (press.flags & np.uint32(Flag.INCOMPLETE)) != 0
    assert flagged.any()
    assert np.all(-press.force_n[flagged, 2] > 14)
    assert not np.any(slide.flags)
    assert any("out of its range" in status.alarm for status in hand.statuses)


def test_a_stopped_session_goes_on_behind_what_is_done(tmp_path):
    hand = Hand()
    assert session(tmp_path, hand, stop=lambda: hand.contacts >= 4).contacts == 4
    assert session(tmp_path, Hand()).contacts == 15
    assert len(RecordStore(tmp_path)) == 19


def test_a_device_that_fails_for_good_leaves_its_contact_in_the_records(tmp_path):
    class Failing(Camera):
        def drain(self):
            if self.count > 40:
                raise DeviceLostError("unplugged")
            return super().drain()

    hand = Hand()
    with pytest.raises(DeviceLostError):
        record_session(tmp_path, SHORT, [Failing(hand)], Scale(hand), show=hand.show)
    assert not list((tmp_path / ".journals").iterdir())
    report = session(tmp_path, Hand(), SHORT)
    assert (report.contacts, report.recovered, report.incomplete) == (2, 0, 0)
    store = RecordStore(tmp_path)
    assert len(store.contact(0)["gelsight_mini"]) > 20
    assert not store.contact(0)["gelsight_mini"].camera["recording"]["end"]["complete"]
    assert [(k.motion, k.trial) for k in store.contacts] == [("press", 0), ("press", 1), ("slide_x", 0)]


def test_another_licence_is_refused(tmp_path):
    config = dataclasses.replace(SHORT, stages=SHORT.stages[:1])
    session(tmp_path, Hand(), config)
    other = dataclasses.replace(config, licence="CC0")
    refused(RecordsExistError, "not 'CC0': one directory has one licence", session, tmp_path, Hand(), other)


@pytest.mark.long
def test_a_pause_before_the_first_touch_is_not_recorded(tmp_path):
    """Of a minute without a touch the last 10 to 20 s are kept: all would not fit into memory when it is stored."""

    class Pausing(Hand):
        def move(self):
            super().move()
            self.force_n *= self.time_ns >= 61 * 10**9

    hand = Pausing()
    config = dataclasses.replace(SHORT, stages=SHORT.stages[:1])
    report = session(tmp_path, hand, config)
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    assert (report.contacts, report.incomplete) == (1, 0)
    touched_ns = made.host_time_ns[np.argmax(made.phase == 1)]
    assert 10 <= (touched_ns - made.host_time_ns[0]) / 1e9 <= 20.5
    assert np.all(np.diff(made.frames[:, 0, 0, 0].astype(int)) % 256 == 1)
    assert not np.any(made.flags)
    assert sorted(set(made.phase.tolist())) == [0, 1]


@pytest.mark.parametrize("then", [41, 0])
def test_a_gap_of_the_camera_is_flagged(tmp_path, then):
    """Also that of one that was lost, and counts from the beginning again."""

    class Gappy(Camera):
        def drain(self):
            if self.count == 40:
                self.count = then
            return super().drain()

    hand = Hand()
    record_session(tmp_path, dataclasses.replace(CONFIG, free_s=0.6), [Gappy(hand)], Scale(hand), show=hand.show)
    flags = RecordStore(tmp_path).contact(0)["gelsight_mini"].flags
    assert np.flatnonzero(flags & np.uint32(Flag.TIME_GAP)).tolist() == [40]


def test_a_skin_leads_the_protocol_where_there_is_no_force_sensor(tmp_path):
    hand = Hand()
    report = record_session(tmp_path, SHORT, [Camera(hand), Skin(hand)], None, show=hand.show)
    made = RecordStore(tmp_path).contact(0)
    assert (report.contacts, report.incomplete) == (2, 0)
    assert made["gelsight_mini"].force_n is None
    assert -made["tac3d"].force_n[:, 2].min() == pytest.approx(20, abs=1.1)


def test_sensors_of_one_name_and_records_of_other_sensors_are_refused(tmp_path):
    hand = Hand()
    with pytest.raises(SchemaError, match="name two of one kind apart"):
        record_session(tmp_path, SHORT, [Camera(hand), Camera(hand)], Scale(hand), show=hand.show)
    long = dataclasses.replace(SHORT, object_id="c" * 221)
    refused(SchemaError, "221 and 13 letters: must have at most 233 together", session, tmp_path / "x", hand, long)
    with pytest.raises(SchemaError, match="sensor is 'my camera': must be letters"):
        record_session(tmp_path / "x", SHORT, [Camera(hand, "my camera")], Scale(hand), show=hand.show)
    assert not (tmp_path / "x").exists()
    session(tmp_path, hand, SHORT)
    refused(RecordsExistError, r"recorded-2 gelsight_mini', not 'recorded-2 gelsight_mini\+tac3d'", both, tmp_path)


def test_shards_of_records_that_were_copied_into_others_are_not_deleted(tmp_path, capsys):
    """A kill leaves a shard that no index lists and journals; a copy leaves the shard alone, or one of another name."""
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    for out, name in ((ours, "cup"), (ours, "mug"), (theirs, "can")):
        session(out, Hand(), dataclasses.replace(SHORT, object_id=name))
    shutil.copytree(theirs, ours, dirs_exist_ok=True)
    said = "contacts-00001.arrayrecord, which its index.json does not list"
    refused(RecordsExistError, said, session, ours, Hand(), SHORT)
    assert (main(["check", str(theirs)]), main(["check", str(ours)])) == (0, 1)
    assert said in capsys.readouterr().err.replace("\n", " ")
    (ours / "contacts-00001.arrayrecord").rename(ours / "contacts-00001 (1).arrayrecord")
    assert session(ours, Hand(), SHORT).contacts == 2
    assert (ours / "contacts-00001 (1).arrayrecord").is_file()


def test_an_object_that_differs_from_another_in_capitals_alone_is_refused(tmp_path):
    session(tmp_path, Hand(), SHORT)
    capital = dataclasses.replace(SHORT, object_id="Cup")
    refused(SchemaError, "object_id is 'Cup', and there is 'cup': must differ", session, tmp_path, Hand(), capital)
