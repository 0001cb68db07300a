"""Scattered displacements brought to the smoothest field that their own noise warrants, picture by picture.

The points of a gel move together, the noise of each is its own.  With the spline's bending matrix B (`spline`),

    f = argmin Σ |f_i − d_i|² + λ Σ f·B f = (1 + λB)⁻¹ d,
    λ = argmin |d − f|² / (P − tr (1 + λB)⁻¹)²     (generalised cross-validation),

where the eigenvectors of B, found once, turn every λ into a product.  Gel at rest moves as one affine piece, and is
read several times as precisely as each point alone; a motion that is clear of the noise stands as it was measured.

Source: Craven & Wahba, Numerische Mathematik 31, 377, 1979.
"""

import numpy as np

from sensors_io.fields.spline import ThinPlate

_AFFINE = 3  # modes that bend nothing: a shift and two slopes
_STRENGTHS = np.logspace(-5, 5, 41)  # λ, of the points' pitch squared: from none to all but an affine motion


class Smoother:
    """Smooths displacements of P points.

    Args:
      spline: through the points.
    """

    def __init__(self, spline: ThinPlate):
        stiffness, modes = np.linalg.eigh(spline.roughness)
        bent = _STRENGTHS[:, None] * np.maximum(stiffness[_AFFINE:], 0)
        self._modes = modes[:, _AFFINE:]
        self._removed = bent / (1 + bent)  # of each mode, by strength
        self._freedom = self._removed.sum(1)

    def __call__(self, displacement: np.ndarray) -> np.ndarray:
        """Smoothed displacements [P, 2] float32 of measured ones [P, 2]."""
        along = self._modes.T @ displacement
        left = self._removed**2 @ (along**2).sum(1)
        best = int(np.argmin(left / self._freedom**2))
        smoothed = displacement - self._modes @ (self._removed[best][:, None] * along)
        return smoothed.astype(np.float32)
