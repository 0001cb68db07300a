"""Thin-plate spline through scattered displacements: everything about the points is computed once.

The spline f of displacements d_i at points p_i minimises Σ |f(p_i) − d_i|² + λ ∫ |∇∇f|².  It is linear in d:

    f = M d,   M = [Φ Q] [[K + λ, P], [Pᵀ, 0]]⁻¹,   K_ij = φ(|p_i − p_j|),   φ(r) = r² ln r,

and so is everything else that is asked of it.  With B the upper left block of the inverse, the displacements of lost
points L that leave the spline of the others unchanged are d_L = −B_LL⁻¹ B_LK d_K, and the error of point i as the
others predict it is (B d)_i / B_ii.

Source: Wahba, Spline Models for Observational Data, 1990, ch. 2 and 4 (leaving out one).
"""

import numpy as np

_NODES_PER_PITCH = 4
"""Spacing at which the spline itself is evaluated; cubic interpolation between is off by < 0.001 of the motion."""


class ThinPlate:
    """The spline through P points.

    Args:
      points_px: (x, y) [P, 2], not all on one line.
      smoothing: λ, relative to the points' pitch squared: 0 interpolates.

    Raises:
      ValueError: fewer than four points, or all of them on a line.
    """

    def __init__(self, points_px: np.ndarray, smoothing: float = 1e-4):
        points = np.asarray(points_px, np.float64)
        self._origin = points.mean(0)
        self._unit = _pitch(points)
        self._at = (points - self._origin) / self._unit
        if len(points) < 4 or np.linalg.matrix_rank(self._at, tol=1e-6) < 2:
            raise ValueError(
                f"points_px holds {len(points)} points: a spline needs four that are not on a line; find more markers"
            )
        kernel = _radial(self._at, self._at) + smoothing * np.eye(len(points))
        plane = _plane(self._at)
        inverse = np.linalg.inv(np.block([[kernel, plane], [plane.T, np.zeros((3, 3))]]))
        self._coefficients = inverse[:, : len(points)]
        bending = inverse[: len(points), : len(points)]
        self._bending = (bending + bending.T) / 2  # symmetric but for rounding

    def __len__(self) -> int:
        return len(self._at)

    @property
    def pitch_px(self) -> float:
        """Typical distance of a point to its nearest neighbour."""
        return self._unit

    @property
    def roughness(self) -> np.ndarray:
        """B [P, P]: d·B d is the bending energy of the spline through displacements d [P] along one axis."""
        return self._bending

    def matrix(self, at_px: np.ndarray) -> np.ndarray:
        """M at points (x, y) [Q, 2]: displacements [P, …] → displacements [Q, …], float32 [Q, P]."""
        at = (np.asarray(at_px, np.float64) - self._origin) / self._unit
        return (np.hstack([_radial(at, self._at), _plane(at)]) @ self._coefficients).astype(np.float32)

    def filled(self, displacement: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Displacements [P, 2] with those that are not found replaced by what the spline of the others says.

        Args:
          displacement: [P, 2]; what stands at lost points is not read.
          found: bool [P].

        Raises:
          ValueError: fewer than four points are found.
        """
        lost = ~found
        if found.sum() < 4:
            raise ValueError(f"found holds {found.sum()} of {len(found)} points: a spline needs four; refuse the frame")
        filled = np.array(displacement, np.float64)
        if lost.any():
            known = self._bending[np.ix_(lost, found)] @ filled[found]
            filled[lost] = -np.linalg.solve(self._bending[np.ix_(lost, lost)], known)
        return filled.astype(np.float32)

    def inconsistent(self, displacement: np.ndarray, found: np.ndarray, tolerance: float) -> np.ndarray:
        """Mask of found points that contradict the others: the worst is removed until none is off by the tolerance.

        Args:
          displacement: [P, 2].
          found: bool [P].
          tolerance: pixels, by which a point may differ from what the spline of all others predicts.

        Returns:
          bool [P], at most all but four of the found ones.
        """
        kept = np.flatnonzero(found)
        out = np.zeros(len(found), bool)
        if len(kept) <= 4:  # nothing is left to predict by, and below three points no plane
            return out
        try:
            bending = self._of(found)
        except np.linalg.LinAlgError:  # they lie on a line, so that none predicts another
            return found.copy()
        while len(kept) > 4:
            error = np.hypot(*(bending @ displacement[kept]).T) / np.diag(bending)
            worst = int(error.argmax())
            if error[worst] <= tolerance:
                break
            out[kept[worst]] = True
            bending = _without(bending, np.arange(len(kept)) == worst)
            kept = np.delete(kept, worst)
        return out

    def bending(self, displacement: np.ndarray, found: np.ndarray) -> float:
        """Σ d·B d over the found points, B that of them alone: how far the field is from an affine one, pixels²."""
        kept = displacement[found]
        return float(np.sum(kept * (self._of(found) @ kept)))

    def _of(self, found: np.ndarray) -> np.ndarray:
        """B of the found points alone."""
        return self._bending if found.all() else _without(self._bending, ~found)


class Densifier:
    """From displacements at P points to a field at every pixel, by matrices that are made once.

    The spline is evaluated on coarse nodes and interpolated along rows and columns: at every pixel it would cost a
    matrix that does not fit in the cache.

    Args:
      spline: through the points.
      shape: (height, width) of the picture.
    """

    def __init__(self, spline: ThinPlate, shape: tuple[int, int]):
        step = max(1.0, spline.pitch_px / _NODES_PER_PITCH)
        (y, self._rows), (x, self._columns) = (_cubic(side, step) for side in shape)
        self._matrix = spline.matrix(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))

    def __call__(self, displacement: np.ndarray) -> np.ndarray:
        """Field [H, W, 2] of displacements [P, 2], float32."""
        nodes = displacement.T.astype(np.float32) @ self._matrix.T
        planes = self._rows @ nodes.reshape(2, self._rows.shape[1], -1) @ self._columns.T
        return np.moveaxis(planes, 0, -1)


def _pitch(points: np.ndarray) -> float:
    gaps = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) + np.diag(np.full(len(points), np.inf))
    return float(np.median(gaps.min(1)))


def _radial(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    squared = ((a[:, None] - b[None]) ** 2).sum(-1)
    return 0.5 * squared * np.log(np.where(squared > 0, squared, 1.0))


def _plane(points: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(points)), points])


def _without(bending: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """B of the points that are left, by the Schur complement of those that are lost."""
    kept = ~lost
    cross = bending[np.ix_(lost, kept)]
    return bending[np.ix_(kept, kept)] - cross.T @ np.linalg.solve(bending[np.ix_(lost, lost)], cross)


def _cubic(side: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [n] around the pixels 0..side − 1, and the matrix [side, n] that interpolates between them.

    Source: Keys 1981, a = −1/2, which reproduces quadratics.
    """
    count = int(np.ceil((side - 1) / step)) + 4
    nodes = (side - 1) / 2 + (np.arange(count) - (count - 1) / 2) * step
    away = np.abs(np.arange(side)[:, None] - nodes) / step
    near = (1.5 * away - 2.5) * away**2 + 1
    far = ((-0.5 * away + 2.5) * away - 4) * away + 2
    weights = np.where(away < 1, near, np.where(away < 2, far, 0))
    return nodes, np.ascontiguousarray(weights, np.float32)
