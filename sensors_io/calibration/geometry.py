"""Lens distortion and scale of a sensor's camera, from a board of pins.

A pin at pixel p lies at millimetre m on the gel,

    q = c + (p − c) a(λ r²) (1 + k r²),   a(z) = atan(√z) / √z,   r = |p − c| / R,      m = H q

with centre c, half diagonal R and a homography H, which carries scale and tilt.  A single view of a flat board does not
separate focal length from distance, and neither is needed.  All are fitted to the pins by least squares in
millimetres; the error that is reported is of pins left out of the fit.

The arc tangent is the field-of-view model of Devernay and Faugeras (Machine Vision and Applications 13, 14, 2001), for
z < 0 its continuation atanh(√−z) / √−z.  On the two 9DTact boards, pins left out, it errs as little with two constants
as a polynomial of r² with three, which folds back on itself outside the outermost pins; with two the polynomial errs
twice as much.
"""

import dataclasses
import hashlib
import json
import pathlib
from typing import Any, Self

import cv2
import numpy as np
from scipy.optimize import least_squares

from sensors_io.errors import MALFORMED, UserError
from sensors_io.json_files import read_json, write_json

_FOLDS = 9
_INVERSIONS = 25  # Newton steps on the radius; six do where the pins are, the rest is for the far corners
_START = 0.5  # of λ: mild pincushion, from where either sign is found
_BEST_SHARE = 0.25  # of the strongest spots' contrast: what a pin shows at least


class GeometryError(UserError, ValueError):
    """A board, or presses of a ball, from which no geometry can be found; the message says what to do about it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraGeometry:
    """Map from each pixel to a place on the gel.

    Args:
      size_px: rows and columns of the picture.
      centre_px: of the distortion, (x, y).
      radial: λ and k.
      homography: from undistorted pixels to mm, [3, 3]; the board's middle pin is the origin.
      rms_mm: of the residuals of the fit.
      held_out_mm: root mean square error of pins left out of the fit.
    """

    size_px: tuple[int, int]
    centre_px: np.ndarray
    radial: np.ndarray
    homography: np.ndarray
    rms_mm: float
    held_out_mm: float

    def to_mm(self, point_px: np.ndarray) -> np.ndarray:
        """Millimetres on the gel of pixels (x, y), [..., 2]."""
        away = np.asarray(point_px, np.float64) - self.centre_px
        r2 = np.sum(away**2, -1, keepdims=True) / _half_diagonal(self.size_px) ** 2
        return _project(self.homography, self.centre_px + away * _stretch(r2, self.radial))

    def to_px(self, point_mm: np.ndarray) -> np.ndarray:
        """Pixels (x, y) of millimetres on the gel, [..., 2]: the inverse of `to_mm`."""
        away = _project(np.linalg.inv(self.homography), np.asarray(point_mm, np.float64)) - self.centre_px
        half = _half_diagonal(self.size_px)
        wanted = np.linalg.norm(away, axis=-1, keepdims=True) / half
        radius = wanted.copy()
        for _ in range(_INVERSIONS):
            radius = np.abs(radius - (radius * _stretch(radius**2, self.radial) - wanted) / _slope(radius, self.radial))
        return self.centre_px + away * radius / np.maximum(wanted, np.finfo(float).tiny)

    @property
    def mm_per_px(self) -> float:
        """Scale at the centre of the picture: square root of the area that a pixel covers there."""
        middle = np.array([self.size_px[1], self.size_px[0]]) / 2
        corners = self.to_mm(middle + np.array([[-1.0, -1], [1, -1], [-1, 1]]))
        edges = (corners[1:] - corners[0]) / 2
        return float(np.sqrt(abs(np.linalg.det(edges))))

    def view(self, *, mm_per_px: float, size_px: tuple[int, int]) -> "Rectifier":
        """An undistorted view straight from above, about the same middle.

        Args:
          mm_per_px: of the view.
          size_px: rows and columns of the view.
        """
        rows, columns = size_px
        middle = self.to_mm(np.array([self.size_px[1] - 1, self.size_px[0] - 1]) / 2)
        x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
        at = self.to_px(middle + mm_per_px * np.stack([x, y], -1)).astype(np.float32)
        return Rectifier(size_px=self.size_px, mm_per_px=mm_per_px, at=at)

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of everything that decides where a pixel lies."""
        digest = hashlib.sha256(json.dumps(list(self.size_px)).encode())
        for array in (self.centre_px, self.radial, self.homography):
            digest.update(np.ascontiguousarray(array, np.float64).tobytes())
        return digest.hexdigest()[:16]

    def save(self, path: pathlib.Path) -> None:
        """Write it as JSON, whole or not at all."""
        write_json(path, {name: _plain(value) for name, value in dataclasses.asdict(self).items()})

    @classmethod
    def load(cls, path: pathlib.Path) -> Self:
        """Read what `save` wrote.

        Raises:
          GeometryError: there is no such file, or it is something else.
        """
        try:
            tree = read_json(path)
            rows, columns = tree["size_px"]
            found = cls(
                size_px=(int(rows), int(columns)),
                centre_px=np.array(tree["centre_px"], np.float64),
                radial=np.array(tree["radial"], np.float64),
                homography=np.array(tree["homography"], np.float64),
                rms_mm=float(tree["rms_mm"]),
                held_out_mm=float(tree["held_out_mm"]),
            )
            shapes = (2,), (2,), (3, 3)
            for array, shape in zip((found.centre_px, found.radial, found.homography), shapes, strict=True):
                if array.shape != shape or not np.isfinite(array).all():
                    raise ValueError(f"its arrays must be finite, of shapes {shapes}")
            if min(found.size_px) < 1 or not np.linalg.det(found.homography):
                raise ValueError("its size must be ≥ 1 px, and its homography one that can be inverted")
            return found
        except (OSError, *MALFORMED) as error:
            raise GeometryError(
                f"{path} is no geometry ({error}); make one with `python -m sensors_io geometry`"
            ) from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rectifier:
    """Straightens pictures of one camera; where each pixel comes from is computed once.

    Args:
      size_px: rows and columns of the camera's pictures.
      mm_per_px: pitch of the straight ones.
      at: where each of their pixels lies in the camera's, float32 [H, W, 2], (x, y).
    """

    size_px: tuple[int, int]
    mm_per_px: float
    at: np.ndarray

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """The straight picture, 0 where the camera does not look.

        Args:
          picture: [H, W] or [H, W, 3], of the camera's size.

        Raises:
          GeometryError: a picture of another size.
        """
        if picture.shape[:2] != tuple(self.size_px):
            raise GeometryError(
                f"picture is {picture.shape[:2]}: must be {self.size_px}; measure the geometry in this mode"
            )
        return cv2.remap(picture, self.at[..., 0], self.at[..., 1], cv2.INTER_LINEAR)


def find_pins(picture: np.ndarray, background: np.ndarray, *, rows: int, columns: int) -> np.ndarray:
    """Pixels (x, y) of a board's pins, ordered along rows and columns, [rows, columns, 2].

    Pins are the strongest spots of ± (background − picture) at the scale that the board's pitch suggests, refined by a
    parabola; the sign is that of most of the contrast.

    Args:
      picture: of the pressed board, [H, W] or [H, W, 3].
      background: of the untouched gel, the same size.
      rows, columns: pins on the board.

    Raises:
      GeometryError: another number of pins, or they form no such grid.
    """
    if picture.shape != background.shape:
        raise GeometryError(
            f"picture is {picture.shape}: must be of the background's {background.shape}; take both alike"
        )
    if min(rows, columns) < 1:
        raise GeometryError(f"rows and columns are {rows} and {columns}: must be ≥ 1; count the pins of the board")
    change = background.astype(np.float32) - picture.astype(np.float32)
    change = change if change.ndim == 2 else change.mean(-1)
    pitch = min(change.shape[0] / rows, change.shape[1] / columns)
    spots = cv2.GaussianBlur(change, (0, 0), pitch / 8) - cv2.GaussianBlur(change, (0, 0), pitch / 2.5)
    spots *= np.sign(np.sum(spots**3))  # pins are darker than the gel, or all of them brighter
    window = 2 * round(pitch / 4) + 1
    peak = (spots == cv2.dilate(spots, np.ones((window, window)))) & (spots > 0)
    peak[[0, -1], :] = peak[:, [0, -1]] = False
    y, x = np.nonzero(peak)
    strongest = np.argsort(-spots[y, x])[: rows * columns]
    if len(strongest) < rows * columns or spots[y, x][strongest[-1]] < _BEST_SHARE * spots[y, x][strongest].mean():
        strong = int(np.sum(spots[y, x] >= _BEST_SHARE * np.max(spots)))
        raise GeometryError(
            f"the board shows {strong} of {rows * columns} pins: press it evenly, all pins in the picture"
        )
    found = np.stack([_refined(spots, i, j) for i, j in zip(y[strongest], x[strongest], strict=True)])
    return _in_grid(found, rows, columns)


def fit_geometry(pins_px: np.ndarray, *, pitch_mm: float, size_px: tuple[int, int]) -> CameraGeometry:
    """Fit the geometry to the pins of a board, and test it on pins left out.

    Args:
      pins_px: from `find_pins`, [rows, columns, 2].
      pitch_mm: between neighbouring pins.
      size_px: rows and columns of the picture.

    Raises:
      GeometryError: too few pins for the model.
    """
    rows, columns = pins_px.shape[:2]
    if min(rows, columns) < 4 or pitch_mm <= 0:
        raise GeometryError(f"pins_px is {rows}×{columns} at {pitch_mm} mm: must be ≥ 4×4 and > 0; use a finer board")
    x, y = np.meshgrid(np.arange(columns) - columns // 2, np.arange(rows) - rows // 2)
    true = pitch_mm * np.stack([x, y], -1).reshape(-1, 2).astype(np.float64)
    seen = pins_px.reshape(-1, 2)
    whole = _fit(seen, true, size_px)
    errors = []
    for fold in range(_FOLDS):
        left_out = np.arange(len(seen)) % _FOLDS == fold
        errors.append(_fit(seen[~left_out], true[~left_out], size_px).to_mm(seen[left_out]) - true[left_out])
    held_out = float(np.sqrt(np.mean(np.sum(np.concatenate(errors) ** 2, -1))))
    return dataclasses.replace(whole, held_out_mm=held_out)


def _fit(seen: np.ndarray, true: np.ndarray, size_px: tuple[int, int]) -> CameraGeometry:
    start = cv2.findHomography(seen, true)[0]
    if start is None:
        raise GeometryError("the pins lie on a line: press the board flat, all pins in the picture")
    middle = np.array([size_px[1], size_px[0]]) / 2
    half = _half_diagonal(size_px)

    def unpack(v: np.ndarray) -> CameraGeometry:
        scale = start / start[2, 2]
        homography = scale * (1 + np.append(v[4:], 0.0).reshape(3, 3))
        return CameraGeometry(
            size_px=size_px,
            centre_px=middle + half * v[:2],
            radial=v[2:4],
            homography=homography,
            rms_mm=0,
            held_out_mm=0,
        )

    guess = np.concatenate([np.zeros(2), [_START, 0.0], np.zeros(8)])
    found = least_squares(lambda v: (unpack(v).to_mm(seen) - true).ravel(), guess, x_scale="jac")
    rms = float(np.sqrt(2 * np.mean(found.fun**2)))  # of the distance, two components
    return dataclasses.replace(unpack(found.x), rms_mm=rms)


def _in_grid(points: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Order points by walking from neighbour to neighbour, from the one in the middle outwards."""
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    first = int(np.argmin(np.linalg.norm(points - np.median(points, 0), axis=-1)))
    near = points[np.argsort(distance[first])[1:5]] - points[first]
    right = near[np.argmax(near @ [1.0, 0.0])]
    down = near[np.argmax(near @ [0.0, 1.0])]
    cell = {first: (0, 0)}
    step = {first: np.stack([right, down])}
    queue = [first]
    while queue:
        at = queue.pop(0)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            expected = points[at] + sign * step[at][axis]
            other = int(np.argmin(np.linalg.norm(points - expected, axis=-1)))
            if other in cell or np.linalg.norm(points[other] - expected) > 0.4 * np.linalg.norm(step[at][axis]):
                continue
            cell[other] = (cell[at][0] + sign * (axis == 0), cell[at][1] + sign * (axis == 1))
            local = step[at].copy()
            local[axis] = sign * (points[other] - points[at])
            step[other] = local
            queue.append(other)
    keys = np.array([cell[i] for i in cell])
    keys -= keys.min(0)
    grid = np.full((rows, columns, 2), np.nan)
    if (
        len(cell) == rows * columns
        and tuple(keys.max(0) + 1) == (columns, rows)
        and len({*map(tuple, keys)}) == len(keys)
    ):
        grid[keys[:, 1], keys[:, 0]] = points[list(cell)]
    if np.isnan(grid).any():
        raise GeometryError(
            f"{len(cell)} of {len(points)} spots lie on a grid of {(keys.max(0) + 1).tolist()[::-1]}, not "
            f"[{rows}, {columns}]: press the board straight and evenly, or correct rows and columns"
        )
    return grid


def _refined(spots: np.ndarray, i: int, j: int) -> np.ndarray:
    """(x, y) of a maximum, by a parabola along either axis."""
    return np.array([j + _vertex(spots[i, j - 1 : j + 2]), i + _vertex(spots[i - 1 : i + 2, j])])


def _vertex(three: np.ndarray) -> float:
    before, middle, after = map(float, three)
    bend = before - 2 * middle + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0


def _stretch(r2: np.ndarray, radial: np.ndarray) -> np.ndarray:
    """a(λ r²) (1 + k r²)."""
    return _arc(radial[0] * r2) * (1 + radial[1] * r2)


def _slope(r: np.ndarray, radial: np.ndarray) -> np.ndarray:
    """Derivative of r · stretch by r."""
    z = radial[0] * r**2
    return (1 + radial[1] * r**2) / (1 + z) + 2 * radial[1] * r**2 * _arc(z)


def _arc(z: np.ndarray) -> np.ndarray:
    """atan(√z)/√z, continued to z < 0 by atanh(√−z)/√−z, and through 0 by its series."""
    root = np.sqrt(np.maximum(np.abs(z), 1e-12))
    negative = np.arctanh(np.minimum(root, 1 - 1e-9)) / root
    far = np.where(z > 0, np.arctan(root) / root, negative)
    return np.where(np.abs(z) < 1e-4, 1 - z / 3 + z**2 / 5, far)


def _project(homography: np.ndarray, point: np.ndarray) -> np.ndarray:
    moved = point @ homography[:, :2].T + homography[:, 2]
    return moved[..., :2] / moved[..., 2:]


def _half_diagonal(size_px: tuple[int, int]) -> float:
    return float(np.hypot(*size_px)) / 2


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
