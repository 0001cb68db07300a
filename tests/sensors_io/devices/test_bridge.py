"""A fake SDK behind the real server, in a process of its own."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time
import venv

import numpy as np
import pytest

from sensors_io.devices import bridge
from sensors_io.devices.bridge_server import pack
from sensors_io.devices.errors import DeviceDataError, DeviceLostError, DeviceNotFoundError
from tests.sensors_io.checks import refused

SDK = "tests.sensors_io.devices.vendor_sdk:frames"


def config(serial, **rest):
    return bridge.BridgeConfig(python=sys.executable, adapter=SDK, serial=serial, **rest)


def test_a_failing_sdk_says_its_last_words(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    with pytest.raises(DeviceNotFoundError, match="no such sensor"), config("fails").open():
        pass
    with pytest.raises(DeviceNotFoundError, match=r"gave no frame: .* of type object"), config("objects").open():
        pass
    for clock in ("µs", "wall"):
        stamp = pytest.raises(DeviceNotFoundError, match=r"s before it came: must be time.monotonic_ns")
        with stamp, config(clock).open():
            pass
    with pytest.raises(DeviceNotFoundError, match="does not start"), bridge.BridgeConfig(python="/nowhere").open():
        pass
    refused(DeviceLostError, "not open", lambda: config("3").open().read(0.1))
    refused(ValueError, "rate_hz is -25.0: must be ≥ 0", lambda: config("3", rate_hz=-25.0))


def test_damaged_frames_are_refused():
    header = lambda *arrays: json.dumps({"number": 1, "stamp_ns": 2, "arrays": arrays}).encode()
    kind = lambda dtype, count: header({"name": "a", "dtype": dtype, "shape": [count]})
    refused(DeviceDataError, "cannot be read", bridge.unpack, b"{", b"")
    refused(DeviceDataError, "cannot be read", bridge.unpack, b"{}", b"")
    refused(DeviceDataError, "1 bytes of arrays", lambda: bridge.unpack(header(), b"x"))
    refused(DeviceDataError, "of type object", lambda: bridge.unpack(kind("O", 1), b"x" * 8))
    refused(DeviceDataError, "cannot be read", lambda: bridge.unpack(kind("<f8", 9), b"x" * 8))
    for number, stamp_ns in ((10**30, 2), (1, -(10**30)), ("x", 2)):
        far = json.dumps({"number": number, "stamp_ns": stamp_ns, "arrays": []}).encode()
        refused(DeviceDataError, "cannot be read", bridge.unpack, far, b"")


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("frame", (4, 6, 3)),
        ("frame_bgr", (0, 6, 3)),
        ("temperature", ()),
        ("force_n", (6,)),
        ("depth_mm", (4, 6, 1)),
        ("depth_mm", (0, 6)),
        ("shear_mm", (4, 6, 3)),
        ("kind", (2,)),
    ],
)
def test_arrays_that_no_record_holds_are_refused(name, shape):
    refused(DeviceDataError, f"bridge .*{name}.*correct", bridge.to_schema, {name: np.zeros(shape, np.uint8)})


def test_fields_of_two_grids_are_refused():
    fields = {"depth_mm": np.zeros((4, 6)), "shear_mm": np.zeros((3, 6, 2))}
    refused(DeviceDataError, "must be on one; correct", bridge.to_schema, fields)


XENSESDK = '''
"""What xensesdk offers, without NumPy: arrays that know their type, shape and bytes."""
import enum
class Array:
    def __init__(self, kind, shape, data):
        self.dtype, self.shape, self.data = type("dtype", (), {"str": kind}), shape, data
    def tobytes(self):
        return self.data
class Sensor:
    class OutputType(enum.Enum):
        Rectify, Depth, ForceResultant = 1, 2, 3
    @classmethod
    def create(cls, serial):
        print("xensesdk banner")
        self = cls()
        self.count, self.serial = 0, serial
        return self
    def selectSensorInfo(self, *kinds):
        assert kinds == (self.OutputType.Rectify, self.OutputType.Depth, self.OutputType.ForceResultant)
        self.count += 1
        import struct
        return (
            Array("|u1", (2, 3, 3), bytes([self.count, 0, 200] * 6)),
            Array("<f4", (2, 3), struct.pack("<6f", *[0.25 * self.count] * 6)),
            Array("<f8", (6,), struct.pack("<6d", 1, 2, -3, 4, 5, 6)),
        )
    def release(self):
        open(self.serial, "w").write("released")
'''

DMROBOTICS = '''
"""What dmrobotics 1.2 offers: every getter gives (number, data), every channel is off unless it is asked for."""
import struct, time
from xensesdk import Array
class SensorOptions:
    def __init__(self, dev_id=0, **enabled):
        assert all(enabled[f"enable_{n}"] for n in ("raw", "deformation", "depth", "shear", "force"))
        self.dev_id = dev_id
class Sensor:
    def __init__(self, options):
        assert isinstance(options, SensorOptions)
        self.number = 6
    def wait_for_new(self, last, timeout_ms):
        time.sleep(0.001)
        self.number += self.number == last or last < 0
        return self.number != last
    def _field(self, *last):
        shape = (2, 3, *last)
        count = 6 * (last[0] if last else 1)
        return self.number, Array("<f4", shape, struct.pack(f"<{count}f", *[0.5] * count))
    def getRawImg(self):
        return self.number, type("DMTacImage", (), {"img": Array("|u1", (2, 3), bytes(range(6)))})
    def getDepth(self):
        return self._field()
    def getDeformation2D(self):
        return self._field(2)
    def getShear(self):
        return self._field(2)
    def getForce(self):
        return self.number, Array("<f4", (1, 6), struct.pack("<6f", 0, 0, -5, 1, 2, 3))
    def disconnect(self):
        pass
'''


@pytest.fixture(scope="module")
def vendors(tmp_path_factory):
    """Two Pythons of their own: one with the vendors' SDKs and without NumPy, one bare."""
    home = tmp_path_factory.mktemp("vendors")
    for name in ("with", "without"):
        venv.create(home / name, symlinks=True)
    (site,) = (home / "with" / "lib").glob("python*/site-packages")
    (site / "xensesdk.py").write_text(XENSESDK)
    (site / "dmrobotics.py").write_text(DMROBOTICS)
    return {name: str(home / name / "bin" / "python") for name in ("with", "without")}


def test_xensesdk_in_a_python_of_its_own(vendors, tmp_path, monkeypatch):
    """Also where this Python's path would lead the vendor's astray."""
    (tmp_path / "xensesdk.py").write_text("raise ImportError('the wrong one')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    released = tmp_path / "released"
    bridged = bridge.BridgeConfig(python=vendors["with"], serial=str(released), mm_per_px=0.05)
    with bridged.open() as device:
        first, second = device.read(10.0), device.read(10.0)
        assert device.identity.mm_per_px == 0.05
    assert first.index is None
    assert (first.frame[0, 0].tolist(), second.frame[0, 0].tolist()) == ([200, 0, 1], [200, 0, 2])
    assert second.arrays["depth_mm"].tolist() == [[0.5] * 3] * 2
    assert first.arrays["force_n"].tolist() == [1, 2, -3]
    assert released.read_text() == "released"


def test_dmrobotics_gives_its_own_count_and_its_units(vendors):
    with bridge.BridgeConfig(sensor="dmtac_x", python=vendors["with"], adapter="dmtac").open() as device:
        samples = [device.read(10.0) for _ in range(3)]
    assert [s.index for s in samples] == [7, 8, 9]
    assert samples[0].frame.shape == (2, 3, 3)
    assert samples[0].arrays["deformation_mm"].shape == (2, 3, 2)
    assert samples[0].arrays["moment_nmm"].tolist() == [10, 20, 30]  # from hundredths of a newton metre


READER = """
import sys, time
from sensors_io.devices.bridge import BridgeConfig
with BridgeConfig(python=sys.argv[1], adapter="dmtac").open() as device:
    print(device._process.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.long
def test_a_killed_reader_takes_its_server_along(vendors, request):
    """SIGKILL, while the server's pipe is full and its SDK still working."""
    command = [sys.executable, "-c", READER, vendors["with"]]
    reader = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=request.config.rootpath)
    server = pathlib.Path("/proc", reader.stdout.readline().strip())
    assert server.exists()
    os.kill(reader.pid, signal.SIGKILL)
    reader.wait()
    reader.stdout.close()
    deadline = time.monotonic() + 10
    while server.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not server.exists()


def test_frames_cross_though_the_sdk_prints(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    with config("3").open() as device:
        samples = [device.read(10.0) for _ in range(3)]
        refused(DeviceLostError, r"has ended.*vendor banner", device.read, 10.0)
    assert [s.index for s in samples] == [0, 1, 2]
    assert samples[1].frame[0, 0].tolist() == [200, 1, 1]
    assert samples[2].arrays["depth_mm"].dtype == np.float32
    assert samples[2].arrays["depth_mm"][0, 0] == 1.0
    assert samples[0].arrays["force_n"].tolist() == [0, 1, 2]
    assert samples[0].arrays["moment_nmm"].tolist() == [3, 4, 5]
    now_ns = time.monotonic_ns()
    assert all(0 <= now_ns - s.host_time_ns < 60e9 for s in samples)


def test_an_endless_sdk_ends_with_its_reader(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    with config("1000000").open() as device:
        device.read(10.0)
        process = device._process
    assert process.poll() is not None


def test_any_array_comes_back():
    arrays = {"a": np.arange(6, dtype=np.int16).reshape(2, 3), "b": np.array([True, False])}
    frame, prefix = pack(7, 99, "S1", arrays), bridge.bridge_server.PREFIX
    body, length = frame[prefix.size :], prefix.unpack_from(frame)[1]
    described, found = bridge.unpack(body[:length], body[length:])
    assert (described["number"], described["stamp_ns"], described["serial"]) == (7, 99, "S1")
    for name, a in arrays.items():
        np.testing.assert_array_equal(found[name], a)


def test_a_python_without_the_sdk_is_named(vendors):
    lacking = bridge.BridgeConfig(python=vendors["without"])
    with pytest.raises(DeviceNotFoundError, match=r"without/bin/python.* cannot import xensesdk"), lacking.open():
        pass


def test_last_words_that_come_after_the_end_of_answers_are_heard(tmp_path):
    late = tmp_path / "python"
    late.write_text("#!/bin/sh\nexec 1>&-\nsleep .2\necho no such sensor >&2\n")
    late.chmod(0o755)
    with pytest.raises(DeviceNotFoundError, match="has ended; it said: no such sensor"):
        bridge.BridgeConfig(python=late).open().__enter__()
