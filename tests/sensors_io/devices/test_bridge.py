"""A fake SDK behind the real server, in a process of its own."""

import json
import sys

import numpy as np
import pytest

from sensors_io.devices import bridge
from sensors_io.devices.bridge_server import pack
from sensors_io.devices.errors import DeviceDataError, DeviceLostError, DeviceNotFoundError, DeviceTimeoutError

SDK = "tests.sensors_io.devices.vendor_sdk:frames"


def config(serial, **rest):
    return bridge.BridgeConfig(python=sys.executable, adapter=SDK, serial=serial, **rest)


def test_frames_cross_though_the_sdk_prints(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    with config("3").open() as device:
        samples = [device.read(10.0) for _ in range(3)]
        with pytest.raises(DeviceLostError, match=r"has ended.*vendor banner"):
            device.read(10.0)
    assert [s.index for s in samples] == [0, 1, 2]
    assert samples[1].frame[0, 0].tolist() == [200, 1, 1]
    assert samples[2].arrays["depth_mm"].dtype == np.float32
    assert samples[2].arrays["depth_mm"][0, 0] == 1.0
    assert samples[0].arrays["force_n"].tolist() == [0, 1, 2]
    assert samples[0].arrays["moment_nmm"].tolist() == [3, 4, 5]
    assert all(0 <= s.host_time_ns - s.device_time_ns < 60e9 for s in samples)


def test_an_endless_sdk_ends_with_its_reader(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    with config("1000000").open() as device:
        device.read(10.0)
        process = device._process
    assert process.poll() is not None


def test_a_failing_sdk_says_its_last_words(monkeypatch, request):
    monkeypatch.chdir(request.config.rootpath)
    with pytest.raises(DeviceNotFoundError, match="no such sensor"), config("fails").open():
        pass
    with pytest.raises(DeviceNotFoundError, match="does not start"), bridge.BridgeConfig(python="/nowhere").open():
        pass
    with pytest.raises(DeviceLostError, match="not open"):
        config("3").open().read(0.1)
    assert issubclass(DeviceTimeoutError, RuntimeError)


def split(frame):
    prefix = bridge.bridge_server.PREFIX
    _, header, _ = prefix.unpack_from(frame)
    return frame[prefix.size : prefix.size + header], frame[prefix.size + header :]


def test_any_array_comes_back():
    arrays = {"a": np.arange(6, dtype=np.int16).reshape(2, 3), "b": np.array([True, False])}
    described, found = bridge.unpack(*split(pack(7, 99, "S1", arrays)))
    assert (described["number"], described["stamp_ns"], described["serial"]) == (7, 99, "S1")
    for name, a in arrays.items():
        np.testing.assert_array_equal(found[name], a)


@pytest.mark.parametrize(
    ("header", "payload", "message"),
    [
        (b"{", b"", "cannot be read"),
        (b"{}", b"", "cannot be read"),
        (json.dumps({"number": 1, "stamp_ns": 2, "arrays": []}).encode(), b"x", "1 bytes of arrays"),
        (
            json.dumps({"number": 1, "stamp_ns": 2, "arrays": [{"name": "a", "dtype": "O", "shape": [1]}]}).encode(),
            b"x" * 8,
            "of type object",
        ),
        (
            json.dumps({"number": 1, "stamp_ns": 2, "arrays": [{"name": "a", "dtype": "<f8", "shape": [9]}]}).encode(),
            b"x" * 8,
            "cannot be read",
        ),
    ],
)
def test_damaged_frames_are_refused(header, payload, message):
    with pytest.raises(DeviceDataError, match=message):
        bridge.unpack(header, payload)
