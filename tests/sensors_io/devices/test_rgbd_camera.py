"""The RGB-D camera of the command line: two interfaces of one device, or two folders."""

import cv2
import numpy as np
import pytest

from sensors_io.clock import JumpingClock
from sensors_io.devices.errors import DeviceNotFoundError, StreamEndedError
from sensors_io.devices.rgbd_camera import RgbdCameraConfig
from tests.sensors_io.checks import refused

PINHOLE = {"fx": 10.0, "fy": 10.0, "cx": 4.0, "cy": 3.0, "width": 8, "height": 6}


def test_two_folders_are_one_camera(tmp_path):
    for name in ("colour", "depth"):
        (tmp_path / name).mkdir()
    for n in range(3):
        cv2.imwrite(str(tmp_path / "colour" / f"{n}.png"), np.full((6, 8, 3), n, np.uint8))
        cv2.imwrite(str(tmp_path / "depth" / f"{n}.png"), np.full((6, 8), 250 + n, np.uint16))
    camera = RgbdCameraConfig(replay=tmp_path, depth_unit_mm=2.0, **PINHOLE)
    with camera.open(JumpingClock()) as device:
        samples = [device.read(1.0) for _ in range(3)]
        with pytest.raises(StreamEndedError):
            device.read(1.0)
        assert device.identity.settings["intrinsics"]["fx"] == 10
    assert [s.frame[0, 0, 0] for s in samples] == [0, 1, 2]
    assert [s.arrays["view_depth_mm"][0, 0] for s in samples] == [500, 502, 504]


def test_folders_and_cameras_that_are_absent_are_named(tmp_path):
    (tmp_path / "colour").mkdir()
    refused(DeviceNotFoundError, "depth is no folder", lambda: RgbdCameraConfig(replay=tmp_path, **PINHOLE).open())
    absent = RgbdCameraConfig(product="nobody's D435", colour_interface=3, depth_interface=0, **PINHOLE)
    with pytest.raises(DeviceNotFoundError, match=r"nobody's D435\", interface 3: no camera"), absent.open():
        pass
