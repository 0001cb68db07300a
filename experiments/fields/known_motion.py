"""Known motion of marker gels: gels at rest, real and generated, and the pictures that a camera takes as they move.

The gel at y came from y − b(y), so the picture at y is the picture at rest at y − b(y), and a point p moves by
f(p) = b(p + f(p)).  Both are exact: b is a formula, the picture at rest a cubic spline.  (OpenCV's cubic `remap` rounds
coordinates to 1/32 pixel, which is as large as the errors that are measured here.)
"""

import dataclasses
import pathlib
from collections.abc import Sequence

import cv2
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from sensors_io.calibration.published import load
from sensors_io.fields.deformation import DeformationReader
from sensors_io.scenes import optics
from sensors_io.scenes.sensors import DMTAC_X, XENSE, SensorModel
from sensors_io.scenes.units import unit_of

PEAK_PX, JUMP_PX = 12.0, 28.0  # greatest displacement of a motion and of a jump, on a picture 320 pixels wide
NOISE_GREY = 2.0  # standard deviation of the camera's noise, grey levels
FIRST_SEED = 400
"""Of motions and noise in reports: settings were chosen on motions of the seeds 0 to 3, on other pictures."""

REST_PICTURES = 16  # pictures whose mean is the background: one alone would add its noise to that of every later one
_FIXED_POINT, _UNCHANGED_PX = 80, 1e-9  # iterations of f = b(p + f) at most, and the change that ends them
_LIGHT_GREY, _LIGHT_WIDTH = 25.0, 0.18  # coloured shading of a contact: grey levels, and share of the shorter side
_CENTRE = 0.55, 0.45  # of the contact, over width and height

REAL_GELS = {
    "GelSight Mini": ("FOTS/marker_calib/data/1.png", 0),
    "GelSlim": ("gelslim/test_data/sample_13.jpg", 0),
    "GelSlim 2": ("gelsight_heightmap/test_data/sample_34.jpg", 0),
    "GelSight bench": ("gelsight_driver/track_markers/video.avi", 24),
    "GelSight gripper": ("letac_mpc/hard_rubber/*dp_1_*/*000001.jpg", 0),
}
"""Gel → pattern in the data directory, and frame of a video, of the picture that stands for the gel at rest.

The tracker's settings, the windows and the number of rest pictures were chosen on others: `marker_calib/data/3.png`,
the two `ref.jpg`, frame 0 of the video and the first picture of `letac_mpc/gel`.
"""


def grey(picture: np.ndarray) -> np.ndarray:
    """RGB uint8 [H, W, 3] → uint8 [H, W]."""
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelMotion:
    """Shear, twist and spread of a pressed gel, in pixels.

        b(y) = s [ (c₀ + c₁ξ + c₂η) g + k₀,  (c₃ + c₄ξ + c₅η) g + k₁ ],  g = exp(−(ξ² + η²)/2)

    with the distances ξ and η from `centre_px` over `width_px`, the `bump` c, the `drift` k of the whole gel and the
    scale s.
    """

    centre_px: tuple[float, float]
    width_px: float
    bump: Sequence[float]
    drift: tuple[float, float]
    scale_px: float

    def backward(self, points: np.ndarray) -> np.ndarray:
        """b at points (x, y) […, 2]."""
        xi, eta = ((points[..., i] - self.centre_px[i]) / self.width_px for i in (0, 1))
        g = np.exp(-(xi**2 + eta**2) / 2)
        parts = zip((self.bump[:3], self.bump[3:]), self.drift, strict=True)
        return self.scale_px * np.stack([(c[0] + c[1] * xi + c[2] * eta) * g + drift for c, drift in parts], -1)

    def forward(self, points: np.ndarray) -> np.ndarray:
        """f at points (x, y) […, 2]."""
        moved = np.zeros(points.shape)
        for _ in range(_FIXED_POINT):
            before, moved = moved, self.backward(points + moved)
            if np.abs(moved - before).max() < _UNCHANGED_PX:
                break
        return moved

    def times(self, share: float) -> "GelMotion":
        """The same motion, larger or smaller."""
        return dataclasses.replace(self, scale_px=share * self.scale_px)


def pressed(shape: tuple[int, ...], peak_px: float, rng: np.random.Generator | None = None) -> GelMotion:
    """A motion whose greatest |b| over a picture of this shape is `peak_px`.

    Place, width and coefficients are drawn, without `rng` those of the published figures.
    """
    height, width = shape[:2]
    drawn: Sequence[float] = (0.7, 0.25, -0.25, 0.4, 0.25, 0.25, 0.1, -0.05)
    centre, share = _CENTRE, 0.22
    if rng is not None:
        drawn = (rng.normal(0, 1, 8) * (0.6, 0.3, 0.3, 0.6, 0.3, 0.3, 0.1, 0.1)).tolist()
        centre, share = tuple(rng.uniform(0.35, 0.65, 2)), float(rng.uniform(0.18, 0.3))
    raw = GelMotion(
        centre_px=(centre[0] * width, centre[1] * height),
        width_px=share * min(height, width),
        bump=drawn[:6],
        drift=(drawn[6], drawn[7]),
        scale_px=1.0,
    )
    peak = np.linalg.norm(raw.backward(_pixels(shape)), axis=-1).max()
    return raw.times(peak_px / float(peak))


class GelCamera:
    """Pictures of one gel under known motion; `rest` is RGB uint8 [H, W, 3], `noise_grey` the noise's deviation."""

    def __init__(self, rest: np.ndarray, noise_grey: float, seed: int):
        self._splines = [spline_filter(rest[..., c].astype(np.float64), order=3) for c in range(3)]
        self._pixels = _pixels(rest.shape)
        self._noise_grey = noise_grey
        self._rng = np.random.default_rng(seed)
        self._rest = rest.astype(np.float64)
        self._light = _contact_light(rest.shape)

    def at_rest(self, pictures: int = REST_PICTURES) -> np.ndarray:
        """The gel at rest, the mean of some pictures as a background is recorded, RGB uint8."""
        seen = [self.exposed(self._rest) for _ in range(pictures)]
        return np.asarray(np.round(np.mean(seen, 0)), np.uint8)

    def under(self, motion: GelMotion, light: float = 1.0, exposure: float = 1.0) -> np.ndarray:
        """The gel under a motion, RGB uint8; `light` is the strength of the contact's coloured shading."""
        return self.exposed(exposure * self.clean(motion, light))

    def clean(self, motion: GelMotion, light: float) -> np.ndarray:
        """The gel under a motion without noise and rounding, float64."""
        source = self._pixels - motion.backward(self._pixels)
        at = [source[..., 1], source[..., 0]]
        planes = [map_coordinates(s, at, order=3, prefilter=False, mode="nearest") for s in self._splines]
        return np.stack(planes, -1) + light * self._light

    def exposed(self, picture: np.ndarray) -> np.ndarray:
        """A clean picture as the camera gives it, RGB uint8."""
        noisy = picture + self._noise_grey * self._rng.standard_normal(picture.shape, picture.dtype.type)
        return np.round(np.clip(noisy, 0, 255)).astype(np.uint8)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MarkerGel:
    """A gel at rest, RGB uint8 [H, W, 3], as the package tracks it: points [P, 2], half side of their windows.

    On a dense pattern half the side of a window stands for the radius of a dot.
    """

    name: str
    picture: np.ndarray
    real: bool
    points_px: np.ndarray
    half_px: int
    dot_radius_px: float

    @property
    def unit(self) -> float:
        """Pixels per pixel of a picture 320 wide."""
        return self.picture.shape[1] / 320

    def motion(self, peak_px: float, seed: int | None) -> GelMotion:
        """A motion of a peak on a picture 320 wide; without a seed the one of published figures."""
        rng = None if seed is None else np.random.default_rng(seed)
        return pressed(self.picture.shape, peak_px * self.unit, rng)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Bool [P], points whose window lies in the picture."""
        height, width = self.picture.shape[:2]
        margin = self.half_px + 1
        return np.all((points >= margin) & (points <= np.array([width, height]) - 1 - margin), -1)


def gels(data_dir: pathlib.Path | None, most: int | None = None) -> list[MarkerGel]:
    """The real gels in the data directory, and the generated ones; the first `most` of them.

    Raises:
      FileNotFoundError: a data directory that holds none of the pictures.
    """
    found = [(n, sorted(data_dir.glob(pattern)), i) for n, (pattern, i) in REAL_GELS.items()] if data_dir else []
    real = [(name, load(paths[0], frame)) for name, paths, frame in found if paths]
    if data_dir is not None and not real:
        wanted = ", ".join(pattern for pattern, _ in REAL_GELS.values())
        raise FileNotFoundError(f"data_dir is {data_dir}: must hold one of {wanted}; correct the path")
    generated = [("Xense, generated", _generated(XENSE, 240, 1)), ("DM-Tac, generated", _generated(DMTAC_X, 240, 3))]
    return [_tracked(*gel, i < len(real)) for i, gel in enumerate([*real, *generated][:most])]


def _generated(sensor: SensorModel, side_px: int, order: int) -> np.ndarray:
    """The gel of a generated sensor at rest, without noise."""
    if sensor.render is None:
        raise ValueError(f"{sensor.name} exposes no camera: it has no picture; choose another sensor")
    still = dict.fromkeys(("depth_mm", "marker_x_mm", "marker_y_mm", "marker_depth_mm"), jnp.zeros((side_px, side_px)))
    gel = optics.DeformedGel(**still, window_mm=sensor.window_mm)
    picture = np.asarray(sensor.render(gel, unit_of(0, order, 0).light))
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def _tracked(name: str, picture: np.ndarray, real: bool) -> MarkerGel:
    """A gel with the points, windows and dots that the package finds on it."""
    reader = DeformationReader(picture, mm_per_px=1.0)
    dots, half, points = reader.evidence.markers, reader.tracker.half_px, reader.tracker.points_px
    radius = float(half) if dots is None else dots.radius_px
    return MarkerGel(name=name, picture=picture, real=real, points_px=points, half_px=half, dot_radius_px=radius)


def _pixels(shape: tuple[int, ...]) -> np.ndarray:
    """Pixel centres (x, y) [H, W, 2]."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    return np.stack([x, y], -1)


def _contact_light(shape: tuple[int, ...]) -> np.ndarray:
    """Grey levels that a contact's slopes add to the three colours, lamps a third of a turn apart, [H, W, 3]."""
    away = _pixels(shape) - np.array(_CENTRE) * np.array(shape[1::-1])
    width = _LIGHT_WIDTH * min(shape[:2])
    bell = np.exp(-(away**2).sum(-1) / (2 * width**2))
    angle = np.arctan2(away[..., 1], away[..., 0])
    lamps = np.arange(3) * 2 * np.pi / 3
    return _LIGHT_GREY * bell[..., None] * np.cos(angle[..., None] + lamps)
