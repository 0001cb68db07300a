"""The RGB-D camera of the command line: two interfaces of one device, or two folders."""

import pytest

from sensors_io.devices.errors import DeviceNotFoundError
from sensors_io.devices.rgbd_camera import RgbdCameraConfig
from tests.sensors_io.checks import refused

PINHOLE = {"fx": 10.0, "fy": 10.0, "cx": 4.0, "cy": 3.0, "width": 8, "height": 6}


def test_folders_and_cameras_that_are_absent_are_named(tmp_path):
    (tmp_path / "colour").mkdir()
    refused(DeviceNotFoundError, "depth is no folder", lambda: RgbdCameraConfig(replay=tmp_path, **PINHOLE).open())
    absent = RgbdCameraConfig(product="nobody's D435", colour_interface=3, depth_interface=0, **PINHOLE)
    with pytest.raises(DeviceNotFoundError, match=r"nobody's D435\", interface 3: no camera"), absent.open():
        pass
