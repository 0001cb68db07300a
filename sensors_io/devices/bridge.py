"""Sensors whose SDK must live in another Python: a client of `bridge_server.py`, which runs there.

The vendors pin versions of numpy, OpenCV and Python that exclude each other and this project, so that their code runs
in a process of its own and only bytes cross:

    python -m sensors_io view bridge --python ~/xense/bin/python --adapter xense --serial OG000232
    python -m sensors_io view bridge --python ~/dmtac/bin/python --adapter dmtac --sensor dmtac_x --serial S2508080042

That process starts without this project's PYTHONPATH, out of reach of Ctrl-C, and ends with its reader, also a killed
one.  Both read the same monotonic clock, so that a frame keeps the stamp that the server gave it.  A pipe carries
what the sensors send a dozen times over: see `stability_devices`.
"""

import collections
import dataclasses
import json
import math
import os
import pathlib
import select
import selectors
import subprocess
import time
from collections.abc import Mapping
from typing import IO, Any, Self

import cv2
import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.codec import FIELDS
from sensors_io.devices import bridge_server
from sensors_io.devices.base import Identity, Sample, require_pitch
from sensors_io.devices.errors import DeviceDataError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError
from sensors_io.errors import MALFORMED
from sensors_io.schema import FRAME_ARRAYS

_SERVER = pathlib.Path(bridge_server.__file__)
_LARGEST_HEADER = 1 << 16  # bytes: a few names and shapes
_LARGEST_PAYLOAD = 1 << 28  # bytes: 256 MB, ten times the largest camera frame
_KINDS = "biuf"  # of arrays: booleans, integers, floats; never Python objects
_LAST_WORDS = 4096  # bytes of the server's standard error that are kept for a message
_LAST_WORDS_S = 0.5  # that they may come after the end of its answers; its children may live on and hold the pipe
_PIPE_BYTES = 1 << 20  # the most that Linux gives without privileges: a picture of 640 × 480
_FARTHEST_NS = 60 * NS_PER_S  # of a stamp from its arrival
_RELEASE_S = 3.0  # for the SDK to let its sensor go
_OURS = ("PYTHONPATH", "PYTHONHOME")  # would make the vendor's Python import what belongs to this one

_MOMENT_UNIT_NMM = {"resultant": 1.0, "resultant_n_cnm": 10.0}
"""Resultants by the name that an adapter gives them: force in N, moment in this unit."""

_KNOWN = (*FIELDS, "force_n", "moment_nmm")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BridgeConfig:
    """A sensor behind a vendor's SDK.

    Args:
      sensor: canonical name.
      python: the interpreter in which the SDK is installed.
      adapter: "xense", "dmtac", or module:function of your own, see `bridge_server`.
      serial: of the unit.
      rate_hz: of its frames; 0 where unknown.
      wait_s: for the first frame: loading a vendor's network may take long.
      mm_per_px: of the pictures; `None` where unknown.
    """

    sensor: str = "xense"
    python: str = "python3"
    adapter: str = "xense"
    serial: str = ""
    rate_hz: float = 0.0
    wait_s: float = 60.0
    mm_per_px: float | None = None

    def __post_init__(self) -> None:
        require_pitch(self.mm_per_px)
        if not 0 <= self.rate_hz < math.inf:
            raise ValueError(f"rate_hz is {self.rate_hz}: must be ≥ 0 and finite; correct it")

    def open(self) -> "Bridge":
        """The device, not open yet."""
        return Bridge(self)


def unpack(header: bytes, payload: bytes) -> tuple[Mapping[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of one frame.

    Raises:
      DeviceDataError: a header that is no such JSON, or arrays that do not fill the payload.
    """
    try:
        described = json.loads(header)
        arrays, start = {}, 0
        for entry in described["arrays"]:
            dtype, shape = np.dtype(entry["dtype"]), tuple(int(n) for n in entry["shape"])
            if dtype.kind not in _KINDS:
                raise ValueError(f"array {entry['name']} is of type {dtype}")
            count = int(np.prod(shape))
            arrays[str(entry["name"])] = np.frombuffer(payload, dtype, count, start).reshape(shape)
            start += count * dtype.itemsize
        number, stamp_ns = described["number"], int(described["stamp_ns"])
        if number is not None:
            described["number"] = number = int(number)
        if max(abs(number or 0), abs(stamp_ns)) >= 1 << 63:
            raise ValueError(f"number {number} or stamp_ns {stamp_ns} does not fit 64 bits")
    except MALFORMED as error:
        raise DeviceDataError(f"bridge frame cannot be read ({error}); use the server of this version") from error
    if start != len(payload):
        raise DeviceDataError(
            f"bridge frame has {len(payload)} bytes of arrays: must be {start}; use the server of this version"
        )
    return described, arrays


def to_schema(arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray | None, dict[str, np.ndarray]]:
    """Picture in RGB, and the other arrays as the schema has them: float32, a 6-D resultant as force and moment.

    A resultant without a unit is taken as Fx Fy Fz in N, Mx My Mz in N mm: hold it against a known weight.

    Raises:
      DeviceDataError: an array of another name, which no record would keep, or of another shape.
    """
    rest = dict(arrays)
    picture = rest.pop("frame_bgr", None)
    for name, array in rest.items():
        _require_known(name, array)
    grids = {name: array.shape[:2] for name, array in rest.items() if name in FIELDS}
    if len(set(grids.values())) > 1:
        raise DeviceDataError(f"bridge fields have the grids {grids}: must be on one; correct the adapter")
    resultants = {name: rest.pop(name) for name in _MOMENT_UNIT_NMM if name in rest}
    fields = {name: _float32(a) for name, a in rest.items()}
    for name, resultant in resultants.items():
        six = _float32(resultant).ravel()
        if six.size not in (3, 6):
            raise DeviceDataError(
                f"bridge resultant {name} has {six.size} numbers: must have 3 or 6; correct the adapter"
            )
        fields["force_n"] = six[:3]
        if six.size >= 6:
            fields["moment_nmm"] = six[3:6] * np.float32(_MOMENT_UNIT_NMM[name])
    if picture is None:
        return None, fields
    flat = picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] in (1, 3))
    if picture.dtype != np.uint8 or not picture.size or not flat:
        raise DeviceDataError(
            f"bridge picture frame_bgr is {picture.dtype}{list(picture.shape)}: must be uint8 [H, W] or [H, W, 3]; "
            "correct the adapter"
        )
    picture = picture.reshape(picture.shape[:2]) if picture.shape[2:] == (1,) else picture
    code = cv2.COLOR_GRAY2RGB if picture.ndim == 2 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(picture, code), fields


def _require_known(name: str, array: np.ndarray) -> None:
    if name in _MOMENT_UNIT_NMM:
        return
    if name not in _KNOWN:
        known = ", ".join(("frame_bgr", *_MOMENT_UNIT_NMM, *_KNOWN))
        raise DeviceDataError(f"bridge array is named {name!r}: must be one of {known}; correct the adapter")
    dims = FRAME_ARRAYS[name].dims[1:]
    sizes = [size for size, dim in zip(array.shape, dims, strict=False) if dim in (str(size), "h", "w")]
    if array.ndim != len(dims) or len(sizes) != len(dims) or not array.size:
        raise DeviceDataError(
            f"bridge array {name} is {list(array.shape)}: must be [{', '.join(dims)}]; correct the adapter"
        )


def _float32(array: np.ndarray) -> np.ndarray:
    """The array in float32; a number past its range becomes infinite, which the records flag."""
    with np.errstate(over="ignore", invalid="ignore"):
        return array.astype(np.float32)


class Bridge:
    """A vendor's SDK in a process of its own; killed when the device is closed."""

    def __init__(self, config: BridgeConfig):
        self._config = config
        self._process: subprocess.Popen[bytes] | None = None
        self._buffer = bytearray()
        self._words: collections.deque[bytes] = collections.deque(maxlen=16)
        self._selector: selectors.BaseSelector | None = None
        self._first: Sample | None = None

    @property
    def identity(self) -> Identity:
        c = self._config
        period = 1 / c.rate_hz if c.rate_hz > 0 else None
        return Identity(
            sensor=c.sensor,
            serial=c.serial,
            product=f"{c.adapter} SDK",
            where=c.python,
            period_s=period,
            mm_per_px=c.mm_per_px,
        )

    def __enter__(self) -> Self:
        c = self._config
        command = [c.python, str(_SERVER), c.adapter, c.serial]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,  # held open: the server ends when it closes
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                pipesize=_PIPE_BYTES,
                env={name: value for name, value in os.environ.items() if name not in _OURS},
                start_new_session=True,
            )
        except OSError as error:
            raise DeviceNotFoundError(
                f"{c.sensor}: {c.python} does not start ({error}); name the vendor's Python"
            ) from error
        self._buffer.clear()
        self._words.clear()
        self._selector = selectors.DefaultSelector()
        for pipe in self._pipes():
            os.set_blocking(pipe.fileno(), False)
            self._selector.register(pipe, selectors.EVENT_READ)
        try:
            self._first = self.read(c.wait_s)
        except (DeviceTimeoutError, DeviceLostError, DeviceDataError) as error:
            self._close()
            raise DeviceNotFoundError(f"{c.sensor} {c.serial or '(any)'} gave no frame: {error}") from error
        return self

    def __exit__(self, *exc: object) -> None:
        self._close()

    def read(self, timeout_s: float) -> Sample:
        """The next frame, see `Device.read`."""
        if self._first is not None:
            sample, self._first = self._first, None
            return sample
        deadline = time.monotonic() + timeout_s
        while (frame := self._take()) is None:
            self._fill(deadline, timeout_s)
        described, arrays = unpack(*frame)
        picture, fields = to_schema(arrays)
        now_ns = time.monotonic_ns()
        stamp_ns = int(described["stamp_ns"])
        if abs(now_ns - stamp_ns) > _FARTHEST_NS:
            raise DeviceDataError(
                f"bridge frame has stamp_ns {stamp_ns}, {(now_ns - stamp_ns) / NS_PER_S:.0f} s before it came: must be "
                "time.monotonic_ns() when the SDK returned; correct the adapter, unless this process was stopped"
            )
        stamp_ns = min(stamp_ns, now_ns)
        return Sample(host_time_ns=stamp_ns, index=described["number"], frame=picture, arrays=fields)

    def _take(self) -> tuple[bytes, bytes] | None:
        """Header and payload of a whole frame in the buffer."""
        prefix = bridge_server.PREFIX
        if len(self._buffer) < prefix.size:
            return None
        magic, header_size, payload_size = prefix.unpack_from(self._buffer)
        if magic != bridge_server.MAGIC or header_size > _LARGEST_HEADER or payload_size > _LARGEST_PAYLOAD:
            raise DeviceLostError(
                f"{self._config.sensor}: the bridge is out of step ({bytes(self._buffer[:12])!r}); open it again"
            )
        middle, end = prefix.size + header_size, prefix.size + header_size + payload_size
        if len(self._buffer) < end:
            return None
        frame = bytes(self._buffer[prefix.size : middle]), bytes(self._buffer[middle:end])
        del self._buffer[:end]
        return frame

    def _fill(self, deadline: float, timeout_s: float) -> None:
        if self._selector is None or self._process is None:
            raise DeviceLostError(f"{self._config.sensor} is not open; use it in a with block")
        ready = self._selector.select(max(0.0, deadline - time.monotonic()))
        if not ready:
            raise DeviceTimeoutError(
                f"{self._config.sensor}: the bridge sent nothing in {timeout_s} s{self._last_words()}"
            )
        out, _ = self._pipes()
        for key, _ in ready:
            data = os.read(key.fd, _PIPE_BYTES)
            if key.fileobj is not out:
                self._words.append(data[-_LAST_WORDS:])
                if not data:
                    self._selector.unregister(key.fileobj)
            elif data:
                self._buffer += data
            else:
                self._hear_rest()
                raise DeviceLostError(f"{self._config.sensor}: the bridge has ended{self._last_words()}")

    def _pipes(self) -> tuple[IO[bytes], IO[bytes]]:
        process = self._process
        assert process is not None
        assert process.stdout is not None
        assert process.stderr is not None
        return process.stdout, process.stderr

    def _hear_rest(self) -> None:
        """Read the last messages of a server that has ended, which may be unread or still in transit."""
        _, errors = self._pipes()
        deadline = time.monotonic() + _LAST_WORDS_S
        while select.select([errors], [], [], max(0.0, deadline - time.monotonic()))[0]:
            data = os.read(errors.fileno(), _LAST_WORDS)
            if not data:
                return
            self._words.append(data)

    def _last_words(self) -> str:
        words = b"".join(self._words).decode(errors="replace").strip()
        return f"; it said: {words[-_LAST_WORDS:]}" if words else ""

    def _close(self) -> None:
        if self._process is None:
            return
        if self._selector is not None:
            self._selector.close()
            self._selector = None
        assert self._process.stdin is not None
        for pipe in (self._process.stdin, *self._pipes()):
            pipe.close()
        try:
            self._process.wait(timeout=_RELEASE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None
