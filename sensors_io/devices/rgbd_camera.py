"""An RGB-D camera as the command line names it: two UVC cameras, or two folders of pictures."""

import dataclasses
import pathlib

from sensors_io.clock import Clock
from sensors_io.devices.base import Device
from sensors_io.devices.errors import DeviceNotFoundError
from sensors_io.devices.replay import Replay
from sensors_io.devices.rgbd import Intrinsics, Rgbd, RgbdConfig
from sensors_io.devices.sources import PictureFolder
from sensors_io.devices.uvc import UvcConfig

_DEPTH_FORMAT = "Z16 "  # FourCC of UVC depth pictures


@dataclasses.dataclass(frozen=True, kw_only=True)
class RgbdCameraConfig:
    """An RGB-D camera that looks at the object: colour and depth by UVC, aligned, of one size.

    Args:
      product, serial: of the USB device, as for a UVC camera.
      colour_interface, depth_interface: of its two cameras; 3 and 0 on a RealSense D435.
      colour_index, depth_index: numbers of the video nodes, where the interfaces do not distinguish them.
      replay: folder with colour/ and depth/ (16 bits), read instead of cameras.
      width, height: of both pictures, px.
      rate_hz: of both.
      colour_format: FourCC of the colour pictures; empty leaves it.
      fx, fy: focal lengths, px, from the camera's calibration.
      cx, cy: principal point, px.
      depth_unit_mm: of one count of the depth pictures; 1 of a RealSense as shipped.
      max_apart_s: two pictures taken further apart are no pair; half a period at 30 Hz.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    product: str = ""
    serial: str = ""
    colour_interface: int | None = None
    depth_interface: int | None = None
    colour_index: int | None = None
    depth_index: int | None = None
    replay: pathlib.Path | None = None
    width: int = 640
    height: int = 480
    rate_hz: float = 30.0
    colour_format: str = ""
    depth_unit_mm: float = 1.0
    max_apart_s: float = 0.017

    def __post_init__(self) -> None:
        for name in ("rate_hz", "depth_unit_mm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be > 0; see the camera's manual")
        _ = self.intrinsics, self._camera(None, None, self.colour_format)  # each refuses its own values

    @property
    def intrinsics(self) -> Intrinsics:
        """Of both pictures."""
        return Intrinsics(width=self.width, height=self.height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy)

    def open(self, clock: Clock | None = None) -> Rgbd:
        """The device, not open yet.

        Raises:
          DeviceNotFoundError: `replay` lacks one of its folders.
        """
        joined = RgbdConfig(intrinsics=self.intrinsics, depth_unit_mm=self.depth_unit_mm, max_apart_s=self.max_apart_s)
        if self.replay is None:
            colour = self._camera(self.colour_interface, self.colour_index, self.colour_format)
            return Rgbd(colour, self._camera(self.depth_interface, self.depth_index, _DEPTH_FORMAT), joined)
        return Rgbd(self._folder("colour", clock), self._folder("depth", clock), joined)

    def _camera(self, interface: int | None, index: int | None, pixel_format: str) -> Device:
        return UvcConfig(
            sensor="rgbd",
            product=self.product,
            serial=self.serial,
            interface=interface,
            index=index,
            width=self.width,
            height=self.height,
            rate_hz=self.rate_hz,
            pixel_format=pixel_format,
        ).open()

    def _folder(self, name: str, clock: Clock | None) -> Device:
        assert self.replay is not None
        path = self.replay / name
        if not path.is_dir():
            raise DeviceNotFoundError(f"{path} is no folder: a replayed RGB-D camera needs colour/ and depth/")
        return Replay(PictureFolder(path=path, rate_hz=self.rate_hz, sensor="rgbd"), clock=clock)
