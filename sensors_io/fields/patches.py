"""Small windows of a reference picture, found again in another picture to a few hundredths of a pixel.

Around each point the gel moves affinely, d(r) = d₀ + Ar, and its brightness changes by a gain, an offset and a slope,
because the light turns with the surface.  All ten numbers are fitted at once,

    min Σ_r w(r) [ I(p + r + d(r)) − T(p + r) − g T(p + r) − (a + b·r) ]²,

by inverse compositional Gauss–Newton, whose Hessian is that of the reference and is inverted once.  Leaving out either
half costs: without A the gel's strain biases d₀, without the light its shading does.

Source: Baker & Matthews, IJCV 56, 221, 2004.  Departure: the window's centre lies on a pixel, so that the reference
is never interpolated, and both pictures are blurred by 0.8 px, so that bilinear interpolation has no bias to speak of.
"""

import dataclasses

import cv2
import numpy as np

_BLUR_PX = 0.8
_WEIGHT_SHARE = 0.7  # standard deviation of the window's weight over its half side
_ITERATIONS = 3  # from a start within a tenth of a pixel; the third changes it by 0.003 px
_MOTION, _LIGHT = 6, 4  # unknowns: (d₀, A) and (a, b, g)
_LARGEST_STEP_PX = 2.0  # a step past it is a window that slipped off its dot
_NOISE_LEFT = 1 / (4 * np.pi * _BLUR_PX**2)  # of the variance of white noise, after the blur


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """Positions of P windows in a picture.

    `points_px` [P, 2]; `likeness` ρ [P]: correlation of window and reference after the fit, in −1..1; `spread_px` [P]:
    standard deviation of the point that the noise in its window makes, infinite where ρ ≤ 0.
    """

    points_px: np.ndarray
    likeness: np.ndarray
    spread_px: np.ndarray


class Patches:
    """Windows around P points of a reference picture.

    Args:
      reference: grey picture [H, W], uint8 or float32.
      points_px: (x, y) [P, 2]; every window must lie inside the picture.
      half_px: half side of the windows, which hold (2 half_px + 1)² pixels.

    Raises:
      ValueError: a window that leaves the picture.
    """

    def __init__(self, reference: np.ndarray, points_px: np.ndarray, half_px: int):
        self._centre = np.round(points_px).astype(np.float32)
        self._offset = (points_px - self._centre).astype(np.float32)
        self._check(reference.shape, half_px)
        side = np.arange(-half_px, half_px + 1, dtype=np.float32)
        self._y, self._x = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
        weight = np.exp(-(self._x**2 + self._y**2) / (2 * (_WEIGHT_SHARE * half_px) ** 2))
        smooth = _smooth(reference)
        self._template = self._cut(smooth)
        design = self._design(smooth)
        weighted = design * weight[:, None]
        normal = weighted.transpose(0, 2, 1).astype(np.float64) @ design
        # a window without texture leaves its motion undecided: the least-norm step is then 0
        solve = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ weighted.transpose(0, 2, 1)
        self._to_motion = np.ascontiguousarray(solve[:, :_MOTION], np.float32)
        self._weight = (weight / weight.sum()).astype(np.float32)
        self._spread = self._spread_per_noise(normal)

    def __len__(self) -> int:
        return len(self._centre)

    def find(self, picture: np.ndarray, start_px: np.ndarray) -> Found:
        """Fit all windows.

        Args:
          picture: grey [H, W], uint8 or float32.
          start_px: about where the points lie, within half a pixel or so [P, 2].
        """
        smooth = _smooth(picture)
        affine = np.tile(np.eye(2, dtype=np.float32), (len(self), 1, 1))
        at = (start_px - self._offset).astype(np.float32)
        for _ in range(_ITERATIONS):
            error = self._sample(smooth, at, affine) - self._template
            step = (self._to_motion @ error[:, :, None])[:, :, 0]
            at, affine = _compose(at, affine, step)
        likeness = self._likeness(self._sample(smooth, at, affine))
        noise = np.sqrt(np.maximum(1 / np.maximum(likeness, 1e-6) ** 2 - 1, 0))
        return Found(
            points_px=at + (affine @ self._offset[:, :, None])[:, :, 0],
            likeness=likeness,
            spread_px=np.where(likeness > 0, noise * self._spread, np.inf),
        )

    def _check(self, shape: tuple[int, ...], half_px: int) -> None:
        low, high = self._centre.min(0) - half_px, self._centre.max(0) + half_px
        if np.any(low < 0) or np.any(high > np.array(shape[1::-1]) - 1):
            raise ValueError(
                f"points_px reach from {self._centre.min(0)} to {self._centre.max(0)}: windows of {half_px} px around "
                f"them must lie inside the picture of {shape[1]} × {shape[0]}; drop the points at the border"
            )

    def _spread_per_noise(self, normal: np.ndarray) -> np.ndarray:
        """Standard deviation of d₀, pixels, when noise of the window's own contrast lies in the blurred picture [P].

            σ_d = σ √(tr (N⁻¹)_dd / left),   σ² = s² (1/ρ² − 1)

        N is the normal matrix, s the contrast of the reference window; the blur leaves a share of the noise's variance
        and makes neighbours alike, so that the fit sees the noise of the unblurred picture.  N takes the weights of the
        window for inverse variances: under white noise σ_d is about twice the actual deviation.
        """
        covariance = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
        contrast = self._template - (self._template @ self._weight)[:, None]
        variance = (contrast**2) @ self._weight
        spread: np.ndarray = np.sqrt(variance * np.trace(covariance[:, :2, :2], axis1=1, axis2=2) / _NOISE_LEFT)
        return spread

    def _cut(self, picture: np.ndarray) -> np.ndarray:
        """The reference windows [P, K], without interpolation."""
        rows, columns = (self._centre[:, i : i + 1] + o for i, o in ((1, self._y), (0, self._x)))
        return picture[rows.astype(np.intp), columns.astype(np.intp)]

    def _design(self, picture: np.ndarray) -> np.ndarray:
        """Derivative of a window by the ten unknowns [P, K, 10]."""
        difference = np.array([[-0.5, 0, 0.5]], np.float32)
        along_x, along_y = (self._cut(cv2.filter2D(picture, -1, k)) for k in (difference, difference.T))
        x, y = self._x, self._y
        motion = [along_x, along_y, along_x * x, along_x * y, along_y * x, along_y * y]
        light = [np.ones_like(along_x), *(np.broadcast_to(a, along_x.shape) for a in (x, y)), self._template]
        return np.stack([*motion, *light], -1)

    def _sample(self, picture: np.ndarray, at: np.ndarray, affine: np.ndarray) -> np.ndarray:
        x = at[:, :1] + affine[:, 0, :1] * self._x + affine[:, 0, 1:] * self._y
        y = at[:, 1:] + affine[:, 1, :1] * self._x + affine[:, 1, 1:] * self._y
        return cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def _likeness(self, window: np.ndarray) -> np.ndarray:
        """Weighted correlation with the reference windows [P]; 0 for a window without contrast."""
        seen, wanted = (a - a @ self._weight[:, None] for a in (window, self._template))
        joint, own, other = ((a * b) @ self._weight for a, b in ((seen, wanted), (seen, seen), (wanted, wanted)))
        scale = np.sqrt(own * other)
        return np.divide(joint, scale, out=np.zeros_like(scale), where=scale > 0)


def _smooth(picture: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _BLUR_PX)


def _compose(at: np.ndarray, affine: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undo the step that the reference would have to make: W(r) ← W(ΔW⁻¹(r)), ΔW(r) = s + (1 + S) r."""
    too_far = np.hypot(step[:, 0], step[:, 1]) > _LARGEST_STEP_PX
    step = np.where(too_far[:, None], 0, step)
    a, b, c, d = 1 + step[:, 2], step[:, 3], step[:, 4], 1 + step[:, 5]
    inverse = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], 1) / (a * d - b * c)[:, None, None]
    affine = affine @ inverse
    return at - (affine @ step[:, :2, None])[:, :, 0], affine
