"""The imprint of a ball as a camera sees it: normals and depth blurred by the coating, the light and the lens.

The rim of a contact is a kink of the surface, and no picture shows a kink.  A camera sees the field of normals of
`presses.indentation` blurred by a Gaussian of standard deviation b, of 0.15 to 0.35 mm on real sensors.  Inside the
contact the normal of a ball is linear in the position, and blurring leaves it as it is; within 1.5 b of the rim it is
smaller by 5 to 50 %.  A map that is fitted to the kink reads mid slopes 1 to 9 % too steep, and balls too small.

For a radial vector field n(ρ) ρ̂ and a scalar field u(ρ) the blurred fields are again radial,

    n_b(r) = ∫ n(ρ) K_1(r, ρ) dρ,   u_b(r) = ∫ u(ρ) K_0(r, ρ) dρ,
    K_ν(r, ρ) = (ρ / b²) exp(−(r² + ρ²) / 2b²) I_ν(rρ / b²).
"""

import functools

import numpy as np
from scipy import special

from sensors_io.calibration.presses import indentation

CONTACTS = (0.12, 0.97)
"""Contact radii considered, in ball radii."""

BLUR_MM = 0.18
"""Blur of the pictures: presses of two real sensors are explained best by 0.15 and by 0.2 mm."""

_STEP = 1 / 60  # of the radial grid, in ball radii
_REACH, _SOURCE = 2.2, 3.2  # ball radii up to which profiles are known, and from which light is blurred in
_ROWS = 64  # contact radii of the table


class Imprint:
    """Blurred normals and depth of a ball at any contact radius, interpolated from a table.

    Args:
      radius_mm: of the ball, R.
      blur_mm: standard deviation b; 0 leaves the surface sharp.
    """

    def __init__(self, radius_mm: float, blur_mm: float):
        self.radius_mm, self.blur_mm = radius_mm, blur_mm
        self._table = _table(round(blur_mm / radius_mm, 9))

    def __call__(self, dx_mm: np.ndarray, dy_mm: np.ndarray, contact_mm: float) -> np.ndarray:
        """In-plane parts of the unit normal and depth in mm, [3, …], at distances dx, dy from the ball's axis.

        The normal points out of the gel's indentation: n = ∇u / √(1 + |∇u|²), towards the axis.

        Args:
          dx_mm, dy_mm: of one shape.
          contact_mm: contact radius, limited to `CONTACTS`.
        """
        at = np.clip(contact_mm / self.radius_mm, *CONTACTS) - CONTACTS[0]
        at *= (_ROWS - 1) / (CONTACTS[1] - CONTACTS[0])
        row = min(int(at), _ROWS - 2)
        per_r, depth = (1 - (at - row)) * self._table[row] + (at - row) * self._table[row + 1]
        r = np.sqrt(dx_mm**2 + dy_mm**2) * (1 / (_STEP * self.radius_mm))
        cell = np.minimum(r.astype(np.int32), len(depth) - 2)
        share = np.minimum(r - cell, 1.0)
        steep = per_r[cell] + share * (per_r[cell + 1] - per_r[cell])
        down = depth[cell] + share * (depth[cell + 1] - depth[cell])
        unit = steep / self.radius_mm
        return np.stack([unit * dx_mm, unit * dy_mm, down * self.radius_mm])


@functools.lru_cache(maxsize=32)
def _table(blur: float) -> np.ndarray:
    """n(r) / r and u(r) of a ball of radius 1 at every contact radius, [contact radii, 2, r]."""
    r = _STEP * np.arange(round(_REACH / _STEP) + 1)
    rho = _STEP * np.arange(round((_SOURCE if blur else _REACH) / _STEP) + 1)
    contacts = np.linspace(*CONTACTS, _ROWS)
    u, slope, _ = np.stack([indentation(rho, np.zeros_like(rho), a, 1.0) for a in contacts], 1)
    normal = slope / np.sqrt(1 + slope**2)
    if blur:
        width = np.maximum(blur, _STEP)
        product = np.outer(r, rho) / width**2
        weight = _STEP * rho / width**2 * np.exp(-((r[:, None] - rho) ** 2) / (2 * width**2))
        normal, u = normal @ (weight * special.ive(1, product)).T, u @ (weight * special.ive(0, product)).T
    per_r = normal / np.where(r > 0, r, 1)
    per_r[:, 0] = per_r[:, 1]
    return np.stack([per_r, u], 1)
