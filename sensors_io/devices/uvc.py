"""UVC cameras by OpenCV, found by serial or product string, with their automatic settings locked.

Exposure, gain, white balance and focus that move by themselves change the colours that slopes are read from, so each is
set, read back and stored; one that refuses is stored too, and warned of.
"""

import dataclasses
import os
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Protocol, Self

import cv2
import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.devices.base import Identity, Sample, require_pitch
from sensors_io.devices.cameras import CameraInfo, find_cameras
from sensors_io.devices.errors import (
    DeviceLostError,
    DeviceNotFoundError,
    DeviceTimeoutError,
    SettingRefusedWarning,
)


class Capture(Protocol):
    """The methods of `cv2.VideoCapture` that are used."""

    def isOpened(self) -> bool: ...
    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def get(self, propId: int) -> float: ...
    def set(self, propId: int, value: float) -> bool: ...
    def release(self) -> None: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lock:
    """Settings that must not move while recording, in the camera's own units; `None` leaves one as it is.

    Args:
      exposure: on V4L2 in 100 µs.
      gain, focus: of the driver's own scale.
      white_balance_k: colour temperature.
    """

    exposure: float | None = None
    gain: float | None = None
    white_balance_k: float | None = None
    focus: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class UvcConfig:
    """One UVC camera.

    Args:
      sensor: canonical name of the sensor behind it.
      serial: exact USB serial.
      product: a part of the product string, such as "GelSight Mini" (it holds the unit's number: "R0B 2D8X-YK21").
      interface: of the USB device, where one device has several cameras: a RealSense D435 has depth at 0, colour at 3.
      index: number of the video node; only for a machine whose cameras have neither serial nor product string.
      width, height: of the mode asked for, px.
      rate_hz: of the mode asked for.
      pixel_format: FourCC of the mode, such as "MJPG"; empty leaves it. "Z16 " gives uint16 depth pictures.
      border_share: cut off at each side before resizing; a seventh for the GelSight Mini.
      frame_width, frame_height: of the frames given, by INTER_AREA; 0 keeps them.
      mm_per_px: pitch of the frames given on the gel; `None` where unknown.
      lock: settings to hold still.
    """

    sensor: str = "gelsight_mini"
    serial: str = ""
    product: str = ""
    interface: int | None = None
    index: int | None = None
    width: int = 0
    height: int = 0
    rate_hz: float = 0.0
    pixel_format: str = ""
    border_share: float = 0.0
    frame_width: int = 0
    frame_height: int = 0
    mm_per_px: float | None = None
    lock: Lock = dataclasses.field(default_factory=Lock)

    def __post_init__(self) -> None:
        if not 0 <= self.border_share < 0.5:
            raise ValueError(f"border_share is {self.border_share}: must lie in 0 ≤ border_share < 0.5; correct it")
        if len(self.pixel_format) not in (0, 4):
            raise ValueError(
                f"pixel_format is {self.pixel_format!r}: must have four letters, such as 'MJPG'; correct it"
            )
        if bool(self.frame_width) != bool(self.frame_height):
            raise ValueError("frame_width and frame_height must both be given, or neither; give the other one")
        for name in ("width", "height", "frame_width", "frame_height", "rate_hz"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be ≥ 0; 0 keeps the camera's own")
        require_pitch(self.mm_per_px)

    def open(self) -> "Uvc":
        """The device, not open yet."""
        return Uvc(self)

    def choose(self, cameras: tuple[CameraInfo, ...]) -> CameraInfo:
        """The one camera that is meant.

        Raises:
          DeviceNotFoundError: none of them is, or several are.
        """
        if self.index is not None:
            unknown = CameraInfo(node=f"/dev/video{self.index}", product="", serial="", usb_id="")
            return next((c for c in cameras if c.node == unknown.node), unknown)
        asked = f"serial {self.serial!r}" if self.serial else f"product {self.product!r}"
        if self.interface is not None:
            asked += f", interface {self.interface}"
        meant = [
            c
            for c in cameras
            if self.product in c.product and self.serial in ("", c.serial) and self.interface in (None, c.interface)
        ]
        if len(meant) == 1:
            return meant[0]
        there = "; ".join(map(str, meant or cameras)) or "none"
        problem = "several cameras answer to it" if meant else "no camera answers to it"
        raise DeviceNotFoundError(f"{self.sensor} with {asked}: {problem}; there are: {there}")


_MODE = {"pixel_format": cv2.CAP_PROP_FOURCC, "width": cv2.CAP_PROP_FRAME_WIDTH, "height": cv2.CAP_PROP_FRAME_HEIGHT}
_MODE_RATE = {"rate_hz": cv2.CAP_PROP_FPS}

_V4L2_MANUAL_EXPOSURE = 1.0  # of V4L2_CID_EXPOSURE_AUTO; OpenCV hands it on as it is
_AUTOMATIC: Mapping[str, tuple[int, float]] = {
    "exposure": (cv2.CAP_PROP_AUTO_EXPOSURE, _V4L2_MANUAL_EXPOSURE),
    "white_balance_k": (cv2.CAP_PROP_AUTO_WB, 0.0),
    "focus": (cv2.CAP_PROP_AUTOFOCUS, 0.0),
}
"""Automatic controls that must be switched off before a setting can be fixed."""

_SETTINGS: Mapping[str, int] = {
    "exposure": cv2.CAP_PROP_EXPOSURE,
    "gain": cv2.CAP_PROP_GAIN,
    "white_balance_k": cv2.CAP_PROP_WB_TEMPERATURE,
    "focus": cv2.CAP_PROP_FOCUS,
}


def lock_settings(capture: Capture, lock: Lock, name: str) -> dict[str, Any]:
    """Switch automatics off, set what is asked for, and read everything back.

    Returns:
      Setting → what it is now, `<setting>_locked` → whether its automatic is off and it holds the value asked for.
    """
    found: dict[str, Any] = {}
    refused = []
    for setting, prop in _SETTINGS.items():
        wanted = getattr(lock, setting)
        locked = True
        if setting in _AUTOMATIC:
            automatic, manual = _AUTOMATIC[setting]
            locked = capture.set(automatic, manual) and capture.get(automatic) == manual
        if wanted is not None:
            locked = capture.set(prop, wanted) and locked
        now = capture.get(prop)
        locked = locked and (wanted is None or abs(now - wanted) <= 0.5)  # drivers round to whole steps
        found |= {setting: now, f"{setting}_locked": locked}
        if not locked:
            refused.append(f"{setting} is {now:g}" + ("" if wanted is None else f", asked for {wanted:g}"))
    if refused:
        warnings.warn(
            f"{name}: {'; '.join(refused)}: not locked, so colours may drift; look at the background's drift",
            SettingRefusedWarning,
            stacklevel=3,
        )
    return found


def wait_for_frame(capture: Any, timeout_s: float) -> bool:
    """True once a camera of OpenCV has a frame or an error, within the given time; polls the device node itself."""
    if not capture.isOpened():
        return True  # grabbing says what is wrong; OpenCV itself would crash
    _, ready = cv2.VideoCapture.waitAny([capture], timeoutNs=round(timeout_s * NS_PER_S))
    return len(ready) > 0


def _open_v4l2(node: str) -> Capture:
    # a frame that `wait_for_frame` promised and that never comes holds `grab` for so many seconds, by default 10;
    # OpenCV takes whole ones only, and reads them when it first waits
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
    return cv2.VideoCapture(node, cv2.CAP_V4L2)


class Uvc:
    """One UVC camera.

    Args:
      config: which camera, which mode.
      find: lists the cameras of the machine.
      capture: opens a node; OpenCV's V4L2 by default.
      wait: whether a capture has a frame or an error within some seconds.
    """

    def __init__(
        self,
        config: UvcConfig,
        *,
        find: Callable[[], tuple[CameraInfo, ...]] = find_cameras,
        capture: Callable[[str], Capture] = _open_v4l2,
        wait: Callable[[Any, float], bool] = wait_for_frame,
    ):
        self._config = config
        self._find = find
        self._open_node = capture
        self._wait = wait
        self._capture: Capture | None = None
        self._identity = Identity(sensor=config.sensor, serial=config.serial, product=config.product)

    @property
    def identity(self) -> Identity:
        return self._identity

    def __enter__(self) -> Self:
        camera = self._config.choose(self._find())
        before = self._identity
        if before.where and (before.serial, before.product) != (camera.serial, camera.product):
            raise DeviceNotFoundError(
                f"{before.sensor} was {before.product!r} serial {before.serial or 'none'}, now there is {camera}: must "
                "be the same camera while it is read; plug the first one in again, or start anew"
            )
        capture = self._open_node(camera.node)
        if not capture.isOpened():
            capture.release()
            raise DeviceNotFoundError(
                f"{self._config.sensor}: {camera} does not open; end the program that uses it, or allow yourself to"
            )
        mode = self._set_mode(capture, camera.node)
        settings = mode | lock_settings(capture, self._config.lock, self._config.sensor)
        rate = mode["rate_hz"]
        self._capture = capture
        self._identity = Identity(
            sensor=self._config.sensor,
            serial=camera.serial,
            product=camera.product,
            where=camera.node,
            settings=settings,
            period_s=1 / rate if rate > 0 else None,
            mm_per_px=self._config.mm_per_px,
        )
        return self

    def __exit__(self, *exc: object) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def read(self, timeout_s: float) -> Sample:
        """The next frame, see `Device.read`; a camera that is unplugged is lost at once, not after OpenCV's 10 s."""
        if self._capture is None:
            raise DeviceLostError(f"{self._identity.sensor} is not open; use it in a with block")
        if not self._wait(self._capture, timeout_s):
            raise DeviceTimeoutError(f"{self._identity.sensor} at {self._identity.where}: no frame in {timeout_s} s")
        if not self._capture.grab():
            raise DeviceLostError(f"{self._identity.sensor} at {self._identity.where} gives no more frames")
        stamp_ns = time.monotonic_ns()
        driver_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)  # V4L2: when the driver finished the buffer
        ok, image = self._capture.retrieve()
        if not ok:
            raise DeviceLostError(
                f"{self._identity.sensor} at {self._identity.where} sends pictures that do not decode"
            )
        device_ns = round(driver_ms * 1e6) if driver_ms > 0 else None
        return Sample(host_time_ns=stamp_ns, device_time_ns=device_ns, frame=self._prepared(image))

    def _prepared(self, image: np.ndarray) -> np.ndarray:
        c = self._config
        cut_y, cut_x = (int(side * c.border_share) for side in image.shape[:2])
        image = image[cut_y : image.shape[0] - cut_y, cut_x : image.shape[1] - cut_x]
        if c.frame_width:
            image = cv2.resize(image, (c.frame_width, c.frame_height), interpolation=cv2.INTER_AREA)
        if image.ndim == 2:
            return np.ascontiguousarray(image)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _set_mode(self, capture: Capture, node: str) -> dict[str, Any]:
        """Set format, size and rate, and read them back.

        Raises:
          DeviceNotFoundError: the camera has no such size; a rate or format that it refuses is stored as it is.
        """
        before = self._identity.settings  # a camera that was open comes back as it was: its pitch is that of one size
        sizes = {name: getattr(self._config, name) or before.get(name, 0) for name in ("width", "height")}
        c = dataclasses.replace(self._config, **sizes)
        if c.pixel_format:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*c.pixel_format))
            capture.set(cv2.CAP_PROP_CONVERT_RGB, float(c.pixel_format != "Z16 "))
        for name in ("width", "height", "rate_hz"):
            if getattr(c, name):
                capture.set((_MODE | _MODE_RATE)[name], getattr(c, name))
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 4)  # a burst of the scheduler loses nothing; older frames would be late
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        found = {name: int(capture.get(_MODE[name])) for name in ("width", "height")}
        if (c.width and found["width"] != c.width) or (c.height and found["height"] != c.height):
            capture.release()
            raise DeviceNotFoundError(
                f"{c.sensor} at {node} has no mode of {c.width}×{c.height}, it offers "
                f"{found['width']}×{found['height']}; ask for another size"
            )
        letters = code.to_bytes(4, "little").decode("ascii", "replace") if code > 0 else ""
        return {**found, "rate_hz": capture.get(cv2.CAP_PROP_FPS), "pixel_format": letters}
