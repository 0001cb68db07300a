"""Videos are read whole or refused by name."""

import os
import tracemalloc

import cv2
import numpy as np
import pytest

from sensors_io.devices.sources import VideoFile
from sensors_io.importers import mp4
from sensors_io.importers.keep import Keep
from sensors_io.importers.video import VideoError, read_video
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import cut, film, uneven_film

WHOLE = {"height": 0, "stride": 1, "max_frames": 0}


def test_every_frame_is_kept_in_rgb(tmp_path):
    video = read_video(film(tmp_path / "a.avi", 12), Keep(**WHOLE))
    assert video.frames.shape == (12, 24, 32, 3)
    assert video.frames.dtype == np.uint8
    assert video.index.tolist() == list(range(12))
    assert (video.rate_hz, video.size_px, video.total) == (25, (24, 32), 12)
    np.testing.assert_allclose(video.frames[:, 20, 20].mean(axis=1), 20 + 10 * np.arange(12), atol=3)
    red, green, blue = video.frames[5, 2, 2].astype(int)
    assert red > 200 > 80 > max(green, blue)


@pytest.mark.parametrize(
    ("options", "index"),
    [
        ({"stride": 5}, [0, 5, 10]),
        ({"max_frames": 4}, [0, 4, 7, 11]),
        ({"stride": 2, "max_frames": 3}, [0, 4, 10]),
        ({"max_frames": 1}, [0]),
        ({"max_frames": 99}, list(range(12))),
    ],
)
def test_frames_are_thinned_as_asked(tmp_path, options, index):
    film(tmp_path / "a.avi", 12)
    every = read_video(tmp_path / "a.avi", Keep(**WHOLE))
    video = read_video(tmp_path / "a.avi", Keep(**WHOLE | options))
    assert video.index.tolist() == index
    np.testing.assert_array_equal(video.frames, every.frames[index])


def test_shrinking_keeps_the_aspect_ratio_and_takes_area_means(tmp_path):
    path = film(tmp_path / "a.avi", 3)
    every, small = (read_video(path, Keep(**WHOLE | {"height": height})) for height in (0, 12))
    assert small.frames.shape == (3, 12, 16, 3)
    assert small.size_px == (24, 32)
    np.testing.assert_allclose(small.frames, every.frames.reshape(3, 12, 2, 16, 2, 3).mean(axis=(2, 4)), atol=0.51)


def test_a_film_cut_short_is_named(tmp_path):
    said = r"is cut off: \d+ of 40 frames|holds no frame|does not open"
    refused(VideoError, said, read_video, cut(film(tmp_path / "a.avi", 40)), Keep(**WHOLE))


UNEVEN_MS = [*range(0, 660, 33), *range(660, 2660, 100), *range(2660, 3060, 20)]


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
@pytest.mark.parametrize("replay", [False, True])
def test_a_video_of_uneven_times_is_whole_and_keeps_them(tmp_path, name, replay):
    """Phones and recorders of screens write them; Matroska states no number of frames."""
    path = uneven_film(tmp_path / name, UNEVEN_MS)
    if replay:
        times_ns = [sample.time_ns for sample in VideoFile(path=path).samples()]
    else:
        times_ns = read_video(path, Keep(**WHOLE)).time_ns
    np.testing.assert_array_equal(times_ns, np.array(UNEVEN_MS) * 1_000_000)


@pytest.mark.parametrize(("first_ms", "sound_s", "whole"), [(0, 2.1, True), (5000, 0.0, True), (0, 2.8, False)])
def test_sound_may_last_a_little_longer_and_pictures_begin_late(tmp_path, first_ms, sound_s, whole):
    path = uneven_film(tmp_path / "a.mkv", range(first_ms, first_ms + 2000, 40), sound_s)
    if whole:
        assert read_video(path, Keep(**WHOLE)).total == 50
        path.write_bytes(path.read_bytes()[:-1])
    refused(VideoError, "is cut off, or its sound is longer", read_video, path, Keep(**WHOLE))


@pytest.mark.parametrize("lost", [0, 1])
def test_an_avi_file_states_frames_that_were_dropped_too(tmp_path, lost):
    """Before compressed sound comes an entry without a picture, as in the place of each dropped frame."""
    path = uneven_film(tmp_path / "a.avi", range(0, 1200, 40), sound_s=1.2)
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) > 30
    if lost:
        data = path.read_bytes()
        last = data.rindex(b"00dc", 0, data.index(b"idx1"))
        path.write_bytes(data[: last + 8] + bytes(len(data[last + 8 :])))
        refused(VideoError, "is cut off", read_video, path, Keep(**WHOLE))
    else:
        assert read_video(path, Keep(**WHOLE)).total == 30


def test_an_mp4_in_fragments_is_whole_whatever_its_sound_and_refused_where_it_is_cut(tmp_path):
    path = uneven_film(tmp_path / "a.mp4", range(0, 2000, 40), 4.0, movflags="frag_keyframe+empty_moov")
    assert read_video(path, Keep(**WHOLE)).total == 50
    data = path.read_bytes()
    ends = data.rindex(b"mfra"), data.rindex(b"mdat") - 4
    for end in (*ends, ends[0] - 4, *range(len(data) - 1, 1000, -499)):
        path.write_bytes(data[:end])
        refused(VideoError, "is cut off|no frame|not open", read_video, path, Keep(**WHOLE))
    for box in (b"hdlr", b"tfhd", b"stbl"):
        path.write_bytes(data.replace(box, b"free"))
        assert not mp4.is_cut_off(path, 50, 50)


@pytest.mark.parametrize("cut_off", [0, 1])
def test_pictures_that_an_edit_list_trims_are_not_lost(tmp_path, cut_off):
    path = uneven_film(tmp_path / "a.mp4", range(0, 2000, 40), movflags="faststart")
    data = bytearray(path.read_bytes())
    begin, scale = data.index(b"elst") + 16, data.index(b"mdhd") + 16
    data[begin : begin + 4] = (int.from_bytes(data[scale : scale + 4]) * 2 // 5).to_bytes(4)
    path.write_bytes(data[: len(data) - cut_off])
    if cut_off:
        refused(VideoError, "is cut off: 40 of 50", read_video, path, Keep(**WHOLE))
    else:
        assert read_video(path, Keep(**WHOLE)).total == 40


def test_a_matroska_file_of_unknown_size_is_as_whole_as_its_frames(tmp_path):
    """A recorder that is killed, or that writes into a pipe, leaves it."""
    path = uneven_film(tmp_path / "a.mkv", range(0, 2000, 40))
    segment, data = b"\x18\x53\x80\x67\x01", path.read_bytes()
    at = data.index(segment) + len(segment)
    path.write_bytes(data[:at] + b"\xff" * 7 + data[at + 7 :])
    assert read_video(path, Keep(**WHOLE)).total == 50


def test_a_long_video_takes_the_memory_of_the_frames_that_are_kept(tmp_path):
    """600 frames of 58 kB, of which 32 are kept."""
    film(tmp_path / "a.avi", 600, size=(120, 160))
    tracemalloc.start()
    video = read_video(tmp_path / "a.avi", Keep())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (len(video.frames), video.total, video.index[-1]) == (32, 600, 599)
    assert peak < 3 * video.frames.nbytes


@pytest.mark.parametrize("data", [None, b"", b"no video at all" * 99])
def test_broken_files_are_named(tmp_path, data):
    path = tmp_path / "a.avi"
    if data is not None:
        path.write_bytes(data)
    refused(VideoError, "does not open as a video", read_video, path, Keep(**WHOLE))
    os.mkfifo(tmp_path / "b.avi")  # who opens it waits, maybe for ever
    refused(VideoError, "is a folder, a pipe or a device", read_video, tmp_path / "b.avi", Keep(**WHOLE))


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({cv2.CAP_PROP_FPS: 0.0}, "states a frame rate of 0.0"),
        ({cv2.CAP_PROP_FPS: float("nan")}, "states a frame rate of nan"),
        ({cv2.CAP_PROP_FRAME_COUNT: 13.0}, "is cut off: 12 of 13 frames"),
    ],
)
def test_what_the_container_states_is_checked(tmp_path, monkeypatch, stated, message):
    film(tmp_path / "a.avi", 12)

    opened = cv2.VideoCapture

    class Capture:  # not a subclass: OpenCV's own class does not survive being one
        def __init__(self, name):
            self.capture = opened(name)

        def __getattr__(self, name):
            return getattr(self.capture, name)

        def get(self, what):
            return stated.get(what, self.capture.get(what))

    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    refused(VideoError, message, lambda: read_video(tmp_path / "a.avi", Keep(**WHOLE)))
