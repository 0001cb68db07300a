"""Frames of a camera that a link delivers late, and what is taken for the gel at rest."""

import dataclasses

import cv2
import numpy as np
import pytest

from sensors_io.devices.errors import StreamEndedError
from sensors_io.recording.coach import protocol
from sensors_io.recording.session import record_session
from sensors_io.records import RecordStore
from sensors_io.schema import Phase
from tests.sensors_io.recording.hand import MS, Camera, Hand, Scale
from tests.sensors_io.recording.test_session import CONFIG, SHORT


class Held(Camera):
    """Each frame arrives .4 s after it was taken, with a right stamp."""

    waiting, looks = (), 40

    def drain(self):
        self.waiting = (*self.waiting, *super().drain())
        arrived, self.waiting = self.waiting[: -self.looks], self.waiting[-self.looks :]
        return list(arrived)


def test_frames_that_come_when_their_contact_is_over_belong_to_it(tmp_path):
    hand = Hand()
    report = record_session(tmp_path, SHORT, [Held(hand)], Scale(hand), show=hand.show)
    assert (report.contacts, report.incomplete, +report.silent) == (2, 0, {})
    for i, last in ((0, Phase.LOAD), (1, Phase.UNLOAD)):
        made = RecordStore(tmp_path).contact(i)["gelsight_mini"]
        counter = made.frames[:, 0, 0, 0].astype(int)
        assert np.all(np.diff(counter) % 256 == 1)
        assert made.phase[-1] == last
        assert not made.flags.any()
        assert -made.force_n[-1, 2] == pytest.approx(0.0 if i else 20.0, abs=1.1)


@pytest.mark.parametrize("clear_s", [0.5, 1.0])
def test_late_frames_of_a_touch_are_not_taken_for_the_gel_at_rest(tmp_path, clear_s):
    """Those of the gel at rest are, though they come in the middle of the next touch."""

    class Lit(Held):
        """Its pictures are bright while something touches the gel."""

        def drain(self):
            frame = np.full((4, 6, 3), 200 * (self.hand.force_n >= 0.1), np.uint8)
            self.shown = {**getattr(self, "shown", {}), self.hand.time_ns: frame}
            return [dataclasses.replace(s, frame=self.shown[s.host_time_ns - 10 * MS]) for s in super().drain()]

    hand = Hand()
    coach = dataclasses.replace(CONFIG.coach, clear_s=clear_s)
    config = dataclasses.replace(CONFIG, stages=protocol()[:4], coach=coach)
    assert record_session(tmp_path, config, [Lit(hand)], Scale(hand), show=hand.show).contacts == 4
    pictures = [cv2.imread(str(picture)) for picture in (tmp_path / "backgrounds").iterdir()]
    assert len(pictures) == 4
    assert not np.any(pictures)


def test_other_sensors_are_read_while_late_frames_are_waited_for(tmp_path):
    """Else their rings would overflow."""

    class Timed(Camera):
        def drain(self):
            self.read_at = [*getattr(self, "read_at", []), self.hand.time_ns]
            return []

    hand = Hand()
    other = Timed(hand, "digit")
    record_session(tmp_path, SHORT, [Held(hand), other], Scale(hand), show=hand.show)
    assert np.diff(other.read_at).max() <= 10 * MS


def test_a_replay_that_ends_when_the_last_contact_is_over_ended_in_time(tmp_path):
    class Ending(Held):
        looks = 4

        def drain(self):
            if self.hand.contacts == 2:
                raise StreamEndedError("the recording is over")
            return super().drain()

    hand = Hand()
    report = record_session(tmp_path, SHORT, [Ending(hand)], Scale(hand), show=hand.show)
    assert (report.contacts, report.ended) == (2, "")


def test_one_early_picture_is_the_gel_at_rest_for_want_of_a_later_one(tmp_path):
    class Still(Camera):
        """Gives a picture when it changes, as a simulated sensor whose repeated pictures are dropped."""

        lit = None

        def drain(self):
            lit, self.lit = self.lit, self.hand.force_n >= 0.1
            samples = super().drain()
            frame = np.full((4, 6, 3), 200 * self.lit, np.uint8)
            return [dataclasses.replace(s, frame=frame, index=None) for s in samples if lit != self.lit]

    hand = Hand()
    record_session(tmp_path, SHORT, [Still(hand)], Scale(hand), show=hand.show)
    pictures = [cv2.imread(str(picture)) for picture in (tmp_path / "backgrounds").iterdir()]
    assert len(pictures) == 2
    assert not np.any(pictures)


@pytest.mark.parametrize("free_s", [0.0, 3.0])
def test_the_first_frames_of_a_camera_are_not_taken_for_the_gel_at_rest(tmp_path, free_s):
    class Warming(Camera):
        """Three black frames after it was opened; then light that falls off to one side."""

        def drain(self):
            lit = np.broadcast_to(np.linspace(60, 200, 6)[:, None], (4, 6, 3)).astype(np.uint8)
            return [dataclasses.replace(s, frame=lit * np.uint8(s.index > 3)) for s in super().drain()]

    hand = Hand()
    coach = dataclasses.replace(CONFIG.coach, clear_s=0.5)
    config = dataclasses.replace(SHORT, free_s=free_s, coach=coach)
    record_session(tmp_path, config, [Warming(hand)], None if free_s else Scale(hand), show=hand.show)
    for picture in (tmp_path / "backgrounds").iterdir():
        assert cv2.imread(str(picture))[0, :, 0].tolist() == [60, 88, 116, 144, 172, 200]


@pytest.mark.parametrize(("left", "alarmed"), [(0.0, True), (0.7, True), (0.9, False)])
def test_lamps_that_go_out_or_exposure_that_moves_raise_an_alarm(tmp_path, left, alarmed):
    class Fading(Camera):
        """Its light falls to a share of itself after two seconds at rest."""

        def drain(self):
            lit = np.full((4, 6, 3), 100, np.uint8)
            return [
                dataclasses.replace(s, frame=(lit * (left if s.index > 200 else 1)).astype(np.uint8))
                for s in super().drain()
            ]

    hand = Hand()
    config = dataclasses.replace(SHORT, coach=dataclasses.replace(CONFIG.coach, clear_s=4.0))
    record_session(tmp_path, config, [Fading(hand)], Scale(hand), show=hand.show)
    said = {status.alarm for status in hand.statuses if status.alarm}
    assert any("gelsight_mini at rest has changed by" in alarm for alarm in said) == alarmed
