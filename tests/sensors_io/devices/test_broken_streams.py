"""Messages that break a protocol end no stream and are counted once."""

import collections
import contextlib
import socket
import struct
import time

import numpy as np
import pytest

from sensors_io.clock import JumpingClock
from sensors_io.devices import tac3d_messages
from sensors_io.devices.base import Identity
from sensors_io.devices.errors import DeviceDataError, TwoSendersWarning, WrongRateWarning
from sensors_io.devices.intake import Intake
from sensors_io.devices.netft import _RateCheck
from sensors_io.devices.reader import Reader
from sensors_io.devices.replay import Replay
from sensors_io.devices.sources import Tac3dRecording
from tests.sensors_io.checks import refused
from tests.sensors_io.devices.fakes import sample, sent
from tests.sensors_io.devices.test_netft import record, sensor
from tests.sensors_io.devices.test_tac3d import datagrams, layout, listening, pushed

FINE = pushed([0, 0, -1], [0, 0, -0.1])


def message(arrays=FINE, **rest):
    return lambda number: datagrams(arrays, **{"number": number, "index": number} | rest)


@pytest.mark.parametrize(
    "bad",
    [
        message(time_s="nan"),
        message(time_s="inf"),
        message(time_s=1e11),
        message(index=10**30),
        message({**FINE, "3D_Displacements": np.zeros((399, 3))}),
        message({**FINE, "3D_ResultantForce": np.zeros((2, 2))}),
        message({**FINE, "InitializeProgress": np.array([[np.nan]])}),
        message({**FINE, "InitializeProgress": np.zeros((0, 1))}),
        lambda number: [b"\0" * 3],
    ],
)
def test_a_broken_tac3d_message_ends_no_stream(vendor, bad):
    sender, port = vendor
    with sent(sender, bad, message()), Reader(listening(port)) as reader:
        forces = [reader.next(5.0).arrays["force_n"].tolist() for _ in range(4)]
        counts = reader.counts
    assert forces == [[0, 0, -1]] * 4
    assert counts.broken >= 2


def test_a_broken_sample_is_lost_once():
    intake = Intake(capacity=9, clock=JumpingClock())
    for index in (0, 1, None, 3, 6):
        intake.broke() if index is None else intake.offer(sample(index))
    assert (intake.counts.missing, intake.counts.broken, intake.counts.lost) == (2, 1, 3)


def test_a_broken_sample_that_a_period_counts_is_taken_back_once():
    """What comes early takes back one that was counted as missing, and then as broken."""
    intake = Intake(capacity=9, clock=JumpingClock())
    intake.opened(Identity(sensor="xense", period_s=0.01))
    for time_ms in (0, 10, 20, None, 40, 42):
        intake.broke() if time_ms is None else intake.offer(sample(time_ms=time_ms))
    assert (intake.counts.missing, intake.counts.broken, intake.counts.lost) == (0, 1, 1)


def test_messages_of_a_program_that_still_starts_are_no_samples(vendor):
    sender, port = vendor
    starting = message({**FINE, "InitializeProgress": np.array([[40.0]])})
    with sent(sender, starting, message()), listening(port) as device:
        assert {device.read(5.0).index % 2 for _ in range(4)} == {0}


def test_messages_that_came_while_a_reader_was_held_up_are_read(vendor):
    """Of more than one datagram, with no time left: they were taken for silence, and lost with the socket."""
    sender, port = vendor
    with contextlib.ExitStack() as stack:
        with sent(sender, message()):
            device = stack.enter_context(listening(port))
        for datagram in message()(10**6):
            sender.send(datagram)
        while device.read(0.0).index < 10**6:
            pass


def test_two_programs_on_one_port_do_not_mix():
    assembler = tac3d_messages.Assembler()
    a, b = datagrams(FINE, number=1, serial="A"), datagrams(FINE, number=1, serial="B")
    found = [assembler.add(d, s) for pair in zip(a, b, strict=True) for d, s in zip(pair, "ab", strict=True)]
    serials = [tac3d_messages.Tac3dDecoder().decode(*whole).serial for whole in found if whole is not None]
    assert serials == ["A", "B"]


def test_two_programs_behind_one_address_are_named():
    assembler = tac3d_messages.Assembler()
    ours, theirs = (datagrams(pushed([0, 0, -n], [0, 0, -n]), number=7, index=7) for n in (1, 2))
    assert assembler.add(ours[0]) is assembler.add(ours[1]) is assembler.add(ours[1]) is None
    refused(DeviceDataError, "packet 1 of message 7 came twice with other bytes", assembler.add, theirs[1])
    assert [assembler.add(part) for part in ours[2:]] == [None, None]


def test_a_second_program_of_one_serial_is_passed_over_until_the_first_is_silent(vendor):
    sender, port = vendor
    twin = lambda number: datagrams(pushed([0, 0, -2], [0, 0, -0.1]), number=number, index=number)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.connect(("127.0.0.1", port))
        with contextlib.ExitStack() as first:
            first.enter_context(sent(sender, message()))
            with listening(port) as device, sent(other, twin):
                pressed = lambda: float(device.read(5.0).arrays["force_n"][2])
                with pytest.warns(TwoSendersWarning, match="send as this serial"):
                    assert {pressed() for _ in range(20)} == {-1}
                first.close()
                assert any(pressed() == -2 for _ in range(200))


@pytest.mark.parametrize("lost", [(), (3, 20)])
def test_a_counter_that_restarts_without_a_silence_costs_a_quarter_of_a_second(lost):
    intake = Intake(capacity=99, clock=JumpingClock())
    numbers = [n for n in range(50) if n not in lost] + [*range(50)]
    for k, number in enumerate(numbers):
        intake.offer(sample(number, time_ms=30 * k))
    late = len(lost[:1])  # its number comes again before the restart is seen
    assert (intake.counts.restarts, intake.counts.duplicates, intake.counts.late) == (1, 9 - late, late)


def test_an_old_number_after_a_silence_is_a_duplicate():
    intake = Intake(capacity=99, clock=JumpingClock())
    for number, time_ms in [*((n, 30 * n) for n in range(10)), (8, 800), (11, 830), (12, 860)]:
        intake.offer(sample(number, time_ms=time_ms))
    assert (intake.counts.restarts, intake.counts.duplicates, intake.counts.missing) == (0, 1, 1)


@pytest.mark.parametrize("rate", [0, 0.5])
def test_a_slow_clock_is_named_once(rate):
    """Also where one message overtakes another."""
    intake = Intake(capacity=99, clock=JumpingClock())
    intake.opened(Identity(sensor="tac3d", period_s=0.033))
    numbers = [*range(100), 101, 100, *range(102, 200)]
    stamped = [(n, round(33 * n * rate * 1e6)) for n in numbers]
    samples = [sample(n, time_ms=33 * k, device_time_ns=ns) for k, (n, ns) in enumerate(stamped)]
    with pytest.warns(WrongRateWarning, match="fall behind") as warned:
        [intake.offer(one) for one in samples]
    assert len(warned) == 1


@pytest.mark.parametrize("hz", [40, 50, 100])
def test_a_device_that_sends_faster_than_it_is_said_to_loses_no_less_than_nothing(hz):
    """Said to send at 32 Hz, without a number: each sample beyond that took back a loss that there had not been."""
    intake = Intake(capacity=999, clock=JumpingClock())
    intake.opened(Identity(sensor="digit", period_s=1 / 32))
    times = [1000 * k // hz for k in range(10 * hz)]
    with pytest.warns(WrongRateWarning, match="digit sends faster than the 32 Hz that it states") as warned:
        collections.deque((intake.offer(sample(time_ms=ms)) for ms in times), maxlen=0)
    assert (len(warned), intake.counts.missing) == (1, 0)
    for ms in times:
        intake.offer(sample(time_ms=40_000 + ms))  # after half a minute
    assert 29 * 32 <= intake.counts.missing <= 31 * 32


def test_a_layout_of_spaces_is_read_in_linear_time():
    spaces = layout({"3D_ResultantForce": np.ones((1, 3))}).replace(b'msg: ""', b"msg:" + b" " * 64_500 + b"x")
    began = time.process_time()
    assert tac3d_messages.Tac3dDecoder().decode(spaces, struct.pack("<3d", 1, 2, 3)).note == "x"
    assert time.process_time() - began < 1.0


def test_a_repeated_replay_keeps_the_gaps_of_the_recording(tmp_path):
    np.savez(tmp_path / "a.npz", index=[3, 4, 7], sendTimestamp=[0.0, 0.03, 0.12])
    with Replay(Tac3dRecording(path=tmp_path / "a.npz"), seconds=0.4, clock=JumpingClock()) as device:
        assert [device.read(1.0).index for _ in range(6)] == [3, 4, 7, 8, 9, 12]


@pytest.mark.parametrize("waited", [0, 50])
def test_a_record_that_another_overtook_or_that_waited_is_no_wrong_rate(waited):
    class OnTime(list):
        """The record of each moment, 1,000 a second, the first two in the wrong order and late by some ms."""

        def __iter__(self):
            began = time.monotonic()
            for k in super().__iter__():
                yield record(6 - k if k < 2 else 6 + waited + round(1000 * (time.monotonic() - began)), *[0] * 6)
                time.sleep(0.005)

    with sensor(OnTime(range(80))) as (config, _), config.open() as device:
        stamps = [device.read(5.0).device_time_ns for _ in range(80)]
    assert stamps[:2] == [6_000_000, 5_000_000]
    assert None not in stamps


def test_a_reader_that_was_held_up_does_not_call_the_rate_wrong():
    class OnTime(list):
        """Records 1000 times a second."""

        def __iter__(self):
            began = time.monotonic()
            for k in super().__iter__():
                time.sleep(max(0.0, began + k / 1000 - time.monotonic()))
                yield record(k, *[0] * 6)

    with sensor(OnTime(range(2200))) as (config, _), config.open() as device:
        stamps = []
        for k in range(2200):
            if 600 <= k < 1800:  # it is half a second late, and catches up within a second
                time.sleep(0.5 if k == 600 else 0.0004)
            stamps.append(device.read(5.0).device_time_ns)
    assert None not in stamps


def test_a_reader_that_waits_no_more_still_sees_that_records_come_too_early():
    check = _RateCheck(1000.0)
    for k in range(7000):  # 7,000 a second, waited for in the first .3 s alone
        check.step(k, k * 10**9 // 7000, waited=k < 2100)
    assert check.measured_hz == pytest.approx(7000, rel=0.01)


@pytest.mark.parametrize(
    ("late_ms", "begin_s", "end_s", "slept_s"), [(200, 2.02, 4.02, 0), (30, 2, 5, 0), (1000, 0, 3, 0), (0, 0, 0, 60)]
)
def test_a_link_that_is_late_and_a_machine_that_slept_are_no_wrong_rate(late_ms, begin_s, end_s, slept_s):
    """Its clock stands still while a machine sleeps."""
    check, arrival_ns = _RateCheck(1000.0), 0
    for k in range(8000):
        due_ns = (k + late_ms * (begin_s <= k / 1000 < end_s)) * 10**6
        waited = due_ns > arrival_ns
        arrival_ns = due_ns if waited else arrival_ns + 2 * 10**5  # so long takes a record that had waited
        check.step(k + 1000 * slept_s * (k >= 3000), arrival_ns, waited)
    assert check.measured_hz is None


def test_a_wrong_rate_of_a_force_sensor_warns_and_leaves_its_stamps_out():
    class Slow(list):
        """Records every 10 ms: 100 a second."""

        def __iter__(self):
            for datagram in super().__iter__():
                time.sleep(0.01)
                yield datagram

    with (
        sensor(Slow(record(k, *[0] * 6) for k in range(110))) as (config, _),
        config.open() as device,
        pytest.warns(WrongRateWarning, match="rate_hz is 1000"),
    ):
        stamps = [device.read(5.0).device_time_ns for _ in range(110)]
    assert stamps[0] == 0
    assert stamps[-5:] == [None] * 5
