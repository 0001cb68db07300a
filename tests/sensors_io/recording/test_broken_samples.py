"""Samples that a sensor got wrong: the contact is kept, the rows are flagged and counted, later sessions go on."""

import dataclasses
import pathlib
import re

import numpy as np
import pytest

from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import DeviceDataError, DeviceError
from sensors_io.recording.assemble import _gaps, assemble
from sensors_io.recording.journal import JournalError, JournalWriter
from sensors_io.recording.session import record_session
from sensors_io.records import CorruptRecordsError, RecordStore
from sensors_io.schema import Flag, SchemaError
from tests.sensors_io.checks import refused
from tests.sensors_io.recording.hand import MS, Camera, Hand, Scale, Skin
from tests.sensors_io.recording.test_session import CONFIG, SHORT

FREE = dataclasses.replace(CONFIG, free_s=0.5)


class Odd(Skin):
    """A skin whose samples from the 20th to the 22nd are changed."""

    def __init__(self, hand, change):
        super().__init__(hand)
        self.change = change

    def drain(self):
        (sample,) = super().drain()
        return [self.change(sample) if 20 <= self.count < 23 else sample]


def with_arrays(**arrays):
    return lambda sample: dataclasses.replace(sample, arrays={**sample.arrays, **arrays})


def recorded(out, change, config=FREE):
    hand = Hand()
    record_session(out, config, [Camera(hand), Odd(hand, change)], None, show=hand.show)
    return RecordStore(out).contact(0)["tac3d"]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("depth_mm", np.where(np.eye(3), np.nan, 0.5).astype(np.float32)),
        ("depth_mm", np.where(np.eye(3), 40.0, 0.5).astype(np.float32)),
        ("force_n", np.array([np.inf, 0, 0], np.float32)),
    ],
)
def test_values_that_no_sensor_measures_are_flagged_and_counted_and_the_rest_is_kept(tmp_path, name, value):
    made = recorded(tmp_path, with_arrays(**{name: value}))
    rows = np.flatnonzero(made.flags & np.uint32(Flag.INCOMPLETE))
    assert len(rows) == 3
    assert made.camera["recording"]["broken"] == {name: 3}
    assert np.isfinite(made.depth_mm).all()
    assert np.isfinite(made.force_n).all()
    if name == "depth_mm":
        np.testing.assert_array_equal(made.valid[rows[0]], ~np.eye(3, dtype=bool))
        np.testing.assert_allclose(made.depth_mm[rows[0]][made.valid[rows[0]]], 0.5, atol=5e-4)
        assert made.valid[[i for i in range(len(made)) if i not in rows]].all()


@pytest.mark.parametrize(
    "change",
    [
        with_arrays(force_n=np.full(3, np.nan, np.float32)),
        lambda sample: dataclasses.replace(sample, arrays={"depth_mm": sample.arrays["depth_mm"]}),
    ],
)
def test_a_force_that_is_missing_for_a_moment_lets_nothing_go(tmp_path, change):
    hand = Hand()
    report = record_session(tmp_path, SHORT, [Camera(hand), Odd(hand, change)], None, show=hand.show)
    assert (report.contacts, report.incomplete) == (2, 0)


class OddScale(Scale):
    """A scale of which the readings of 50 ms are changed."""

    def __init__(self, hand, change):
        super().__init__(hand)
        self.change = change

    def drain(self):
        odd = lambda sample: 200 * MS <= sample.host_time_ns - 10**9 < 250 * MS
        return [self.change(sample) if odd(sample) else sample for sample in super().drain()]


@pytest.mark.parametrize("name", ["force_n", "moment_nmm"])
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_readings_of_a_force_sensor_that_are_not_finite_are_flagged_and_counted(tmp_path, name, value, recwarn):
    hand = Hand()
    force = OddScale(hand, with_arrays(**{name: np.full(3, value, np.float32)}))
    record_session(tmp_path, FREE, [Camera(hand)], force, show=hand.show)
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    assert np.flatnonzero(made.flags & np.uint32(Flag.INCOMPLETE)).tolist() == [19, 20, 21, 22, 23]
    assert made.camera["recording"]["broken"][name] == 5
    assert made.camera["recording"]["force_residual_n"] == 0
    assert not recwarn.list


def test_a_force_sensor_that_falls_silent_raises_an_alarm(tmp_path):
    class Silent(Scale):
        def drain(self):
            return [s for s in super().drain() if not 200 * MS <= s.host_time_ns - 10**9 < 1500 * MS]

    hand = Hand()
    assert record_session(tmp_path, SHORT, [Camera(hand)], Silent(hand), show=hand.show).contacts == 2
    alarms = [status.alarm for status in hand.statuses]
    assert sum(alarm.startswith("the force sensor is silent: release") for alarm in alarms) in range(20, 40)
    assert alarms[-1] == ""


def test_samples_of_another_shape_are_left_out_and_counted(tmp_path):
    made = recorded(tmp_path, with_arrays(depth_mm=np.zeros((4, 4), np.float32)))
    assert made.camera["recording"]["left_out"] == 3
    assert np.flatnonzero(made.flags & np.uint32(Flag.TIME_GAP)).tolist() == [19]


def test_flags_of_records_that_are_replayed_stay(tmp_path):
    class Replayed(Skin):
        def drain(self):
            flags = np.uint32(Flag.SATURATED if self.count == 10 else 0)
            return [with_arrays(flags=flags)(sample) for sample in super().drain()]

    hand = Hand()
    record_session(tmp_path, FREE, [Camera(hand), Replayed(hand)], None, show=hand.show)
    flags = RecordStore(tmp_path).contact(0)["tac3d"].flags
    assert (np.flatnonzero(flags).tolist(), flags[10]) == ([10], Flag.SATURATED)


class Partly(Camera):
    """A camera that gives its frames for some numbers alone."""

    def __init__(self, hand, there):
        super().__init__(hand, "digit")
        self.there = there

    def drain(self):
        samples = super().drain()
        return samples if self.there(self.count) else []


@pytest.mark.parametrize(
    ("there", "silent", "marked"),
    [
        (lambda n: n < 100, [False, True], [-1]),
        (lambda n: n > 100, [True, False], [0]),
        (lambda n: n < 160, [False, True], [-1]),
        (lambda n: 10 < n < 190, [False, False], []),
    ],
)
def test_a_sensor_that_is_silent_at_either_end_of_a_contact_is_flagged_and_counted(tmp_path, there, silent, marked):
    hand = Hand()
    config = dataclasses.replace(CONFIG, free_s=4.0)
    report = record_session(tmp_path, config, [Camera(hand), Partly(hand, there)], None, show=hand.show)
    assert +report.silent == ({"digit": 1} if any(silent) else {})
    made = RecordStore(tmp_path).contact(0)["digit"]
    assert [s > 0.3 for s in made.camera["recording"]["silent_s"]] == silent
    gaps = np.flatnonzero(made.flags & np.uint32(Flag.TIME_GAP))
    assert gaps.tolist() == [range(len(made))[n] for n in marked]


@pytest.mark.parametrize("period_s", [0.033, None])
def test_a_counter_that_begins_anew_at_the_next_number_hides_no_silence(period_s):
    time_ns = np.array([0, 33, 66, 3100, 3133]) * MS
    assert _gaps(time_ns, [7, 8, 9, 10, 11], period_s).tolist() == [False, False, False, True, False]
    assert not _gaps(np.arange(5) * 2000 * MS, [7, 8, 9, 10, 11], period_s).any()  # of a slow sensor


@pytest.mark.parametrize("late_ms", [lambda n: 7 * n % 10, lambda n: -n % 3 * 9])
def test_a_pause_of_a_sensor_whose_rate_is_unknown_is_flagged(tmp_path, late_ms):
    class Uncounted(Partly):
        """Its times are uneven, as those of a network, or come in bursts of three."""

        identity = property(lambda self: Identity(sensor="digit"))

        def drain(self):
            late_ns = late_ms(self.count) * MS
            return [dataclasses.replace(s, index=None, host_time_ns=s.host_time_ns + late_ns) for s in super().drain()]

    hand = Hand()
    cameras = [Camera(hand), Uncounted(hand, lambda n: not 10 < n <= 16)]
    record_session(tmp_path, FREE, cameras, None, show=hand.show)
    made = RecordStore(tmp_path).contact(0)["digit"]
    assert np.flatnonzero(made.flags).tolist() == [np.argmax(np.diff(made.host_time_ns)) + 1]


def test_old_frames_of_a_camera_do_not_make_the_others_silent(tmp_path):
    class Stale(Camera):
        """Its first frame is ten seconds old."""

        def drain(self):
            return [
                dataclasses.replace(s, host_time_ns=s.host_time_ns - (s.index == 1) * 10**10) for s in super().drain()
            ]

    hand = Hand()
    cameras = [Camera(hand), Stale(hand, "digit")]
    assert not +record_session(tmp_path, SHORT, cameras, Scale(hand), show=hand.show).silent


def test_a_contact_that_cannot_be_stored_keeps_its_journal_and_later_sessions_go_on(tmp_path, monkeypatch):
    refuse = lambda writer, sequences: (_ for _ in ()).throw(SchemaError("frames is None: refused for the test"))
    kept = ["cup-0-press-0.refused", "cup-0-press-0.2.refused", "cup-0-press-0.3.refused"]
    with monkeypatch.context() as patched:
        patched.setattr("sensors_io.records.RecordWriter.write_contact", refuse)
        for name in kept:
            hand = Hand()
            with pytest.raises(SchemaError, match=f"nothing is lost: .*{re.escape(name)}"):
                record_session(tmp_path, SHORT, [Camera(hand)], Scale(hand), show=hand.show)
    assert sorted(p.name for p in (tmp_path / ".journals").iterdir()) == sorted(kept)
    hand = Hand()
    assert record_session(tmp_path, SHORT, [Camera(hand)], Scale(hand), show=hand.show).contacts == 2


@pytest.mark.parametrize("frame", [np.zeros((4, 6, 4), np.uint8), np.zeros((4, 6, 3), np.float32)])
def test_frames_that_are_no_rgb_pictures_do_not_stop_later_sessions(tmp_path, frame):
    class Alien(Camera):
        def drain(self):
            return [dataclasses.replace(sample, frame=frame) for sample in super().drain()]

    hand = Hand()
    said = r"frames.*must be.*nothing is lost: .*cup-0-press-0\.refused"
    refused(SchemaError, said, record_session, tmp_path, SHORT, [Alien(hand)], Scale(hand), show=hand.show)
    hand = Hand()
    assert record_session(tmp_path, SHORT, [Camera(hand)], Scale(hand), show=hand.show).contacts == 2


@pytest.mark.parametrize("force", [np.zeros(6, np.float32), np.float32(-3), np.array(["1", "2", "3"])])
def test_a_force_that_is_no_vector_ends_the_session_in_one_line(tmp_path, force):
    """It was a traceback."""

    class Alien(Scale):
        def drain(self):
            return [dataclasses.replace(s, arrays={**s.arrays, "force_n": force}) for s in super().drain()]

    hand = Hand()
    refused(
        DeviceError, "must be 3 numbers", record_session, tmp_path, SHORT, [Camera(hand)], Alien(hand), show=hand.show
    )
    hand = Hand()
    assert record_session(tmp_path, SHORT, [Camera(hand)], Scale(hand), show=hand.show).contacts == 2


@pytest.mark.parametrize("value", [np.array([["1", "2"]]), np.array([[1], [2, 3]], object)])
def test_fields_that_are_no_numbers_end_the_session_and_leave_the_rest(tmp_path, value):
    """The journal of one such sample could not be read, and stopped every later session."""
    hand = Hand()
    odd = Odd(hand, with_arrays(depth_mm=value))
    said = "depth_mm of tac3d has type .*: must be numbers"
    refused(DeviceDataError, said, record_session, tmp_path, FREE, [Camera(hand), odd], None, show=hand.show)
    assert len(RecordStore(tmp_path, allow_incomplete=True).contact(0)["tac3d"]) == 19
    hand = Hand()
    assert record_session(tmp_path, FREE, [Camera(hand), Skin(hand)], None, show=hand.show).contacts == 1


def test_journals_stay_until_their_contacts_were_read_back(tmp_path, monkeypatch):
    hand = Hand()

    def damaged(store, i):
        raise CorruptRecordsError("the entry's checksum does not hold")

    monkeypatch.setattr("sensors_io.records.RecordStore.contact", damaged)
    with pytest.raises(CorruptRecordsError):
        record_session(tmp_path, SHORT, [Camera(hand)], Scale(hand), show=hand.show)
    assert len(list(pathlib.Path(tmp_path / ".journals").glob("*.journal"))) == 2


class Heavy(Scale):
    """A force sensor of a larger range: 70 N and 600 N mm are nothing unusual to it."""

    def drain(self):
        arrays = {"force_n": np.array([70.0, 0, 1.0], np.float32), "moment_nmm": np.array([0, 600, 0], np.float32)}
        return [Sample(host_time_ns=s.host_time_ns, arrays=arrays) for s in super().drain()]


class Overlapping(Scale):
    """Records of a datagram that was held up are stamped before the last ones of the datagram ahead of it."""

    def drain(self):
        early_ns = 7 * MS if self.hand.time_ns == 10**9 + 200 * MS else 0
        return [dataclasses.replace(s, host_time_ns=s.host_time_ns - early_ns) for s in super().drain()]


def test_frames_before_the_first_force_and_after_the_last_of_a_contact_are_not_flagged(tmp_path):
    """The force sensor is opened last and sends some readings at a time; one frame has a wrong stamp, and stays."""

    class Stale(Camera):
        def drain(self):
            early_ns = 5 * 10**9 if self.count == 30 else 0
            return [dataclasses.replace(s, host_time_ns=s.host_time_ns - early_ns) for s in super().drain()]

    class Buffered(Scale):
        held = ()

        def drain(self):
            self.last_ns = max(self.last_ns, 10**9 + 50 * MS)
            held = [*self.held, *super().drain()]
            whole = len(held) // 20 * 20
            self.held = held[whole:]
            return held[:whole]

    hand = Hand()
    record_session(tmp_path, FREE, [Stale(hand)], Buffered(hand), show=hand.show)
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    assert np.flatnonzero(made.flags).tolist() == np.flatnonzero(np.diff(made.host_time_ns, prepend=0) < 0).tolist()
    assert len(np.flatnonzero(made.flags)) == 1
    assert (len(made), made.camera["recording"]["without_force"]) == (52, 5)


def test_forces_whose_times_overlap_are_kept(tmp_path):
    hand = Hand()
    record_session(tmp_path, FREE, [Camera(hand)], Overlapping(hand), show=hand.show)
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    np.testing.assert_array_equal(made.force_n, np.zeros((len(made), 3)))
    assert not made.flags.any()


def test_times_before_those_of_earlier_frames_are_flagged(tmp_path):
    made = recorded(tmp_path, lambda s: dataclasses.replace(s, host_time_ns=s.host_time_ns - 5 * 10**8))
    assert np.flatnonzero(made.flags).tolist() == [19, 20, 21]


def test_stamps_past_64_bits_leave_the_device_clock_out(tmp_path):
    assert recorded(tmp_path, lambda s: dataclasses.replace(s, device_time_ns=10**20)).device_time_ns is None


def test_forces_and_moments_past_16_bits_are_kept(tmp_path):
    hand = Hand()
    record_session(tmp_path, FREE, [Camera(hand)], Heavy(hand), show=hand.show)
    made = RecordStore(tmp_path).contact(0)["gelsight_mini"]
    np.testing.assert_array_equal(made.force_n[5], np.array([70, 0, 0], np.float32))
    np.testing.assert_array_equal(made.moment_nmm[5], np.array([0, 600, 0], np.float32))
    assert not (made.flags & np.uint32(Flag.INCOMPLETE)).any()


@pytest.mark.parametrize(("kind", "stream"), [("frame", 1), ("frame", "0"), ("picture", 0)])
def test_a_journal_with_an_entry_that_nothing_reads_is_named(tmp_path, kind, stream):
    with JournalWriter(tmp_path / "a.journal") as journal:
        journal.append("start", {"streams": [{"identity": {}}], "key": {}})
        journal.append(kind, {"stream": stream, "time_ns": 1, "index": 0})
    refused(JournalError, f"another layout .*{kind}", assemble, tmp_path / "a.journal")


@pytest.mark.parametrize(
    "picture", [np.zeros((4, 6, 3), np.float32), np.zeros((4, 6), np.uint8), np.zeros((0, 6, 3), np.uint8)]
)
def test_a_journal_whose_background_is_no_picture_is_named(tmp_path, picture):
    with JournalWriter(tmp_path / "a.journal") as journal:
        journal.append("start", {"streams": [{"identity": {"sensor": "xense"}}], "key": {}}, background_0=picture)
        journal.append("frame", {"stream": 0, "time_ns": 1, "index": 0})
    refused(JournalError, r"another layout .*background_0 is .*: must be uint8", assemble, tmp_path / "a.journal")


@pytest.mark.parametrize(
    ("start", "said"),
    [
        (3, "an entry of another layout"),
        ({"streams": [{}]}, "entries of another layout"),
        ({"streams": [{"identity": {}}], "key": {}}, "entries of another layout"),
        ({"key": {}, "identity": {}}, "earlier version"),
    ],
)
def test_a_journal_of_another_layout_is_named(tmp_path, start, said):
    """Its checksums hold, for another version wrote it."""
    with JournalWriter(tmp_path / "a.journal") as journal:
        journal.append("start", start)
        journal.append("frame", {"stream": 0, "time_ns": 1, "index": 0})
    refused(JournalError, said, assemble, tmp_path / "a.journal")
