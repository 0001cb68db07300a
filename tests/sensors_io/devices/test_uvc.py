"""UVC cameras on a made-up /sys, with a fake in place of cv2.VideoCapture."""

import time

import cv2
import numpy as np
import pytest

from sensors_io.devices.bridge import BridgeConfig
from sensors_io.devices.cameras import CameraInfo, find_cameras
from sensors_io.devices.errors import DeviceLostError, DeviceNotFoundError, DeviceTimeoutError, SettingRefusedWarning
from sensors_io.devices.reader import Reader
from sensors_io.devices.uvc import Lock, Uvc, UvcConfig, wait_for_frame
from tests.sensors_io.checks import refused


def plug(root, number, *, index="0", usb=None, name="camera", at=None):
    """A node as the kernel shows it: video4linux/videoN with a link to the USB interface below its device."""
    node = root / "class" / f"video{number}"
    node.mkdir(parents=True)
    (node / "index").write_text(f"{index}\n")
    (node / "name").write_text(f"{name}\n")
    if usb is not None:
        device = root / "usb" / usb["serial"]
        interface = device / (at or "1.0")
        interface.mkdir(parents=True, exist_ok=True)
        if at is not None:
            (interface / "bInterfaceNumber").write_text(f"{at}\n")
        for key, value in usb.items():
            (device / key).write_text(f"{value}\n")
        (node / "device").symlink_to(interface)


MINI = {"serial": "2D8XYK21", "product": "GelSight Mini R0B 2D8X-YK21", "idVendor": "0c45", "idProduct": "636d"}


def test_cameras_are_listed_without_metadata_nodes(tmp_path):
    plug(tmp_path, 10, usb=MINI | {"serial": "other"})
    plug(tmp_path, 0, usb=MINI)
    plug(tmp_path, 1, index="1", usb=MINI)
    plug(tmp_path, 2, name="built in")
    found = find_cameras(tmp_path / "class")
    assert [c.node for c in found] == ["/dev/video0", "/dev/video2", "/dev/video10"]
    assert found[0] == CAMERAS[0]
    assert (found[1].product, found[1].serial, found[1].usb_id) == ("built in", "", "")
    assert find_cameras(tmp_path / "nowhere") == ()


CAMERAS = (
    CameraInfo(node="/dev/video0", product="GelSight Mini R0B 2D8X-YK21", serial="2D8XYK21", usb_id="0c45:636d"),
    CameraInfo(node="/dev/video2", product="GelSight Mini R0B 28B4-Z1A7", serial="28B4Z1A7", usb_id="0c45:636d"),
)


def test_a_camera_is_chosen_by_serial_product_or_explicit_index():
    assert UvcConfig(serial="28B4Z1A7").choose(CAMERAS) is CAMERAS[1]
    assert UvcConfig(product="2D8X-YK21").choose(CAMERAS) is CAMERAS[0]
    assert UvcConfig(index=7).choose(CAMERAS).node == "/dev/video7"
    refused(DeviceNotFoundError, "several cameras answer", UvcConfig(product="GelSight Mini").choose, CAMERAS)
    nobody = UvcConfig(serial="nope").choose
    refused(DeviceNotFoundError, "no camera answers to it; there are: /dev/video0", nobody, CAMERAS)
    refused(DeviceNotFoundError, "there are: none", nobody, ())


class FakeCapture:
    """Settings that stick unless they are in `refuses`; frames that count."""

    def __init__(self, frames=3, refuses=(), opens=True, size=(6, 8), stalls_after=None):
        self.stalls_after = stalls_after
        self.left, self.refuses, self.opens = frames, refuses, opens
        self.settings = {cv2.CAP_PROP_FRAME_WIDTH: size[1], cv2.CAP_PROP_FRAME_HEIGHT: size[0], cv2.CAP_PROP_FPS: 25.0}
        self.count, self.released = 0, False

    def isOpened(self):
        return self.opens

    def wait(self, timeout_s):
        if self.stalls_after is not None and self.count >= self.stalls_after:
            time.sleep(timeout_s)
            return False
        return True

    def grab(self):
        self.count += 1
        return self.count <= self.left

    def retrieve(self):
        image = np.zeros((6, 8, 3), np.uint8)
        image[..., 0] = self.count  # blue
        return True, image

    def get(self, prop):
        return 40.0 * self.count if prop == cv2.CAP_PROP_POS_MSEC else self.settings.get(prop, 0.0)

    def set(self, prop, value):
        if prop in self.refuses:
            return False
        self.settings[prop] = value
        return True

    def release(self):
        self.released = True


def camera(capture, **config):
    return Uvc(
        UvcConfig(serial="2D8XYK21", **config),
        find=lambda: CAMERAS,
        capture=lambda node: capture,
        wait=lambda capture, timeout_s: capture.wait(timeout_s),
    )


def test_frames_come_in_rgb_with_both_stamps_and_the_identity_is_complete():
    capture = FakeCapture()
    with camera(capture, lock=Lock(exposure=150, gain=2, white_balance_k=4600)) as device:
        first, second = device.read(1.0), device.read(1.0)
        assert first.frame[0, 0].tolist() == [0, 0, 1]
        assert (first.device_time_ns, second.device_time_ns) == (40_000_000, 80_000_000)
        assert first.host_time_ns <= second.host_time_ns
        identity = device.identity
    assert (identity.serial, identity.where, identity.period_s) == ("2D8XYK21", "/dev/video0", 0.04)
    assert identity.settings["exposure"] == 150
    assert identity.settings["exposure_locked"]
    assert identity.settings["white_balance_k"] == 4600
    assert capture.released


def test_a_refused_setting_is_stored_and_warned_of():
    capture = FakeCapture(refuses=(cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_GAIN))
    with pytest.warns(SettingRefusedWarning, match=r"exposure is 150, asked for 150; gain is 0, asked for 3"):
        device = camera(capture, lock=Lock(exposure=150, gain=3)).__enter__()
    settings = device.identity.settings
    assert [settings[f"{name}_locked"] for name in ("exposure", "gain", "focus")] == [False, False, True]
    device.__exit__(None, None, None)


def test_a_camera_that_stops_is_lost_and_one_that_stalls_a_timeout():
    device = camera(FakeCapture(frames=1))
    with device:
        device.read(1.0)
        refused(DeviceLostError, "gives no more frames", device.read, 1.0)
    refused(DeviceLostError, "not open", device.read, 1.0)
    with camera(FakeCapture(stalls_after=1), border_share=0.25, frame_width=2, frame_height=2) as device:
        assert device.read(1.0).frame.shape == (2, 2, 3)  # cropped and shrunk
        refused(DeviceTimeoutError, r"no frame in 0\.05 s", device.read, 0.05)


@pytest.mark.parametrize("fault", [{"frames": 2}, {"frames": 10**6, "stalls_after": 2}])
def test_an_unplugged_or_stalled_camera_is_noticed_within_a_second(fault):
    """Unplugged, the node answers with an error; stalled, with nothing: both are disconnects, and opened again."""
    device = camera(FakeCapture(**fault))
    with Reader(device) as reader:
        assert [reader.next(5.0).frame[0, 0, 2] for _ in range(2)] == [1, 2]
        began = time.monotonic()
        while reader.counts.disconnects == 0 and time.monotonic() - began < 5:
            time.sleep(0.005)
        assert time.monotonic() - began < 1


def test_the_cameras_of_one_device_are_told_apart_by_their_interfaces(tmp_path):
    """As a RealSense: depth at interface 0, colour at 3, one product and serial."""
    camera = {"serial": "9", "product": "D435", "idVendor": "8086", "idProduct": "0b07"}
    for number, interface in ((0, "00"), (4, "03")):
        plug(tmp_path, number, usb=camera, at=interface)
    found = find_cameras(tmp_path / "class")
    assert [c.interface for c in found] == [0, 3]
    assert UvcConfig(product="D435", interface=3).choose(found).node == "/dev/video4"
    refused(DeviceNotFoundError, r"several cameras .* interface 0\)", lambda: UvcConfig(product="D435").choose(found))
    refused(DeviceNotFoundError, "interface 7: no camera", lambda: UvcConfig(product="D435", interface=7).choose(found))


@pytest.mark.parametrize("name", ["width", "height", "frame_width", "frame_height", "rate_hz"])
def test_negative_sizes_are_refused(name):
    sizes = {"frame_width": 8, "frame_height": 8} | {name: -1}
    refused(ValueError, f"{name} is -1: must be ≥ 0", UvcConfig, **sizes)


def test_configs_are_checked():
    refused(ValueError, "border_share is 0.5", UvcConfig, border_share=0.5)
    refused(ValueError, "must have four letters", UvcConfig, pixel_format="MJPEG")
    refused(ValueError, "must both be given", UvcConfig, frame_width=4)
    for mm_per_px in (0.0, -0.06, 15.8):  # the last in px per mm
        for config in (UvcConfig, BridgeConfig):
            refused(ValueError, rf"mm_per_px is {mm_per_px}: must lie in \(0, 1\)", config, mm_per_px=mm_per_px)


def test_opencv_has_the_wait_and_takes_what_it_is_given(tmp_path):
    """A video file gets as far as the question what kind of camera it is; a closed camera is left to `grab`."""
    path = str(tmp_path / "a.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"FFV1"), 20.0, (16, 12))
    writer.write(np.zeros((12, 16, 3), np.uint8))
    writer.release()
    capture = cv2.VideoCapture(path)
    refused(cv2.error, "V4L", wait_for_frame, capture, 0.01)
    capture.release()
    assert wait_for_frame(capture, 0.01)


def test_a_camera_that_does_not_open_or_has_no_such_mode_is_named():
    refused(DeviceNotFoundError, "does not open", lambda: camera(FakeCapture(opens=False)).__enter__())

    class Fixed(FakeCapture):
        def set(self, prop, value):
            return prop not in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT) and super().set(prop, value)

    with pytest.raises(DeviceNotFoundError, match="no mode of 640×480, it offers 8×6"):
        camera(Fixed(), width=640, height=480).__enter__()


@pytest.mark.parametrize("asked", [{"index": 2}, {"product": "GelSight Mini"}])
def test_a_camera_that_takes_the_place_of_the_one_that_was_unplugged_is_not_read(asked):
    """After a replug the kernel may give its number to another camera, or another unit may be plugged in."""
    other = CameraInfo(node="/dev/video2", product="GelSight Mini R0B 0000-AAAA", serial="0000AAAA", usb_id="0c45:636d")
    plugged = [CAMERAS[1]]
    device = Uvc(
        UvcConfig(**asked), find=lambda: tuple(plugged), capture=lambda node: FakeCapture(), wait=lambda *_: True
    )
    with device:
        assert device.identity.serial == "28B4Z1A7"
    plugged[:] = [other]
    refused(DeviceNotFoundError, "serial 28B4Z1A7, now there is /dev/video2 .*: must be the same", device.__enter__)
    plugged[:] = [CAMERAS[1]]
    with device:
        assert device.identity.serial == "28B4Z1A7"


def test_a_camera_that_is_opened_again_is_asked_for_the_size_that_it_had():
    """Its own size after a replug may be another one, while `mm_per_px` is that of the first."""
    captures = [FakeCapture(), FakeCapture(size=(12, 16))]
    device = Uvc(UvcConfig(index=0), find=lambda: (), capture=lambda node: captures.pop(0), wait=lambda *_: True)
    for _ in range(2):
        with device:
            assert (device.identity.settings["width"], device.identity.settings["height"]) == (8, 6)
