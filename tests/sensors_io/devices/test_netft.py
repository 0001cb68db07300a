"""A Net F/T made of two sockets: calibration over TCP, records over UDP."""

import contextlib
import socket
import threading

import numpy as np
import pytest

from sensors_io.devices.errors import DeviceDataError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from sensors_io.devices.netft import CALIBRATION, COMMAND, HEADER, RECORD, Command, NetFtConfig, parse_calibration
from tests.sensors_io.checks import refused

NEWTONS = CALIBRATION.pack(HEADER, 2, 3, 1_000_000, 1_000_000, *[1] * 6)


@contextlib.contextmanager
def sensor(datagrams, calibration=NEWTONS):
    """A fake sensor: its ports, and the commands that it was sent."""
    with socket.create_server(("127.0.0.1", 0)) as tcp, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(5)
        tcp.settimeout(5)
        commands = []

        def serve():
            connection, _ = tcp.accept()
            with connection:
                assert connection.recv(64) == bytes([1]) + bytes(19)
                connection.sendall(calibration)
            if len(calibration) != CALIBRATION.size or calibration[2] == 9:
                return
            data, client = udp.recvfrom(64)
            commands.append(COMMAND.unpack(data))
            for datagram in datagrams:
                udp.sendto(datagram, client)
            while commands[-1][1] != Command.STOP:
                commands.append(COMMAND.unpack(udp.recv(64)))

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield (
                NetFtConfig(host="127.0.0.1", rdt_port=udp.getsockname()[1], tcp_port=tcp.getsockname()[1], wait_s=5.0),
                commands,
            )
        finally:
            thread.join()


def record(number, *counts, status=0, internal=None):
    return RECORD.pack(number, 10 * number % 2**32 if internal is None else internal, status, *counts)


def test_counts_become_newtons_and_newton_millimetres():
    loaded = record(5, 1_000_000, -2_000_000, -7_500_000, 1_000, 0, -2_000_000)
    with sensor([loaded]) as (config, commands), config.open() as device:
        sample = device.read(5.0)
        device.take_zero()
        assert device.identity.settings["counts_per_nmm"] == 1000
    np.testing.assert_allclose(sample.arrays["force_n"], [1, -2, -7.5])
    np.testing.assert_allclose(sample.arrays["moment_nmm"], [1, 0, -2000])
    assert (sample.index, sample.device_time_ns) == (5, 5_000_000)
    assert commands == [(HEADER, Command.STREAM, 0), (HEADER, Command.BIAS, 0), (HEADER, Command.STOP, 0)]


@pytest.mark.parametrize(
    ("earlier", "then", "number"),
    [
        ([(1, 70), (101, 770)], (1, 1470), 201),  # each stream begins at 1, a hundred records after the first ended
        ([(1, 0), (200, 97), (201, 98)], (1, 147), 301),  # 488 internal samples in a second
        ([(1, 70), (9, 126), (7, 112)], (1, 133), 10),  # of the first some were lost, and one was overtaken
        ([(1, 2**32 - 7), (2, 0)], (1, 7), 3),
        ([(1, 2**32 - 14), (2, 2**32 - 7)], (1, 0), 3),  # internal samples run around
        ([(1, 70), (2, 77)], (1, 7), None),  # its power failed
        ([(1, 4 * 10**9), (2, 4 * 10**9 + 7)], (1, 7), None),  # its power failed after six days
        ([(1, 70), (100_001, 700_070)], (1, 1_400_070), None),  # a hundred thousand records at once
        ([(1, 70), (2, 77)], (1, 91), None),  # it was away for longer than the first stream lasted
        ([(1, 0), (2, 0)], (1, 0), None),  # it counts no internal samples
        ([(1, 70)], (1, 777), None),  # how many a record has is not known
    ],
)
def test_a_number_goes_on_when_the_sensor_is_opened_again(earlier, then, number):
    """By its internal samples: a late link is opened again too, and its records are no later than before."""
    with sensor([record(k, *[0] * 6, internal=n) for k, n in earlier]) as (config, _), config.open() as device:
        *_, last = [device.read(5.0) for _ in earlier]
        rate = device._rate
    with sensor([record(then[0], *[0] * 6, internal=then[1])]) as (device._config, _), device:
        found = device.read(5.0)
    assert (device._rate is rate) == (number is not None)  # how late the link was before is still known
    if number is None:  # number and clock begin anew, the clock not where the number would have it
        assert found.index == then[0]
        assert found.device_time_ns - last.device_time_ns == found.host_time_ns - last.host_time_ns
    else:
        assert (found.index, found.device_time_ns) == (number, number * 1_000_000)


def test_a_number_that_runs_around_does_not_set_the_clock_back():
    numbers = [2**32 - 2, 2**32 - 1, 0, 1]
    with sensor([b"".join(record(n, *[0] * 6) for n in numbers)]) as (config, _), config.open() as device:
        found = [device.read(5.0) for _ in numbers]
    assert np.diff([s.device_time_ns for s in found]).tolist() == [1_000_000] * 3
    assert np.diff([s.index for s in found]).tolist() == [1] * 3


def test_buffered_records_are_spread_over_their_periods():
    whole = b"".join(record(k, 0, 0, 0, 0, 0, 0) for k in range(40))
    with sensor([whole]) as (config, _), config.open() as device:
        samples = [device.read(5.0) for _ in range(40)]
    assert [s.index for s in samples] == list(range(40))
    assert np.all(np.diff([s.host_time_ns for s in samples]) == 1_000_000)


def test_status_and_damage_are_told():
    out_of_range = record(1, 0, 0, 0, 0, 0, 0, status=0xC000_0000)
    broken = record(2, 0, 0, 0, 0, 0, 0, status=0x8000_0004)
    with sensor([out_of_range, broken, b"\0" * 35]) as (config, _), config.open() as device:
        assert device.read(5.0).arrays["out_of_range"]
        refused(DeviceDataError, "broken gauge", device.read, 5.0)
        refused(DeviceDataError, "35 bytes: must be records of 36", device.read, 5.0)
        refused(DeviceTimeoutError, "sent nothing", device.read, 0.01)


def test_damaged_calibrations_are_refused():
    refused(DeviceDataError, "of 10 bytes: must have 24", parse_calibration, NEWTONS[:10])
    stated = lambda *start: CALIBRATION.pack(*start, 1, *[1] * 6)
    for header, unit in ((HEADER, 9), (7, 2)):
        refused(DeviceDataError, "header or unit is unknown", parse_calibration, stated(header, unit, 3, 1))
    refused(DeviceDataError, "no counts per unit", parse_calibration, stated(HEADER, 2, 3, 0))


def test_pounds_are_converted():
    found = parse_calibration(CALIBRATION.pack(HEADER, 1, 1, 1000, 1000, *[1] * 6))
    assert found.counts_per_n == pytest.approx(1000 / 4.4482216)
    assert found.counts_per_nmm == pytest.approx(1000 / 112.98483)


def test_an_absent_sensor_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    config = NetFtConfig(host="127.0.0.1", tcp_port=port, wait_s=0.5)
    with pytest.raises(DeviceNotFoundError, match="does not answer"), config.open():
        pass
    with pytest.raises(DeviceNotFoundError, match="label"), NetFtConfig(host="x" * 300).open():  # no name of a host
        pass
    refused(DeviceLostError, "not open", lambda: config.open().read(0.1))
    for rate_hz in (0, float("nan"), float("inf")):
        refused(ValueError, f"rate_hz is {rate_hz}", NetFtConfig, rate_hz=rate_hz)
