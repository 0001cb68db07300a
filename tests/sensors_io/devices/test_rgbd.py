"""Colour and depth are paired by time; the contact shows where a pinhole camera puts it."""

import numpy as np
import pytest

from sensors_io.devices.errors import DeviceDataError, DeviceTimeoutError, StreamEndedError
from sensors_io.devices.rgbd import Intrinsics, Rgbd, RgbdConfig, contact_region
from tests.sensors_io.checks import refused
from tests.sensors_io.devices.fakes import Scripted, sample

CAMERA = Intrinsics(width=6, height=4, fx=100.0, fy=100.0, cx=3.0, cy=2.0)
VIEW = Intrinsics(width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0)


def colour(index, time_ms):
    return sample(index, time_ms, frame=np.full((4, 6, 3), index % 256, np.uint8))


def depth(index, time_ms):
    return sample(index, time_ms, frame=np.full((4, 6), 1000 + index, np.uint16))


def joined(colours, depths, **config):
    return Rgbd(Scripted(colours), Scripted(depths), RgbdConfig(intrinsics=CAMERA, depth_unit_mm=0.5, **config))


def test_pictures_without_a_partner_are_passed_over():
    device = joined(
        [colour(0, 0), colour(1, 33), colour(2, 66), colour(3, 99)], [depth(0, -33), depth(1, 31), depth(3, 100)]
    )
    with device:
        first, second = device.read(1.0), device.read(1.0)
        assert (first.index, second.index) == (1, 3)
        assert first.arrays["view_depth_mm"][0, 0] == 500.5
        assert second.arrays["view_depth_mm"].dtype == np.float32
        with pytest.raises(StreamEndedError):
            device.read(1.0)
    assert device.identity.sensor == "rgbd"
    assert device.identity.settings["intrinsics"]["fx"] == 100


def test_pictures_that_never_meet_or_are_of_another_kind_are_refused():
    colours, depths = [colour(k, 33 * k) for k in range(400)], [depth(k, 33 * k + 16) for k in range(400)]
    with joined(colours, depths, max_apart_s=0.005) as device:
        refused(DeviceTimeoutError, r"within 0\.005 s", device.read, 1.0)
    with joined([colour(0, 0)], [sample(0, 0, frame=np.zeros((4, 6, 3), np.uint8))]) as device:
        refused(DeviceDataError, "must be uint16 of 4×6", device.read, 1.0)


def test_a_window_shows_at_its_place_and_size():
    """20 mm at 300 mm and f = 600 px: 40 px about the principal point, cut at the picture's edge."""
    for centre, region in ((0.0, (300, 220, 40, 40)), (-160.0, (0, 220, 20, 40))):
        assert contact_region(VIEW, np.array([centre, 0.0, 300.0]), 20.0) == region
    for out in ((0, 0, -10.0), (900.0, 0, 300.0)):
        refused(ValueError, "must lie in the view", contact_region, VIEW, np.array(out), 20.0)
    refused(ValueError, "fx is 0", Intrinsics, width=6, height=4, fx=0, fy=1, cx=0, cy=0)
