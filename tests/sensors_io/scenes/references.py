"""References in float64 and made gels that tests of scenes share."""

import jax.numpy as jnp
import numpy as np

from sensors_io.layer import Layer, depth_response, wave_numbers
from sensors_io.scenes import optics


def deformed(
    window_mm: float,
    depth: np.ndarray,
    x: np.ndarray | float = 0,
    y: np.ndarray | float = 0,
    marker_depth: np.ndarray | float = 0,
) -> optics.DeformedGel:
    """A gel with these fields [N, N] in mm, 0 where one is not given."""
    f = [jnp.asarray(a + 0 * depth, jnp.float32) for a in (depth, x, y, marker_depth)]
    return optics.DeformedGel(
        depth_mm=f[0], marker_x_mm=f[1], marker_y_mm=f[2], marker_depth_mm=f[3], window_mm=window_mm
    )


def light(
    texture: np.ndarray, gain: tuple[float, float, float] = (1, 1, 1), shift: tuple[float, float] = (0.0, 0.0)
) -> optics.Light:
    return optics.Light(
        exposure=jnp.ones(()), led_gain=jnp.array(gain), pattern_shift_mm=jnp.array(shift), texture=jnp.asarray(texture)
    )


def off(found: np.ndarray, true: np.ndarray) -> float:
    """Distance of a field from the true one, over the length of that."""
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def directions(points: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Cosine and sine of every wave vector of the half plane, 0 at rest and at the Nyquist wave number."""
    q_y, q_x = wave_numbers(points, spacing)
    q = np.hypot(q_y, q_x)
    inner = (np.abs(q_y) < np.pi / spacing * 0.999) & (q_x < np.pi / spacing * 0.999) & (q > 0)
    c, s = (np.where(inner, part / np.where(q > 0, q, 1), 0) for part in (q_x, q_y))
    return c, s


def shear_tensor(layer: Layer, points: int, spacing: float, depth_mm: float = 0.0) -> np.ndarray:
    """Displacement along x and y by traction along x and y, per wave vector [2, 2, points, points // 2 + 1]."""
    at = depth_response(np.hypot(*wave_numbers(points, spacing)), layer, depth_mm)
    c, s = directions(points, spacing)
    even, odd = (at.lateral_shear + at.transverse) / 2, (at.lateral_shear - at.transverse) / 2
    return np.array([[even + odd * (c**2 - s**2), 2 * odd * c * s], [2 * odd * c * s, even - odd * (c**2 - s**2)]])
