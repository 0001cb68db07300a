"""ATI Net F/T and Ethernet Axia force sensors: raw data transfer (RDT) over UDP.

A command is `>HHI`: 0x1234, command, number of records to send (0 for ever).  A record is `>III6i`: number of the
record, number of the internal sample, status, then Fx Fy Fz Tx Ty Tz in counts.  Counts per newton and per newton metre
stand in the calibration, which the sensor sends over TCP: 20 bytes beginning with 1 are answered by `>HBBII6H`: 0x1234,
unit of force, unit of torque, counts per unit of force, counts per unit of torque, six scales of another protocol.
(ATI document 9620-05-NET FT, sections 10 and 11; 9610-05-Ethernet Axia, sections 4.8 and 10.)
"""

import contextlib
import dataclasses
import enum
import math
import select
import socket
import struct
import time
import warnings
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple, Self

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.devices.base import HELD_NS, Identity, Sample
from sensors_io.devices.errors import (
    DeviceDataError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    WrongRateWarning,
)

RDT_PORT = 49152
TCP_PORT = 49151

COMMAND = struct.Struct(">HHI")
RECORD = struct.Struct(">III6i")
CALIBRATION = struct.Struct(">HBBII6H")
HEADER = 0x1234
_READ_CALIBRATION = bytes([1]) + bytes(19)
_STATUS_ERROR = 1 << 31
_STATUS_RANGE = 1 << 30
_STATUS_MEANING: Mapping[int, str] = {
    0: "temperature out of range",
    1: "supply voltage out of range",
    2: "broken gauge",
    27: "gauge out of range",
    29: "calibration damaged",
    30: "force or torque out of range",
}

_FORCE_UNIT_N: Mapping[int, float] = {
    1: 4.4482216152605, 2: 1.0, 3: 4448.2216152605, 4: 1000.0, 5: 9.80665, 6: 9.80665e-3
}  # fmt: skip
_TORQUE_UNIT_NMM: Mapping[int, float] = {
    1: 112.9848290276, 2: 1355.8179483314, 3: 1000.0, 4: 1.0, 5: 98.0665, 6: 1e6
}  # fmt: skip

_NUMBERS = 2**32  # of records, after which they begin at 0


class Command(enum.IntEnum):
    """Commands of the sensor."""

    STOP = 0x0000
    STREAM = 0x0002
    STREAM_BUFFERED = 0x0003
    BIAS = 0x0042


@dataclasses.dataclass(frozen=True, kw_only=True)
class NetFtScale:
    """Counts per newton and per newton millimetre."""

    counts_per_n: float
    counts_per_nmm: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class NetFtConfig:
    """One sensor.

    Args:
      host: its address.
      rdt_port, tcp_port: as shipped.
      rate_hz: of the records, as set on its configuration page; a rate that the records contradict warns with
        `WrongRateWarning`.
      buffered: several records in one datagram, for rates at which single ones would be lost.
      wait_s: for its answers, on opening.
    """

    host: str = "192.168.1.1"
    rdt_port: int = RDT_PORT
    tcp_port: int = TCP_PORT
    rate_hz: float = 1000.0
    buffered: bool = False
    wait_s: float = 2.0

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz < math.inf:
            raise ValueError(f"rate_hz is {self.rate_hz}: must be > 0 and finite; see the sensor's communication page")

    def open(self) -> "NetFt":
        """The device, not open yet."""
        return NetFt(self)


def parse_calibration(answer: bytes) -> NetFtScale:
    """Counts per SI unit from the sensor's answer.

    Raises:
      DeviceDataError: an answer that is cut off, another header, an unknown unit or no counts.
    """
    if len(answer) != CALIBRATION.size:
        raise DeviceDataError(
            f"NetFT calibration of {len(answer)} bytes: must have {CALIBRATION.size}; check host and tcp_port"
        )
    header, force_unit, torque_unit, per_force, per_torque = CALIBRATION.unpack(answer)[:5]
    if header != HEADER or force_unit not in _FORCE_UNIT_N or torque_unit not in _TORQUE_UNIT_NMM:
        raise DeviceDataError(f"NetFT calibration {answer.hex()}: header or unit is unknown; set N and N m on its page")
    if not per_force or not per_torque:
        raise DeviceDataError(
            f"NetFT calibration {answer.hex()} gives no counts per unit; choose a calibration on its page"
        )
    return NetFtScale(
        counts_per_n=per_force / _FORCE_UNIT_N[force_unit], counts_per_nmm=per_torque / _TORQUE_UNIT_NMM[torque_unit]
    )


class _RateCheck:
    """Compares the numbers of records, over the rate they are said to have, with the times of their arrival.

    No record is early: the least delay in each quarter of a second stays where it was if the rate is right, and drifts
    if it is not.  One step is none: a link that becomes late steps up, and later back to where it was; a machine that
    slept, whose clock stood still, steps down.  Two steps in one direction are a drift.  A record that was there before
    the reader asked may be late by the reader's own delay, so that only an early one means something.
    """

    _EVERY_NS = NS_PER_S // 4
    _LEAST = 8  # datagrams that were waited for: the reader may be held up while it waits
    _ALLOWED_NS = 20_000_000  # the scheduler's share
    _DRIFT = 1e-3  # of two clocks

    def __init__(self, rate_hz: float):
        self._rate_hz = rate_hz
        self._first: tuple[int, int] | None = None  # number and arrival
        self._least: int | None = None  # of this quarter
        self._usual: int | None = None  # the least after the last step
        self._floor = self._step = 0  # the least after the first step and every step down, and the last step
        self._waited = 0  # datagrams that were waited for since the last judgement
        self._until_ns = 0
        self.measured_hz: float | None = None

    def step(self, number: int, arrival_ns: int, waited: bool) -> None:
        """Take a record into account; a wrong rate sets `measured_hz`.

        Args:
          number: of the record; one may overtake another.
          arrival_ns: on the host's clock.
          waited: whether it ends a datagram that the reader waited for.
        """
        if self._first is None:
            self._first, self._until_ns = (number, arrival_ns), arrival_ns + self._EVERY_NS
        records, elapsed_ns = number - self._first[0], arrival_ns - self._first[1]
        late_ns = elapsed_ns - round(records * NS_PER_S / self._rate_hz)
        self._least = late_ns if self._least is None else min(self._least, late_ns)
        self._waited += waited
        early = self._usual is not None and self._least < self._usual
        if arrival_ns < self._until_ns or (self._waited < self._LEAST and not early):
            return
        if self._usual is None:
            self._usual = self._floor = self._least
        allowed_ns = self._ALLOWED_NS + self._DRIFT * elapsed_ns
        step = min(self._least - self._floor, 0) if early else self._least - self._usual
        if abs(step) > allowed_ns:
            if step * self._step > 0:
                self.measured_hz = records * NS_PER_S / elapsed_ns
            self._usual, self._floor, self._step = self._least, min(self._least, self._floor), step
        elif self._usual - self._least > allowed_ns:
            self._usual, self._step = self._floor, 0
        self._least, self._waited, self._until_ns = None, 0, arrival_ns + self._EVERY_NS


class NetFt:
    """A 6-D force sensor; its samples carry `force_n` [3] and `moment_nmm` [3] in its own frame, uncompensated."""

    _RECEIVE_BUFFER = 4 * 1024 * 1024  # bytes: ten seconds at 7 kHz

    def __init__(self, config: NetFtConfig):
        self._config = config
        self._socket: socket.socket | None = None
        self._calibration: NetFtScale | None = None
        self._records: deque[tuple[int, bool, bytes]] = deque()
        self._rate = _RateCheck(config.rate_hz)
        self._first: _Numbered | None = None  # record of the stream
        self._last: _Numbered | None = None
        self._reopened = False  # since the last record

    @property
    def identity(self) -> Identity:
        c = self._config
        counts = {} if self._calibration is None else dataclasses.asdict(self._calibration)
        where = f"udp://{c.host}:{c.rdt_port}"
        return Identity(sensor="netft", product="ATI Net F/T", where=where, settings=counts, period_s=1 / c.rate_hz)

    def __enter__(self) -> Self:
        c = self._config
        self._reopened = True
        try:
            self._calibration = parse_calibration(self._ask_calibration())
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._RECEIVE_BUFFER)
            self._socket.connect((c.host, c.rdt_port))
            self._command(Command.STREAM_BUFFERED if c.buffered else Command.STREAM)
        except (OSError, UnicodeError) as error:  # the second is of a name that no address can have
            self._close()
            raise DeviceNotFoundError(
                f"NetFT at {c.host} does not answer ({error}); look at its power, cable and address"
            ) from error
        return self

    def __exit__(self, *exc: object) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):  # a sensor that is gone streams no more
                self._command(Command.STOP)
        self._close()

    def read(self, timeout_s: float) -> Sample:
        """The next record, see `Device.read`."""
        if not self._records:
            self._receive(timeout_s)
        stamp_ns, waited, record = self._records.popleft()
        sent, internal, status, *counts = RECORD.unpack(record)
        number, *_, began_ns = self._number(sent, internal, stamp_ns)
        if status & _STATUS_ERROR and not status & _STATUS_RANGE:
            raise DeviceDataError(f"NetFT record {sent} has status {status:#010x}: {_meaning(status)}")
        assert self._calibration is not None
        values = np.array(counts, np.float64)
        self._check_rate(number, stamp_ns, waited)
        timed = self._rate.measured_hz is None
        return Sample(
            host_time_ns=stamp_ns,
            device_time_ns=began_ns + round(number * NS_PER_S / self._config.rate_hz) if timed else None,
            index=number,
            arrays={
                "force_n": (values[:3] / self._calibration.counts_per_n).astype(np.float32),
                "moment_nmm": (values[3:] / self._calibration.counts_per_nmm).astype(np.float32),
                "out_of_range": np.array(bool(status & _STATUS_RANGE)),
            },
        )

    def take_zero(self) -> None:
        """Make the sensor take its present load as zero; only `force-zero` leaves a trace in the records."""
        self._command(Command.BIAS)

    def _number(self, sent: int, internal: int, stamp_ns: int) -> "_Numbered":
        """The record, whose number goes on where the sensor's runs around.

        A sensor numbers the records of every stream anew, its internal samples as long as it has power.  Where they go
        on over a reopening, so does the number; otherwise number and clock begin anew.
        """
        last, reopened = self._last, self._reopened
        began_ns, number = 0, sent
        if last is not None:
            steps = self._taken(last, internal, stamp_ns) if reopened else _signed(sent - last.sent)
            if steps is None:
                period_ns = NS_PER_S / self._config.rate_hz
                began_ns = last.began_ns + stamp_ns - last.stamp_ns + round((last.number - sent) * period_ns)
            else:
                began_ns, number = last.began_ns, last.number + steps
            if reopened and (steps is None or self._rate.measured_hz is not None):
                self._rate = _RateCheck(self._config.rate_hz)
        found = _Numbered(number, sent, internal, stamp_ns, began_ns)
        self._first = found if self._first is None or reopened else self._first
        self._last, self._reopened = found, False
        return found

    def _taken(self, last: "_Numbered", internal: int, stamp_ns: int) -> int | None:
        """Records that the sensor took since the last one of the stream before.

        It is `None` if the sensor lost power between them or does not count.  Its internal samples count records
        at that stream's ratio, which is no whole number, over no longer than it lasted.
        """
        assert self._first is not None
        span, gap = _signed(last.internal - self._first.internal), _signed(internal - last.internal)
        if not 0 < gap <= span:
            return None
        taken = max(1, round(gap * (last.number - self._first.number) / span))
        late_ns = stamp_ns - last.stamp_ns - taken * NS_PER_S / self._config.rate_hz
        return taken if abs(late_ns) < HELD_NS else None

    def _check_rate(self, number: int, stamp_ns: int, waited: bool) -> None:
        """Warn once of a wrong rate; from then on a record has the time of its arrival alone."""
        if self._rate.measured_hz is not None:
            return
        self._rate.step(number, stamp_ns, waited)
        if self._rate.measured_hz is not None:
            warnings.warn(
                f"NetFT at {self._config.host} sends about {self._rate.measured_hz:.0f} records a second: rate_hz is "
                f"{self._config.rate_hz:g}; set it to what the sensor's communication page says.  Records are timed "
                "by their arrival until then",
                WrongRateWarning,
                stacklevel=3,
            )

    def _receive(self, timeout_s: float) -> None:
        if self._socket is None:
            raise DeviceLostError("NetFT is not open; use it in a with block")
        try:
            self._socket.settimeout(timeout_s)
            there = select.poll()
            there.register(self._socket, select.POLLIN)
            waited = not there.poll(0)
            datagram = self._socket.recv(65_535)
        except TimeoutError as silence:
            raise DeviceTimeoutError(
                f"NetFT at {self._config.host} sent nothing in {timeout_s} s; check its cable and its page"
            ) from silence
        except OSError as error:
            raise DeviceLostError(
                f"NetFT at {self._config.host} is gone ({error}); check its power and cable"
            ) from error
        stamp_ns = time.monotonic_ns()
        count, rest = divmod(len(datagram), RECORD.size)
        if rest or not count:
            raise DeviceDataError(
                f"NetFT datagram of {len(datagram)} bytes: must be records of {RECORD.size}; check host and rdt_port"
            )
        period_ns = round(NS_PER_S / self._config.rate_hz)
        for k in range(count):  # those of one datagram were taken one period after the other
            record = datagram[k * RECORD.size : (k + 1) * RECORD.size]
            self._records.append((stamp_ns - (count - 1 - k) * period_ns, waited and k == count - 1, record))

    def _ask_calibration(self) -> bytes:
        c = self._config
        with socket.create_connection((c.host, c.tcp_port), timeout=c.wait_s) as connection:
            connection.sendall(_READ_CALIBRATION)
            answer = b""
            while len(answer) < CALIBRATION.size and (part := connection.recv(CALIBRATION.size - len(answer))):
                answer += part
        return answer

    def _command(self, command: Command) -> None:
        if self._socket is None:
            raise DeviceLostError("NetFT is not open; use it in a with block")
        self._socket.send(COMMAND.pack(HEADER, command, 0))

    def _close(self) -> None:
        self._records.clear()
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class _Numbered(NamedTuple):
    """Number of a record; its number and internal sample as sent; its arrival; the time of number 0."""

    number: int
    sent: int
    internal: int
    stamp_ns: int
    began_ns: int


def _signed(difference: int) -> int:
    """Of two numbers that run around: the shorter way."""
    return (difference + _NUMBERS // 2) % _NUMBERS - _NUMBERS // 2


def _meaning(status: int) -> str:
    named = [text for bit, text in _STATUS_MEANING.items() if status >> bit & 1]
    return ", ".join(named) or "unspecified error"
