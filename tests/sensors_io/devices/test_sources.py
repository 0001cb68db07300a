"""Folders, videos, records and scenes replayed as devices."""

import dataclasses
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sensors_io.clock import JumpingClock
from sensors_io.devices.errors import DeviceNotFoundError, StreamEndedError
from sensors_io.devices.replay import Disconnect, Faults, ReplayConfig
from sensors_io.devices.scene import SceneDeviceConfig
from sensors_io.devices.scene_source import SceneSource
from sensors_io.devices.sources import RecordedContact, VideoFile, frame_numbers
from sensors_io.records import RecordWriter
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import Flag
from tests.sensors_io import fakes as records
from tests.sensors_io.checks import refused
from tests.sensors_io.importers.films import cut, film, picture


def everything(device):
    samples = []
    with device:
        while True:
            try:
                samples.append(device.read(10.0))
            except StreamEndedError:
                return samples


def test_a_folder_of_pictures_at_its_rate(tmp_path):
    for n in (9, 10, 11):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full((4, 5, 3), (n, 0, 0), np.uint8))
    (tmp_path / "notes.txt").write_text("no picture")
    samples = everything(ReplayConfig(path=tmp_path, rate_hz=50).open(JumpingClock()))
    assert [s.frame[0, 0].tolist() for s in samples] == [[0, 0, n] for n in (9, 10, 11)]
    assert [s.host_time_ns for s in samples] == [0, 20_000_000, 40_000_000]
    again = everything(ReplayConfig(path=tmp_path, rate_hz=50, seconds=0.2).open(JumpingClock()))
    assert [s.index for s in again] == list(range(10))
    assert [s.frame[0, 0, 2] for s in again] == [9 + n % 3 for n in range(10)]


def test_a_contact_of_records_with_all_of_its_arrays(tmp_path):
    records.write(tmp_path, 2)
    samples = everything(ReplayConfig(path=tmp_path, contact=1, sensor="xense").open(JumpingClock()))
    made = records.sequence(0, "xense", trial=1)
    assert len(samples) == 12
    np.testing.assert_array_equal(samples[5].frame, made.frames[5])
    np.testing.assert_allclose(samples[5].arrays["force_n"], made.force_n[5], atol=1e-3)
    with pytest.raises(DeviceNotFoundError, match="not 'dmtac'"):
        ReplayConfig(path=tmp_path, sensor="dmtac").open(JumpingClock()).__enter__().read(1.0)


def test_records_without_rising_times_are_named_and_single_ones_that_run_back_are_held(tmp_path):
    for name, time_ns in (
        ("still", np.zeros(12, np.int64)),
        ("back", -np.arange(12)),
        ("swapped", np.array([0, 1, 3, 2, *range(4, 12)])),
    ):
        with RecordWriter(tmp_path / name, meta=records.META) as writer:
            writer.write_object(records.card())
            writer.write_contact([records.sequence(host_time_ns=time_ns)])
    for name, said in (("still", "row 11 has 0 ns, row 0 0 ns"), ("back", "row 11 has -11 ns, row 0 0 ns")):
        source = RecordedContact(path=tmp_path / name)
        refused(DeviceNotFoundError, f"contact 0: {said}: the last must", lambda s=source: s.identity)
    samples = everything(ReplayConfig(path=tmp_path / "swapped").open(JumpingClock()))
    assert [s.host_time_ns for s in samples] == [0, 1, 3, 3, *range(4, 12)]


def test_a_single_sample_without_a_period_is_not_repeated_without_end(tmp_path):
    np.savez(tmp_path / "a.npz", index=np.zeros(1), sendTimestamp=np.ones(1))
    assert len(everything(ReplayConfig(path=tmp_path / "a.npz").open(JumpingClock()))) == 1
    with ReplayConfig(path=tmp_path / "a.npz", seconds=1).open(JumpingClock()) as device:
        device.read(1.0)
        refused(StreamEndedError, "seconds", device.read, 1.0)


def test_gaps_of_records_stay_gaps(tmp_path):
    """Of the frames that are flagged, two were lost before 5, and none before 9."""
    made = records.sequence(0, "xense")
    flags = np.zeros(len(made), np.uint32)
    flags[[5, 9]] = Flag.TIME_GAP
    time_ns = np.arange(len(made)) * 40_000_000
    time_ns[5:] += 80_000_000
    counts = frame_numbers(dataclasses.replace(made, flags=flags, host_time_ns=time_ns))
    assert counts.tolist() == [0, 1, 2, 3, 4, 7, 8, 9, 10, 11, 12, 13]
    assert frame_numbers(dataclasses.replace(made, flags=flags, host_time_ns=0 * time_ns))[-1] == len(made) - 1


def test_a_video_without_a_rate_is_named(tmp_path, monkeypatch):
    path = film(tmp_path / "a.avi", 3)
    monkeypatch.setattr(VideoFile, "_open", lambda self: SimpleNamespace(get=lambda what: 0.0, release=lambda: None))
    refused(DeviceNotFoundError, "a.avi states 0 frames a second", lambda: VideoFile(path=path).identity)


@pytest.mark.long
def test_a_generated_sensor_is_a_device():
    scenes = SceneConfig(objects=1, sites=1, frames=3, contact_grid=24)  # of which other tests compile the program
    device = SceneDeviceConfig(sensor="tac3d", scenes=scenes).open(JumpingClock())
    samples = everything(device)
    assert len(samples) == 3
    assert samples[0].frame is None
    assert samples[2].arrays["force_n"][2] < samples[0].arrays["force_n"][2] < 0
    assert round((samples[2].host_time_ns - samples[1].host_time_ns) / 1e5) == 327
    refused(DeviceNotFoundError, "sensor is 'digit'", SceneSource, sensor="digit")


def test_nothing_to_replay_is_named(tmp_path):
    def replayed(path):
        everything(ReplayConfig(path=path).open(JumpingClock()))

    refused(DeviceNotFoundError, "holds no picture", replayed, tmp_path)
    refused(DeviceNotFoundError, "does not exist", replayed, tmp_path / "x")
    for name, said in (("a.avi", "does not open as a video"), ("b.png", "cannot be decoded")):
        (tmp_path / name).write_bytes(b"broken")
        refused(DeviceNotFoundError, said, replayed, tmp_path / name if name == "a.avi" else tmp_path)
    refused(DeviceNotFoundError, r"\(is cut off\)", replayed, cut(picture(tmp_path / "folder" / "a.png")).parent)
    source = RecordedContact(path=records.write(tmp_path / "records", 1), contact=1)
    refused(DeviceNotFoundError, "contact is 1: must be < 1", list, source.samples())


def test_faults_are_checked():
    refused(ValueError, "drop_share is 1.0", Faults, drop_share=1.0)
    refused(ValueError, "jitter_s is -1.0", Faults, jitter_s=-1.0)
    overlapping = Disconnect(at_s=5, for_s=2), Disconnect(at_s=6, for_s=1)
    refused(ValueError, "ascending and apart", Faults, disconnects=overlapping)


@pytest.mark.parametrize("seconds", [0, 60])
def test_a_video_that_is_cut_off_does_not_end_as_a_whole_one(tmp_path, seconds):
    path = cut(film(tmp_path / "a.avi", 40))
    with ReplayConfig(path=path, seconds=seconds).open(JumpingClock()) as device:
        read_all = lambda: [device.read(10.0) for _ in range(41)]
        refused(StreamEndedError, r"is cut off: \d+ of 40 frames could be decoded", read_all)


def test_a_video_at_its_own_rate(tmp_path):
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 20.0, (16, 12))
    for n in range(4):
        writer.write(np.full((12, 16, 3), 40 * n, np.uint8))
    writer.release()
    samples = everything(ReplayConfig(path=path).open(JumpingClock()))
    assert [int(s.frame[0, 0, 0]) for s in samples] == [0, 40, 80, 120]
    assert samples[3].host_time_ns == 150_000_000
