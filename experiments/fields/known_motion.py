"""Known motion on a real picture of a gel: what moves where, and the picture that a camera would take of it.

A displacement b(y) says where the gel at y came from, so that the picture at y is the picture at rest at y − b(y), and
a point p moves by f(p) = b(p + f(p)).  Both are exact: b is a formula, the picture at rest a cubic spline.  (OpenCV's
cubic `remap` rounds coordinates to a thirty-second of a pixel, which is as large as the errors that are measured here.)
"""

import dataclasses

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

REST_PICTURES = 16
"""Pictures that the background is the mean of: one alone would add its noise to that of every later one."""

_FIXED_POINT, _UNCHANGED_PX = 80, 1e-9  # iterations of f = b(p + f) at most, and the change that ends them
_LIGHT_GREY, _LIGHT_WIDTH = 25.0, 0.18  # coloured shading of a contact: grey levels, and share of the shorter side
_SETTLED = 0.55, 0.45  # centre of the contact, over width and height

MotionCoefficients = tuple[float, float, float, float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelMotion:
    """Shear, twist and spread of a pressed gel, in pixels.

        b(y) = s [ (c₀ + c₁ξ + c₂η) g + k₀,  (c₃ + c₄ξ + c₅η) g + k₁ ],  g = exp(−(ξ² + η²)/2)

    Args:
      centre_px: of the contact; ξ and η are the distances from it over `width_px`.
      width_px: of the contact.
      bump: c₀…c₅.
      drift: k₀, k₁: motion of the whole gel.
      scale_px: s.
    """

    centre_px: tuple[float, float]
    width_px: float
    bump: MotionCoefficients
    drift: tuple[float, float]
    scale_px: float

    def backward(self, points: np.ndarray) -> np.ndarray:
        """b at points (x, y) […, 2]."""
        xi, eta = ((points[..., i] - self.centre_px[i]) / self.width_px for i in (0, 1))
        g = np.exp(-(xi**2 + eta**2) / 2)
        c = self.bump
        along = (c[0] + c[1] * xi + c[2] * eta) * g + self.drift[0]
        across = (c[3] + c[4] * xi + c[5] * eta) * g + self.drift[1]
        return self.scale_px * np.stack([along, across], -1)

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
    """A motion of greatest displacement `peak_px`.

    Args:
      shape: of the picture.
      peak_px: greatest |b| over the picture.
      rng: draws place, width and mixture; `None` takes the mixture that published figures were measured with.
    """
    height, width = shape[:2]
    bump, drift, centre, share = (0.7, 0.25, -0.25, 0.4, 0.25, 0.25), (0.1, -0.05), _SETTLED, 0.22
    if rng is not None:
        drawn = rng.normal(0, 1, 8) * (0.6, 0.3, 0.3, 0.6, 0.3, 0.3, 0.1, 0.1)
        bump, drift = tuple(map(float, drawn[:6])), (float(drawn[6]), float(drawn[7]))  # type: ignore[assignment]
        centre, share = tuple(rng.uniform(0.35, 0.65, 2)), float(rng.uniform(0.18, 0.3))
    raw = GelMotion(
        centre_px=(centre[0] * width, centre[1] * height),
        width_px=share * min(height, width),
        bump=bump,
        drift=drift,
        scale_px=1.0,
    )
    peak = np.linalg.norm(raw.backward(_pixels(shape)), axis=-1).max()
    return raw.times(peak_px / float(peak))


class GelCamera:
    """Pictures of one gel under known motion.

    Args:
      rest: RGB uint8 [H, W, 3].
      noise_grey: standard deviation of the camera's noise.
      seed: of the noise.
    """

    def __init__(self, rest: np.ndarray, noise_grey: float, seed: int):
        self._splines = [spline_filter(rest[..., c].astype(np.float64), order=3) for c in range(3)]
        self._pixels = _pixels(rest.shape)
        self._noise_grey = noise_grey
        self._rng = np.random.default_rng(seed)
        self._rest = rest.astype(np.float64)
        self._light = _contact_light(rest.shape)

    def at_rest(self, pictures: int = REST_PICTURES) -> np.ndarray:
        """The unmoved gel, the mean of some pictures as a background is recorded, RGB uint8."""
        seen = [self.exposed(self._rest) for _ in range(pictures)]
        return np.asarray(np.round(np.mean(seen, 0)), np.uint8)

    def under(self, motion: GelMotion, light: float = 1.0, exposure: float = 1.0) -> np.ndarray:
        """The gel under a motion, RGB uint8.

        Args:
          motion: where everything goes.
          light: strength of the contact's coloured shading.
          exposure: factor of all brightness.
        """
        return self.exposed(exposure * self.clean(motion, light))

    def clean(self, motion: GelMotion, light: float) -> np.ndarray:
        """The same without noise and rounding, float64."""
        source = self._pixels - motion.backward(self._pixels)
        at = [source[..., 1], source[..., 0]]
        planes = [map_coordinates(s, at, order=3, prefilter=False, mode="nearest") for s in self._splines]
        return np.stack(planes, -1) + light * self._light

    def exposed(self, picture: np.ndarray) -> np.ndarray:
        """A clean picture as the camera gives it, RGB uint8."""
        noisy = picture + self._noise_grey * self._rng.standard_normal(picture.shape, picture.dtype.type)
        return np.round(np.clip(noisy, 0, 255)).astype(np.uint8)


def _pixels(shape: tuple[int, ...]) -> np.ndarray:
    """Pixel centres (x, y) [H, W, 2]."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    return np.stack([x, y], -1)


def _contact_light(shape: tuple[int, ...]) -> np.ndarray:
    """Grey levels that a contact's slopes add to the three colours, lamps a third of a turn apart, [H, W, 3]."""
    away = _pixels(shape) - np.array(_SETTLED) * np.array(shape[1::-1])
    width = _LIGHT_WIDTH * min(shape[:2])
    bell = np.exp(-(away**2).sum(-1) / (2 * width**2))
    angle = np.arctan2(away[..., 1], away[..., 0])
    lamps = np.arange(3) * 2 * np.pi / 3
    return _LIGHT_GREY * bell[..., None] * np.cos(angle[..., None] + lamps)
