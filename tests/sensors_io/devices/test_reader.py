"""Three modes of reading, and counts that add up."""

import contextlib
import threading
import time

import numpy as np
import pytest

from sensors_io.clock import NS_PER_S, JumpingClock, MonotonicClock
from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import (
    DeviceDataError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    OverloadWarning,
    StaleFrameError,
    StreamEndedError,
)
from sensors_io.devices.intake import Intake
from sensors_io.devices.reader import Pump, Reader, ReaderConfig
from sensors_io.devices.replay import Disconnect, Faults, Replay
from tests.sensors_io.checks import refused
from tests.sensors_io.devices.fakes import MS, Ramp, Scripted, sample


def pumped(device, capacity=100, clock=None, **config):
    """Everything that a device gives, pumped without a thread."""
    clock = clock or JumpingClock()
    intake = Intake(capacity=capacity, clock=clock)
    pump = Pump(device, intake, ReaderConfig(capacity=capacity, **config), clock, threading.Event())
    pump.open()
    while pump.step():
        pass
    return intake


def drain(intake):
    got = []
    while intake.counts.waiting:
        got.append(intake.next(0.0))
    return got


def test_an_overflowing_ring_counts_what_it_overwrites_and_says_so():
    intake = pumped(Scripted([sample(i) for i in range(10)]), capacity=4)
    assert intake.overloaded
    with pytest.warns(OverloadWarning, match="6 samples were overwritten"):
        assert intake.next(0.0).index == 6
    assert intake.overloaded
    assert intake.next(0.0).index == 7
    assert not intake.overloaded  # half of the ring waits
    assert [s.index for s in intake.drain()] == [8, 9]
    counts = intake.counts
    assert (counts.arrived, counts.delivered, counts.overwritten, counts.unaccounted) == (10, 4, 6, 0)


def test_latest_refuses_an_old_sample_and_names_its_age():
    clock = JumpingClock()
    intake = Intake(capacity=4, clock=clock)
    refused(StaleFrameError, "no sample has arrived", intake.latest, 1.0)
    intake.offer(sample(0, time_ms=0))
    clock.sleep_until(300 * MS)
    assert intake.latest(0.5).index == 0
    refused(StaleFrameError, r"0\.300 s old: at most 0\.1 s", intake.latest, 0.1)


def test_fresh_waits_for_a_sample_grabbed_after_the_call():
    clock = MonotonicClock()
    intake = Intake(capacity=4, clock=clock)
    intake.offer(sample(0, time_ms=clock.now_ns() // MS))
    later = threading.Timer(0.05, lambda: intake.offer(sample(1, time_ms=clock.now_ns() // MS + 1)))
    later.start()
    assert intake.fresh(5.0).index == 1
    later.join()
    time.sleep(0.005)
    asked_s = time.monotonic()
    with pytest.raises(DeviceTimeoutError):
        intake.fresh(0.01)
    assert time.monotonic() - asked_s >= 0.01


def test_losses_by_the_counter():
    """Two missing, one of them late, one duplicate, one broken."""
    script = [sample(0), sample(1), sample(1), sample(4), sample(3), DeviceDataError("torn"), sample(5)]
    counts = pumped(Scripted(script)).counts
    assert (counts.missing, counts.late, counts.duplicates, counts.broken) == (1, 1, 1, 1)
    assert counts.unaccounted == 0


def test_without_a_counter_the_same_picture_is_a_duplicate_and_the_period_tells_losses():
    noise = np.random.default_rng(0).integers(0, 256, (5, 4, 4, 3), dtype=np.uint8)
    script = [sample(time_ms=t, frame=noise[k].copy()) for t, k in [(0, 0), (10, 1), (20, 1), (20, 2), (50, 3)]]
    intake = pumped(Scripted(script, period_s=0.01))
    assert (intake.counts.duplicates, intake.counts.missing) == (1, 2)
    assert len(drain(intake)) == 4


def test_a_camera_whose_stamps_stand_still_loses_no_picture():
    noise = np.random.default_rng(0).integers(0, 256, (90, 4, 4, 3), dtype=np.uint8)
    times = [10 * k for k in range(90) if k != 7]
    stamps = [10 * k if k < 5 or k > 60 else 50 for k in range(90) if k != 7]
    script = [
        sample(None, t, frame=picture, device_time_ns=stamp * MS)
        for t, stamp, picture in zip(times, stamps, noise, strict=False)
    ]
    intake = pumped(Scripted(script, period_s=0.01))
    assert (intake.counts.duplicates, intake.counts.missing) == (0, 1)
    assert [
        t - s.host_time_ns // MS for t, s in zip(times, drain(intake), strict=True) if s.host_time_ns != t * MS
    ] == [10]


@pytest.mark.parametrize(("rate_hz", "coarse_ms"), [(1000, 1), (240, 10), (120, 10)])
def test_stamps_coarser_than_the_period_lose_nothing_and_keep_their_time(rate_hz, coarse_ms):
    """A reader is held up for 200 ms in every second."""
    rng, period = np.random.default_rng(0), round(NS_PER_S / rate_hz)
    taken = np.cumsum(rng.normal(period, 0.02 * period, 10 * rate_hz).astype(np.int64))
    arrival = np.where(taken % NS_PER_S < 200 * MS, taken // NS_PER_S * NS_PER_S + 200 * MS, taken)
    intake = Intake(capacity=len(taken), clock=JumpingClock())
    intake.opened(Identity(sensor="x", period_s=1 / rate_hz))
    for t, host in zip(taken.tolist(), arrival.tolist(), strict=True):
        intake.offer(Sample(host_time_ns=host, device_time_ns=t // (coarse_ms * MS) * coarse_ms * MS))
    late = np.array([s.host_time_ns for s in intake.drain()]) - taken
    assert intake.counts.missing <= 5
    assert np.abs(late[taken > 2 * NS_PER_S]).max() <= coarse_ms * MS


@pytest.mark.parametrize("refusal", [DeviceNotFoundError, DeviceDataError], ids=["absent", "still starting"])
def test_a_lost_device_is_opened_again_with_growing_waits(refusal):
    script = [sample(0), DeviceLostError("unplugged"), sample(7), sample(8)]
    device = Scripted(script, refusals=4, refusal=refusal)
    clock = JumpingClock()
    counts = pumped(device, clock=clock, first_wait_s=0.1, longest_wait_s=0.4).counts
    assert clock.now_ns() == 1500 * MS  # 0.1 + 0.2 + 0.4 + 0.4 + 0.4
    assert (counts.disconnects, counts.reconnects, counts.missing, counts.missing_away) == (1, 1, 6, 6)
    assert device.opened == 2


def test_a_device_that_stays_away_ends_the_stream_with_a_reason():
    intake = pumped(Scripted([DeviceLostError("x"), sample(1)], refusals=1000), give_up_after_s=10)
    refused(DeviceLostError, r"given up after .* absent", intake.next, 0.0)


class Slow(Scripted):
    """Takes all the time that it is given."""

    def __init__(self, script, clock, **rest):
        super().__init__(script, **rest)
        self.clock = clock

    def read(self, timeout_s):
        self.clock.sleep_until(self.clock.now_ns() + round(timeout_s * 1e9))
        return super().read(timeout_s)


def test_a_silent_device_is_taken_as_lost():
    clock = JumpingClock()
    script = [sample(2), *[DeviceTimeoutError("silence")] * 3, sample(3)]
    counts = pumped(Slow(script, clock), clock=clock, timeout_s=0.5, lost_after_s=1.2).counts
    assert (counts.timeouts, counts.disconnects, counts.reconnects) == (3, 1, 1)


@pytest.mark.parametrize(
    "stamps", [(None, None, None, None), (40, 50, 0, 10), (40, 50, 60, 70)], ids=["host's", "anew", "anew, later"]
)
def test_a_counter_that_restarts_on_reconnecting_leaves_the_loss_to_the_clock(stamps):
    """That of the host where the device's began anew too, even if it reads more than before."""
    script = [
        sample(index, time_ms, device_time_ns=stamp if stamp is None else stamp * MS)
        for (index, time_ms), stamp in zip([(4, 40), (5, 50), (0, 110), (1, 120)], stamps, strict=True)
    ]
    script.insert(2, DeviceLostError("x"))
    intake = pumped(Scripted(script, period_s=0.01))
    counts = intake.counts
    assert (counts.restarts, counts.missing, counts.missing_away) == (1, 5, 5)
    assert [s.host_time_ns // MS for s in drain(intake)] == [40, 50, 110, 120]


@pytest.mark.parametrize(
    ("numbers", "counts", "arrival_ms", "lost_at", "times_ms"),
    [
        ([4, 5, 7, 6, 8], True, [40, 50, 70, 78, 80], None, [40, 50, 70, 60, 80]),
        ([4, 5, 6, 7, 8], True, [40, 50, 900, 901, 902], 2, [40, 50, 60, 70, 80]),
        ([4, 5, 6, 7, 8], False, [40, 50, 900, 901, 902], 2, [40, 50, 60, 70, 80]),
        ([4, 5, 0, 1, 2], False, [40, 50, 900, 910, 920], 2, [40, 50, 900, 910, 920]),
        ([4, 5, 6, 7, 8], True, [40, 50, 5060, 5070, 5080], 2, [40, 50, 5060, 5070, 5080]),
    ],
    ids=["overtaken", "held up for longer than a device may be silent", "camera", "its clock anew", "started again"],
)
def test_late_samples_whose_stamps_go_on_have_their_own_times(numbers, counts, arrival_ms, lost_at, times_ms):
    stamped = zip(numbers, arrival_ms, strict=True)
    script = [sample(n if counts else None, time_ms, device_time_ns=10 * n * MS) for n, time_ms in stamped]
    if lost_at is not None:
        script.insert(lost_at, DeviceLostError("x"))
    got = drain(pumped(Scripted(script, period_s=0.01)))
    assert [s.host_time_ns // MS for s in got] == times_ms


@pytest.mark.parametrize("wrong_ms", [-300, -9000])
def test_one_stamp_that_goes_back_is_no_loss(wrong_ms):
    stamp_ms = [10_000 + 10 * k + (wrong_ms if k == 5 else 0) for k in range(9)]
    script = [sample(None, 10 * k, device_time_ns=ms * MS) for k, ms in enumerate(stamp_ms)]
    assert pumped(Scripted(script, period_s=0.01)).counts.missing == 0


@pytest.mark.parametrize("set_by_s", [-3600, 3600])
def test_a_clock_that_is_set_during_a_recording_loses_and_moves_nothing(set_by_s):
    """Samples 3 and 4 are lost while the device's clock is set by an hour."""
    times = [0, 10, 20, 50, 60, 70]
    script = [sample(None, t, device_time_ns=(t + (1000 * set_by_s if t > 20 else 0)) * MS) for t in times]
    intake = pumped(Scripted(script, period_s=0.01))
    assert (intake.counts.missing, intake.counts.lost) == (2, 2)
    assert [s.host_time_ns for s in drain(intake)] == [t * MS for t in times]


def test_device_stamps_are_mapped_to_the_hosts_clock():
    script = [sample(i, time_ms=1000 + 10 * i + late, device_time_ns=10 * i * MS) for i, late in enumerate((4, 0, 9))]
    times = [s.host_time_ns // MS for s in drain(pumped(Scripted(script)))]
    assert times == [1004, 1010, 1020]


@pytest.mark.parametrize("capacity", [5000, 7])
def test_every_injected_fault_is_counted(capacity):
    clock = JumpingClock()
    away = Disconnect(at_s=3, for_s=1.0), Disconnect(at_s=7, for_s=0.2)
    faults = Faults(drop_share=0.02, duplicate_share=0.01, jitter_s=0.002, disconnects=away, seed=4)
    replay = Replay(Ramp(50), seconds=20, faults=faults, clock=clock)
    truth, counts = replay.truth, pumped(replay, capacity=capacity, clock=clock).counts
    assert truth.produced == 2000 == truth.given + truth.dropped + truth.away
    assert counts.missing == truth.dropped + truth.away - truth.unseen
    assert counts.duplicates == truth.duplicated > 0
    assert counts.disconnects == counts.reconnects == truth.disconnects == 2
    assert counts.arrived == truth.given + truth.duplicated
    assert counts.missing_away >= truth.away
    assert counts.unaccounted == 0


def test_a_thread_reads_all_and_a_block_left_early_stops_it():
    clock = JumpingClock()
    replay = Replay(Ramp(200), faults=Faults(drop_share=0.1, seed=1), clock=clock)
    with Reader(replay, config=ReaderConfig(capacity=1000), clock=clock) as reader:
        assert reader.identity.serial == "ramp"
        got = []
        with contextlib.suppress(StreamEndedError):
            while True:
                got.append(reader.next(5.0).index)
    assert got == sorted(got)
    assert len(got) == replay.truth.given == reader.counts.delivered

    with Reader(Replay(Ramp(10**6, rate_hz=1000.0))) as reader:
        assert reader.fresh(5.0).index >= 0
        assert reader.latest(1.0) is not None
        began = time.monotonic()
    assert time.monotonic() - began < 2
    assert not [t for t in threading.enumerate() if t.name.startswith("reader-")]


def test_an_absent_device_and_a_bug_in_a_driver_reach_the_caller():
    absent = Scripted([])
    absent.opened, absent.refusals = 1, 1
    with pytest.raises(DeviceNotFoundError, match="absent"), Reader(absent):
        pass
    with Reader(Scripted([sample(0), ZeroDivisionError("bug")])) as reader:
        assert reader.next(5.0).index == 0
        with pytest.raises(DeviceLostError, match="ZeroDivisionError") as failed:
            reader.next(5.0)
    assert isinstance(failed.value.__cause__, ZeroDivisionError)
