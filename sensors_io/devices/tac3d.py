"""A Tac3D sensor, heard over UDP as the vendor's program sends it; `tac3d_messages` says what it sends."""

import dataclasses
import socket
import time
import warnings
from typing import Self

from sensors_io.clock import NS_PER_S
from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import (
    DeviceDataError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    TwoSendersWarning,
)
from sensors_io.devices.tac3d_messages import Assembler, Tac3dDecoder, to_schema

PORT = 9988
PERIOD_S = 0.0327
"""Time between two messages of the vendor's recordings."""

_LARGEST = 65_535  # bytes of a UDP datagram
_SILENT_NS = round(0.6 * NS_PER_S)  # of a sender, as of a lost device: then another one of its serial is taken


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tac3dConfig:
    """The stream of one Tac3D sensor.

    Args:
      serial: of the sensor; empty takes the first that is heard.
      port: on which the vendor's program sends, see its settings.
      address: of the local interface that is listened on.
      wait_s: for the first message, on opening.
    """

    serial: str = ""
    port: int = PORT
    address: str = "127.0.0.1"
    wait_s: float = 3.0

    def open(self) -> "Tac3dSensor":
        """The device, not open yet."""
        return Tac3dSensor(self)


class Tac3dSensor:
    """A Tac3D sensor, heard over UDP; messages of other sensors on the same port are passed over."""

    _RECEIVE_BUFFER = 4 * 1024 * 1024  # bytes: a second of messages, so that a busy host loses none

    def __init__(self, config: Tac3dConfig):
        self._config = config
        self._socket: socket.socket | None = None
        self._decoder, self._assembler = Tac3dDecoder(), Assembler()
        self._sender: tuple[str, int] | None = None
        self._heard_ns = 0  # when it sent last
        self._warned = False
        self._serial = config.serial
        self._first: Sample | None = None

    @property
    def identity(self) -> Identity:
        where = f"udp://{self._config.address}:{self._config.port}"
        return Identity(sensor="tac3d", serial=self._serial, product="Tac3D", where=where, period_s=PERIOD_S)

    def __enter__(self) -> Self:
        c = self._config
        self._assembler = Assembler()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._RECEIVE_BUFFER)
            self._socket.bind((c.address, c.port))
            self._first = self._read_first(time.monotonic() + c.wait_s)
        except OSError as error:
            self._close()
            raise DeviceNotFoundError(
                f"Tac3D: port {c.port} of {c.address} cannot be listened on ({error}); end the program that holds it"
            ) from error
        except DeviceTimeoutError as silence:
            self._close()
            raise DeviceNotFoundError(
                f"Tac3D {c.serial or '(any)'}: nothing heard on port {c.port} in {c.wait_s} s; start the vendor's "
                f"program and let it send there ({silence})"
            ) from silence
        return self

    def __exit__(self, *exc: object) -> None:
        self._close()

    def read(self, timeout_s: float) -> Sample:
        """The next message, see `Device.read`."""
        if self._first is not None:
            sample, self._first = self._first, None
            return sample
        deadline, starting = time.monotonic() + timeout_s, ""
        while True:
            datagram, sender = self._receive(deadline, timeout_s, starting)
            stamp_ns = time.monotonic_ns()
            whole = self._assembler.add(datagram, sender)
            if whole is None:
                continue
            message = self._decoder.decode(*whole)
            if self._serial not in ("", message.serial):
                continue
            if message.initialised < 100:  # its fields are not measured yet
                starting = f"; its program has started to {message.initialised} %"
            elif not self._is_second(sender, stamp_ns):
                self._warned &= sender == self._sender
                self._serial, self._sender, self._heard_ns = message.serial, sender, stamp_ns
                return Sample(
                    host_time_ns=stamp_ns,
                    device_time_ns=round(message.send_time_s * NS_PER_S),
                    index=message.index,
                    arrays=to_schema(message.matrices),
                )

    def _is_second(self, sender: tuple[str, int], stamp_ns: int) -> bool:
        """True if a message comes from a second program of the same serial, which is passed over; warns once."""
        if sender == self._sender or self._sender is None or stamp_ns - self._heard_ns > _SILENT_NS:
            return False
        if not self._warned:
            warnings.warn(
                f"Tac3D {self._serial}: {sender} and {self._sender} send as this serial to port {self._config.port}: "
                f"only what {self._sender} sends is taken; end one of the programs",
                TwoSendersWarning,
                stacklevel=3,
            )
            self._warned = True
        return True

    def _read_first(self, deadline: float) -> Sample:
        """The first whole message; broken ones before it are passed over."""
        broken: DeviceDataError | None = None
        while True:
            try:
                return self.read(max(deadline - time.monotonic(), 0.0))
            except DeviceDataError as error:
                broken = error
            except DeviceTimeoutError as silence:
                raise DeviceTimeoutError(str(broken or silence)) from silence

    def take_zero(self) -> None:
        """Make the sensor take its present state as zero; nothing may touch it."""
        self._command(b"$C")

    def _command(self, command: bytes) -> None:
        if self._socket is None or self._sender is None:
            raise DeviceLostError("Tac3D is not open: read from it before a command is sent")
        self._socket.sendto(command, self._sender)

    def _receive(self, deadline: float, timeout_s: float, starting: str) -> tuple[bytes, tuple[str, int]]:
        if self._socket is None:
            raise DeviceLostError("Tac3D is not open; use it in a with block")
        try:
            self._socket.settimeout(max(deadline - time.monotonic(), 0.0))  # what has come is read, however late
            return self._socket.recvfrom(_LARGEST)
        except (TimeoutError, BlockingIOError) as silence:
            raise DeviceTimeoutError(
                f"Tac3D sent no whole message in {timeout_s:g} s{starting}; look at the vendor's program"
            ) from silence
        except OSError as error:
            raise DeviceLostError(f"Tac3D: its socket failed ({error}); open it again") from error

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
