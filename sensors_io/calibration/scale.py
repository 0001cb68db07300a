"""Millimetres per pixel from presses of a known ball to known depths, where no board of pins is at hand.

A ball of radius R that has gone down by δ since it first touched a layer bonded to its window meets it in a circle of
radius a.  With the layer's compliance C and the pressure p of that circle,

    p(r) = Σ_k c_k (1 − r²/a²)^μ,   μ = k + ½,   p̂_k(q) = 2^μ Γ(μ + 1) a² J_{μ+1}(qa) / (qa)^{μ+1},
    ∫ C(q) p̂(q) J₀(qr) q dq = δ − R + √(R² − r²)   for r < a,

which gives δ and the c_k by least squares.  A half-space gives a² ≈ Rδ, gel that does not sink in around the ball
a² ≈ 2Rδ: the gel's thickness decides between the two, and taking one for the other errs by 41 %.

How far to trust it: pictures generated with the solved layer give a pitch 1.8 to 2.7 % too large, since the circles are
found as on a half-space.  Four real presses by stages (a GelSight of gelsight_sim2real's, ball of 5.84 mm, 0.25 to 1
mm) give 6 % more than the authors state, for a thickness of 4.5 mm that they do not; 19 % more for 2 mm.  A board of
pins is better.

Source: Johnson, Contact Mechanics, sections 3.4 and 5.8; Sneddon, Int. J. Eng. Sci. 3, 47, 1965 for the half-space.
"""

import dataclasses
import functools

import numpy as np
from scipy import optimize, special

from sensors_io.calibration.circles import Circles, find_circles
from sensors_io.calibration.geometry import GeometryError
from sensors_io.calibration.presses import BallPresses
from sensors_io.layer import Layer, normal_compliance

_TERMS = 5  # of the pressure
_RADII = 0.98 * np.sin(np.linspace(0, np.pi / 2, 16))  # r/a at which the gel must lie on the ball
_WAVES = 0.05 * np.arange(0.5, 8000)  # qa; the sum beyond is under 1e-4 of δ
_CONTACTS = (0.02, 0.95)  # a/R that are considered
_WINDOW_MM = 16.0  # width of the picture from which the search begins; the four sensors have 15 to 24
_MAD_TO_SIGMA, _OF_MEDIAN = 1.4826, 1.2533  # of a normal distribution; standard error of a median over the mean's
_SCHEDULE = (1, 1, 2, 2, 3, 3, 3, 3, 3, 3, 3, 3)  # degrees of the optics: the pitch needs radii that have settled
_ROUNDS, _SETTLED = 8, 2e-3  # of finding circles, and the relative change of the pitch that ends them


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scale:
    """Millimetres per pixel, with its standard error over the presses."""

    mm_per_px: float
    error: float


def approach_mm(contact_mm: float, ball_radius_mm: float, gel: Layer) -> float:
    """δ, how far a ball has gone down since it first touched, by its contact radius.

    Args:
      contact_mm: a < R.
      ball_radius_mm: R.
      gel: thickness and Poisson ratio count, the modulus does not.
    """
    pressures, waves = _transforms()
    lifted = waves @ (normal_compliance(_WAVES / contact_mm, gel) * pressures).T
    lifted /= lifted[0, 0]  # next to a column of ones, whatever the modulus
    gap = ball_radius_mm - np.sqrt(ball_radius_mm**2 - (_RADII * contact_mm) ** 2)
    found = np.linalg.lstsq(np.column_stack([-lifted, np.ones(len(_RADII))]), gap, rcond=None)[0]
    return float(found[-1])


@functools.cache
def _transforms() -> tuple[np.ndarray, np.ndarray]:
    """p̂_k(q) q dq of the terms of the pressure [K, Q], and J₀(qr) [R, Q], for a = 1."""
    order = np.arange(_TERMS)[:, None] + 0.5
    pressure = 2**order * special.gamma(order + 1) * special.jv(order + 1, _WAVES) / _WAVES ** (order + 1)
    return pressure * _WAVES * (_WAVES[1] - _WAVES[0]), special.j0(np.outer(_RADII, _WAVES))


def contact_radius_mm(depth_mm: float, ball_radius_mm: float, gel: Layer) -> float:
    """Contact radius of a ball that has gone down by a depth.

    Raises:
      GeometryError: a depth that leaves no contact, or drowns the ball.
    """
    low, high = (share * ball_radius_mm for share in _CONTACTS)
    depths = approach_mm(low, ball_radius_mm, gel), approach_mm(high, ball_radius_mm, gel)
    if not depths[0] < depth_mm < depths[1]:
        raise GeometryError(
            f"press depth is {depth_mm:g} mm: must lie in ({depths[0]:.3f}, {depths[1]:.2f}) mm for a ball of "
            f"{2 * ball_radius_mm:g} mm on {gel.thickness_mm:g} mm of gel; measure it from first touch"
        )
    return float(optimize.brentq(lambda a: approach_mm(a, ball_radius_mm, gel) - depth_mm, low, high, xtol=1e-5))


def scale_from_presses(radius_px: np.ndarray, depth_mm: np.ndarray, *, ball_diameter_mm: float, gel: Layer) -> Scale:
    """Scale from the contact circles of presses to known depths,  s = median a_mm / a_px: a bad press does not move it.

    Args:
      radius_px: of the contact circles, [P].
      depth_mm: of the presses since first touch, [P].
      ball_diameter_mm: 2 R.
      gel: thickness and Poisson ratio.

    Raises:
      GeometryError: fewer than two presses, circles without size, or a depth that the ball cannot have.
    """
    if len(radius_px) != len(depth_mm) or len(radius_px) < 2 or not np.all(np.asarray(radius_px) > 0):
        raise GeometryError(
            f"{len(radius_px)} circles and {len(depth_mm)} depths: must be two or more of each, of radius > 0; "
            "press the ball again"
        )
    known = {depth: contact_radius_mm(depth, ball_diameter_mm / 2, gel) for depth in set(map(float, depth_mm))}
    ratio = np.array([known[float(depth)] for depth in depth_mm]) / radius_px
    middle = float(np.median(ratio))
    sigma = _MAD_TO_SIGMA * float(np.median(np.abs(ratio - middle)))
    return Scale(mm_per_px=middle, error=_OF_MEDIAN * sigma / np.sqrt(len(ratio)))


def measure_scale(
    pictures: np.ndarray, background: np.ndarray, depth_mm: np.ndarray, *, ball_diameter_mm: float, gel: Layer
) -> tuple[Scale, Circles]:
    """Scale from pictures of presses: circles and pitch by turns, until the pitch stands still.

    Args:
      pictures: uint8 [P, H, W, 3].
      background: uint8 [H, W, 3].
      depth_mm: of the presses since first touch, [P].
      ball_diameter_mm: 2 R.
      gel: thickness and Poisson ratio.

    Raises:
      GeometryError: as `scale_from_presses`, or a pitch that does not settle.
    """
    pitch = _WINDOW_MM / pictures.shape[2]
    for _ in range(_ROUNDS):
        presses = BallPresses(pictures=pictures, background=background, radius_mm=ball_diameter_mm / 2, mm_per_px=pitch)
        circles = find_circles(presses, _SCHEDULE)
        scale = scale_from_presses(circles.touches.radius_px, depth_mm, ball_diameter_mm=ball_diameter_mm, gel=gel)
        if abs(scale.mm_per_px / pitch - 1) < _SETTLED:
            return scale, circles
        pitch = scale.mm_per_px
    raise GeometryError(
        f"mm_per_px is {pitch:.4f} after {_ROUNDS} rounds and does not settle: the contact circles must agree with the "
        "press depths; check the ball's diameter and the depths, or measure the pitch by a board of pins"
    )
