"""The lateral displacement of a gel, in mm, from its pictures."""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np

from sensors_io.errors import UserError
from sensors_io.fields.evidence import Evidence, Pattern, examine
from sensors_io.fields.markers import inside
from sensors_io.fields.spline import Densifier
from sensors_io.fields.tracking import LEAST_POINTS, Tracked, Tracker, TrackingConfig
from sensors_io.schema import Flag

LOST_SHARE = 0.05
"""Share of the points that are lost above which a frame is flagged, as in generated scenes."""

_SMALLEST_HALF_PX, _DOT_MARGIN = 7, 1.6  # windows of 15 px at least; a dot and 0.6 of its radius around it
_MOST_PITCH = 0.6  # half side of a window over the dots' pitch: a neighbour's edge may show, its centre not
_DENSE_HALF_PX, _DENSE_PITCH_PX = 8, 12  # windows on a dense pattern, and their distance
_NEAR_CELL_PX = 8  # of the map that says where found points are near
_REACH = 1.5  # pitches from the nearest found point up to which the field counts as read


class NoPatternError(UserError, ValueError):
    """A gel whose picture at rest carries neither dots nor a dense pattern: its lateral motion cannot be read."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Deformation:
    """Lateral displacement in one frame.

    `displacement_mm` [h, w, 2]; `valid` [h, w]: where found points are near; `flags`: `MARKER_LOSS` or none.
    """

    displacement_mm: np.ndarray
    valid: np.ndarray
    flags: Flag
    tracked: Tracked


class DeformationReader:
    """Reads pictures of one gel.

    Args:
      rest: the gel at rest, RGB uint8 [H, W, 3].
      mm_per_px: pixel size.
      shape: (h, w) of the field, whose cells divide the picture evenly; the picture's own if `None`.
      config: gates of the tracker.

    Raises:
      NoPatternError: the gel is bare; the message says what is missing.
      ValueError: pictures of another type or shape, `mm_per_px` not above 0.
    """

    def __init__(
        self,
        rest: np.ndarray,
        mm_per_px: float,
        shape: tuple[int, int] | None = None,
        config: TrackingConfig | None = None,
    ):
        if mm_per_px <= 0:
            raise ValueError(f"mm_per_px is {mm_per_px}: must be > 0; give millimetres per pixel")
        grey = _grey(rest)
        self._mm_per_px = mm_per_px
        self._shape = shape or grey.shape
        self.evidence = examine(grey)
        points, half = _points(grey, self.evidence)
        self.tracker = Tracker(grey, points, half, config)
        self._field = self._make_field(grey.shape)
        self._near = self._make_near(grey.shape)

    def read(self, picture: np.ndarray, gap: bool = False, apart: bool = False) -> Deformation:
        """The displacement in one picture.

        Args:
          picture: RGB uint8 [H, W, 3], of the same crop as the one at rest.
          gap: whether frames are missing before it.
          apart: whether it follows no other picture.
        """
        tracked = self.tracker.track(_grey(picture), gap, apart)
        displacement_px = self._field(tracked.points_px - self.tracker.points_px)
        lost = float(np.mean(~tracked.found))
        return Deformation(
            displacement_mm=(self._mm_per_px * displacement_px).astype(np.float32),
            valid=self._near(tracked.found),
            flags=Flag.MARKER_LOSS if lost > LOST_SHARE else Flag.NONE,
            tracked=tracked,
        )

    def _make_field(self, picture: tuple[int, ...]) -> Callable[[np.ndarray], np.ndarray]:
        """From displacements [P, 2] to the field [h, w, 2], in pixels."""
        spline, shape = self.tracker.spline, self._shape
        if shape == picture:
            return Densifier(spline, shape)
        matrix = spline.matrix(_cells(shape, picture))
        return lambda displacement: (matrix @ displacement).reshape(*shape, 2)

    def _make_near(self, picture: tuple[int, ...]) -> Callable[[np.ndarray], np.ndarray]:
        """From the found points [P] to the nodes [h, w] within reach of one of them at rest."""
        coarse = tuple(-(-side // _NEAR_CELL_PX) for side in picture)
        apart = _cells(coarse, picture)[:, None] - self.tracker.points_px
        near = np.hypot(apart[..., 0], apart[..., 1]) <= _REACH * self.tracker.spline.pitch_px
        near = near.astype(np.float32)  # a product of booleans is slow
        height, width = self._shape

        def nodes(found: np.ndarray) -> np.ndarray:
            if found.sum() < LEAST_POINTS:
                return np.zeros((height, width), bool)
            seen = (near @ found.astype(np.float32) > 0).reshape(coarse).astype(np.uint8)
            return cv2.resize(seen, (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)

        return nodes


def _grey(picture: np.ndarray) -> np.ndarray:
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise ValueError(f"picture is {picture.dtype}{list(picture.shape)}: must be uint8[H, W, 3]; convert it to RGB")
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)


def _points(grey: np.ndarray, evidence: Evidence) -> tuple[np.ndarray, int]:
    """Points to track, (x, y) [P, 2], and the half side of their windows."""
    if evidence.pattern is Pattern.BARE:
        raise NoPatternError(f"the gel at rest shows neither dots nor a dense pattern: {evidence.reason}")
    if evidence.markers is None:
        half = _DENSE_HALF_PX
        points = _lattice(grey.shape, half + 1)
    else:
        dots = evidence.markers
        half = round(min(_DOT_MARGIN * dots.radius_px, _MOST_PITCH * dots.pitch_px))
        half = max(half, _SMALLEST_HALF_PX)
        points = dots.points_px
    return points[inside(points, grey.shape, half + 1)], half


def _lattice(shape: tuple[int, ...], margin: int) -> np.ndarray:
    """Points about `_DENSE_PITCH_PX` apart, the outermost `margin` from the border, (x, y) [P, 2]."""
    y, x = (np.linspace(margin, n - 1 - margin, max(2, round((n - 2 * margin) / _DENSE_PITCH_PX) + 1)) for n in shape)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(np.float32)


def _cells(shape: tuple[int, ...], picture: tuple[int, ...]) -> np.ndarray:
    """Centres of the cells of a field in pixels of the picture, (x, y) [h w, 2]."""
    y, x = ((np.arange(n) + 0.5) * side / n - 0.5 for n, side in zip(shape, picture, strict=True))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
