"""Dots printed in a gel: found in one picture at rest, with no assumption about their lattice.

A dark disk of radius r and contrast C on a smoothly shaded skin makes the scale-normalised Laplacian

    R(σ) = σ² ∇² (G_σ ∗ I),   greatest at its centre for σ = r/√2, where R = 2C/e

(Lindeberg, IJCV 30, 79, 1998).  Linear shading has no Laplacian, so that no threshold on brightness is needed, and a
missing dot costs that dot only.
"""

import dataclasses

import cv2
import numpy as np

_SCALE_STEP = 2**0.5
_FINEST_PX = 1.2  # σ of a dot of 1.7 px radius: smaller ones are noise
_COARSEST_SHARE = 0.06  # largest σ over the shorter side of the picture: dots of a sixth of it
_WEAKEST = 0.4  # response of a dot over that of the typical strong one
_SIZE_RANGE = 2.0  # σ of a dot over the typical one, or its inverse
_APART = 2.0  # least distance of two dots, in σ of the stronger
_STRONG = 8  # as many of the strongest candidates as set what is typical


@dataclasses.dataclass(frozen=True, kw_only=True)
class Markers:
    """P dots of one gel at rest.

    Args:
      points_px: centres (x, y) [P, 2] float32, pixel centres at integers.
      radius_px: typical radius.
      pitch_px: typical distance to the nearest neighbour.
      contrast: typical darkness against the skin, in grey levels.
      scatter: interquartile range of the distances to the nearest neighbour over `pitch_px`; 0 for a lattice.
      spread: share of the cells of a 4 × 4 division of the picture that hold a dot.
    """

    points_px: np.ndarray
    radius_px: float
    pitch_px: float
    contrast: float
    scatter: float
    spread: float

    def __len__(self) -> int:
        return len(self.points_px)


def find_markers(grey: np.ndarray) -> Markers | None:
    """The dots of a gel at rest, `None` where fewer than four candidates exist.

    It does not judge whether they are dots; `evidence` does.

    Args:
      grey: uint8 or float32 [H, W].

    Source: maxima of the Laplacian over place and scale (Lindeberg 1998).  Departure: the scale of all dots is one,
    within a factor of two, which removes specks of dirt and the contact's own shading.
    """
    sigmas = _scales(min(grey.shape))
    stack = np.stack([_response(grey, sigma) for sigma in sigmas])
    scale, y, x = _maxima(stack)
    strength = stack[scale, y, x]
    order = np.argsort(-strength)
    kept = _typical(strength[order], sigmas[scale[order]])
    chosen = order[kept]
    chosen = chosen[_apart(np.column_stack([x, y])[chosen], _APART * sigmas[scale[chosen]])]
    if len(chosen) < 4:
        return None
    points = _refined(stack, scale[chosen], y[chosen], x[chosen])
    return _describe(points, sigmas[scale[chosen]], strength[chosen], grey.shape)


def inside(points_px: np.ndarray, shape: tuple[int, ...], margin_px: float) -> np.ndarray:
    """Mask of the points [P, 2] that lie at least `margin_px` inside a picture [H, W], bool [P]."""
    height, width = shape[:2]
    x, y = points_px[:, 0], points_px[:, 1]
    return (x >= margin_px) & (y >= margin_px) & (x <= width - 1 - margin_px) & (y <= height - 1 - margin_px)


def _scales(side: int) -> np.ndarray:
    """Standard deviations in pixels, finest first."""
    coarsest = max(_COARSEST_SHARE * side, _FINEST_PX * _SCALE_STEP**2)
    count = int(np.ceil(np.log(coarsest / _FINEST_PX) / np.log(_SCALE_STEP))) + 1
    return _FINEST_PX * _SCALE_STEP ** np.arange(count)


def _response(grey: np.ndarray, sigma: float) -> np.ndarray:
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma)
    return sigma**2 * cv2.Laplacian(smooth, cv2.CV_32F, ksize=1)


def _maxima(stack: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positive maxima over scale, row and column; the first and the last scale and the frame do not count."""
    wide = np.stack([cv2.dilate(layer, np.ones((3, 3), np.uint8)) for layer in stack])
    peak = np.maximum(np.maximum(wide[:-2], wide[1:-1]), wide[2:])
    inner = (stack[1:-1] >= peak) & (stack[1:-1] > 0)
    inner[:, [0, -1]] = False
    inner[:, :, [0, -1]] = False
    scale, y, x = np.nonzero(inner)
    return scale + 1, y, x


def _typical(strength: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Mask of the candidates, strongest first, whose strength and size are similar to those of the strongest."""
    if len(strength) == 0:
        return np.zeros(0, bool)
    strong = slice(0, _STRONG)
    ratio = sigma / np.median(sigma[strong])
    alike = (ratio <= _SIZE_RANGE * 1.01) & (ratio >= 1 / _SIZE_RANGE / 1.01)
    return alike & (strength >= _WEAKEST * np.median(strength[strong]))


def _apart(points: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Indices of points, strongest first, none of which lies within the distance of a stronger one."""
    kept: list[int] = []
    for i, point in enumerate(points):
        gaps = np.hypot(*(points[kept] - point).T) if kept else np.zeros(0)
        if np.all(gaps > distance[kept]):
            kept.append(i)
    return np.array(kept, np.intp)


def _refined(stack: np.ndarray, scale: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Vertex of the parabola through three neighbours along each axis, (x, y) [P, 2]."""
    centre = stack[scale, y, x]
    shift = []
    for before, after in (
        (stack[scale, y, x - 1], stack[scale, y, x + 1]),
        (stack[scale, y - 1, x], stack[scale, y + 1, x]),
    ):
        bend = 2 * centre - before - after
        shift.append(np.divide(after - before, 2 * bend, out=np.zeros_like(bend), where=bend > 0))
    offset = np.clip(np.column_stack(shift), -0.5, 0.5)
    return (np.column_stack([x, y]) + offset).astype(np.float32)


def _describe(points: np.ndarray, sigma: np.ndarray, strength: np.ndarray, shape: tuple[int, ...]) -> Markers:
    gaps = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))
    np.fill_diagonal(gaps, np.inf)
    low, pitch, high = np.quantile(gaps.min(1), [0.25, 0.5, 0.75])
    cells = np.floor(points / np.array(shape[1::-1]) * 4).clip(0, 3) @ np.array([1, 4])
    return Markers(
        points_px=points,
        radius_px=float(np.sqrt(2) * np.median(sigma)),
        pitch_px=float(pitch),
        contrast=float(np.e / 2 * np.median(strength)),
        scatter=float((high - low) / pitch),
        spread=len(np.unique(cells)) / 16,
    )
