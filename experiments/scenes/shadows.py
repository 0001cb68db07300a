"""Whether cast shadows matter: how much of what the fitted optics leave unexplained they could explain at best."""

import numpy as np

from experiments.core.context import Context
from sensors_io.scenes import fitting
from sensors_io.scenes.fitting import BallPresses, Profiles
from sensors_io.scenes.photometric import PhotometricOptics

ELEVATIONS_DEG = (10.0, 20.0, 35.0)
DIRECTIONS = 8
REACH_MM = np.linspace(0.25, 4.0, 12)
"""Distances along the ray to the lamp at which the gel may stand in its way."""


def shadow_gain(
    presses: BallPresses,
    profiles: Profiles,
    touches: np.ndarray,
    optics: PhotometricOptics,
    held_out: np.ndarray,
    context: Context,
) -> dict[str, float]:
    """Regress what is left on shadow depths from eight sides and three elevations, and ask the held-out presses.

        s_θα(r) = max_t (u(r + t θ) − u(r) − t tan α)₊

    is by how much the gel stands above the ray from r to a lamp in direction θ at elevation α.  Each channel may darken
    by any combination of them, which is more than lamps at fixed places could do: the share is an upper bound.

    Returns:
      `explained`, the share of the residual variance of the held-out presses; `residual_levels` and `left_levels`, its
      standard deviation without and with shadows, in grey levels.
    """
    size = DIRECTIONS * len(ELEVATIONS_DEG)
    normal, right, asked = np.zeros((size, size)), np.zeros((size, 3)), []
    seen = enumerate(zip(touches, presses.pictures, strict=True))
    for i, (touch, picture) in context.each("shadows", seen):
        rows, left = _shadows(presses, profiles, touch), _residual(presses, profiles, touch, picture, optics)
        if i in held_out:
            asked.append((rows, left))
        else:
            normal, right = normal + rows.T @ rows, right + rows.T @ left
    ridge = fitting.RIDGE * np.trace(normal) * np.eye(len(normal))
    weights = np.linalg.solve(normal + ridge, right)
    before = np.concatenate([left for _, left in asked])
    after = np.concatenate([left - rows @ weights for rows, left in asked])
    return {
        "explained": float(1 - after.var() / before.var()),
        "residual_levels": float(255 * before.std()),
        "left_levels": float(255 * after.std()),
    }


def _shadows(presses: BallPresses, profiles: Profiles, touch: np.ndarray) -> np.ndarray:
    """s at the pixels near a touch, [n, directions × elevations]."""
    x, y = fitting.points(presses.axis_mm, touch)
    here = profiles.field(touch, x, y)[0]
    found = []
    for angle in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        ray = x + REACH_MM[:, None] * np.cos(angle), y + REACH_MM[:, None] * np.sin(angle)
        above = profiles.field(touch, *ray)[0] - here
        tangents = np.tan(np.deg2rad(ELEVATIONS_DEG))
        found += [np.maximum(above - REACH_MM[:, None] * tangent, 0).max(0) for tangent in tangents]
    return np.stack(found, -1)


def _residual(
    presses: BallPresses, profiles: Profiles, touch: np.ndarray, picture: np.ndarray, optics: PhotometricOptics
) -> np.ndarray:
    """What the optics leave of the change near a touch, [n, 3]."""
    near = fitting.near(presses.axis_mm, touch)
    made = fitting.change(optics, profiles, touch, presses.axis_mm, presses.window_mm)
    return (picture - presses.background - made)[near]
