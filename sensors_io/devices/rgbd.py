"""The RGB-D camera that looks at the object: colour and depth paired by time, and where the contact is in its view."""

import dataclasses
from typing import Self

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.devices.base import Device, Identity, Sample
from sensors_io.devices.errors import DeviceDataError, DeviceTimeoutError, OutOfViewError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A pinhole camera: u = fx X/Z + cx, v = fy Y/Z + cy, with X right, Y down, Z ahead.

    Args:
      width, height: of the picture, px.
      fx, fy: focal lengths, px.
      cx, cy: principal point, px.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be > 0; read it from the camera's calibration")

    def project(self, point_mm: np.ndarray) -> np.ndarray:
        """Pixel (u, v) of points [..., 3] in the camera's frame, float64 [..., 2]; NaN at and behind the camera."""
        x, y, z = np.moveaxis(np.asarray(point_mm, np.float64), -1, 0)
        ahead = np.where(z > 0, z, np.nan)
        return np.stack([self.fx * x / ahead + self.cx, self.fy * y / ahead + self.cy], -1)


def contact_region(intrinsics: Intrinsics, centre_mm: np.ndarray, side_mm: float) -> tuple[int, int, int, int]:
    """Region of the view that shows a square sensing window: (x, y, width, height) in px, cut to the picture.

    The window is taken as facing the camera: on an object at 300 mm a tilt of 30° changes its width by an eighth.

    Args:
      intrinsics: of the colour camera.
      centre_mm: centre of the contact in the camera's frame, [3].
      side_mm: of the window.

    Raises:
      OutOfViewError: a contact behind the camera or outside its view.
    """
    half = side_mm / 2
    corners = np.asarray(centre_mm, np.float64) + np.array([[-half, -half, 0], [half, half, 0]])
    low, high = intrinsics.project(corners)
    size = np.array([intrinsics.width, intrinsics.height])
    x0, y0 = (int(v) for v in np.clip(np.floor(np.where(np.isnan(low), size, low)), 0, size))
    x1, y1 = (int(v) for v in np.clip(np.ceil(np.where(np.isnan(high), 0, high)), 0, size))
    if x1 <= x0 or y1 <= y0:
        raise OutOfViewError(
            f"centre_mm is {np.asarray(centre_mm).tolist()}: must lie in the view; check the hand–eye calibration"
        )
    return x0, y0, x1 - x0, y1 - y0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RgbdConfig:
    """Settings for joining colour and depth.

    Args:
      intrinsics: of both, which the camera must have aligned.
      depth_unit_mm: of one count of the depth pictures.
      max_apart_s: two pictures taken further apart are no pair; half a period at 30 Hz.
    """

    intrinsics: Intrinsics
    depth_unit_mm: float = 1.0
    max_apart_s: float = 0.017


class Rgbd:
    """An RGB-D camera made of two devices, colour and depth; both may be UVC nodes or replays.

    Its samples carry the colour frame and `view_depth_mm` float32 [H, W], 0 where the camera saw none.
    """

    def __init__(self, colour: Device, depth: Device, config: RgbdConfig):
        self._colour, self._depth, self._config = colour, depth, config
        self._last_depth: Sample | None = None

    @property
    def identity(self) -> Identity:
        settings = {
            "colour": dict(self._colour.identity.settings),
            "depth": dict(self._depth.identity.settings),
            "intrinsics": dataclasses.asdict(self._config.intrinsics),
            "depth_unit_mm": self._config.depth_unit_mm,
        }
        return dataclasses.replace(self._colour.identity, sensor="rgbd", settings=settings)

    def __enter__(self) -> Self:
        self._colour.__enter__()
        try:
            self._depth.__enter__()
        except BaseException:
            self._colour.__exit__(None, None, None)
            raise
        self._last_depth = None
        return self

    def __exit__(self, *exc: object) -> None:
        try:
            self._depth.__exit__(*exc)
        finally:
            self._colour.__exit__(*exc)

    def read(self, timeout_s: float) -> Sample:
        """The next pair, see `Device.read`; colour without depth in time, and the other way round, is passed over."""
        apart_ns = round(self._config.max_apart_s * NS_PER_S)
        colour = self._colour.read(timeout_s)
        depth = self._last_depth or self._depth.read(timeout_s)
        for _ in range(_MOST_UNPAIRED):
            ahead_ns = depth.host_time_ns - colour.host_time_ns
            if abs(ahead_ns) <= apart_ns:
                self._last_depth = None
                return self._pair(colour, depth)
            if ahead_ns < 0:
                depth = self._depth.read(timeout_s)
            else:
                colour = self._colour.read(timeout_s)
            self._last_depth = depth
        raise DeviceTimeoutError(
            f"rgbd: no colour and depth pictures within {self._config.max_apart_s} s of each other; raise max_apart_s"
        )

    def _pair(self, colour: Sample, depth: Sample) -> Sample:
        c = self._config
        for name, sample, kind in (("colour", colour, np.uint8), ("depth", depth, np.uint16)):
            shape = None if sample.frame is None else sample.frame.shape[:2]
            if sample.frame is None or sample.frame.dtype != kind or shape != (c.intrinsics.height, c.intrinsics.width):
                raise DeviceDataError(
                    f"rgbd: {name} picture is {None if sample.frame is None else sample.frame.dtype}{shape}: must be "
                    f"{np.dtype(kind)} of {c.intrinsics.height}×{c.intrinsics.width}; correct modes or intrinsics"
                )
        assert depth.frame is not None
        depth_mm = depth.frame.astype(np.float32) * np.float32(c.depth_unit_mm)
        return dataclasses.replace(colour, arrays={"view_depth_mm": depth_mm})


_MOST_UNPAIRED = 300  # pictures passed over before it is an error: ten seconds at 30 Hz
