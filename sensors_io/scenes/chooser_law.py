"""The settings that a contact may be solved under, and the law of their errors.

With φ the features of a `Survey`, n the side of the grid, x = ln(n/48), t the tolerance, a the contact's radius, h the
gel's thickness, and clearance the side of the padded grid less 2a,

    ê² = ê_grid² + ê_stop² + ê_wrap²
    ln ê_grid = α·φ + (β·φ) x + (δ·φ) x²
    ln ê_stop = γ·φ + c₁ x + c₂ ln t
    ln ê_wrap = ε·(1, clearance/h, a/h, ln s, x)

is the law of the greater of the relative L₂ errors of displacement and slope, s the gap's slope under the contact over
the displacement's.  Its coefficients were fitted to random scenes; its margins make a promise of it.
"""

import dataclasses
import itertools
import math

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

GRIDS = (24, 32, 48, 64, 96, 128, 192)
EASY_ABOVE = 0.05
"""Error asked for above which the margin falls."""

PADDINGS = (1.5, 2.0)
"""Sides of the padded grid over those of the window, the same for every gel, so that all share their programs."""

TOLERANCES = (3e-2, 1e-2, 3e-3)

SLACK = 1.5
"""A promise is kept by an error up to this multiple of the one asked for."""

_MIDDLE_GRID = 48  # where x is 0, so that the law's coefficients are independent of each other


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """Settings of a solve: sides of the grid and of the padded grid, tolerance of the solver."""

    grid: int
    padded: int
    tolerance: float

    @property
    def cost(self) -> float:
        """Time of going on from the look, in arbitrary units; only its order matters, the look's own is 0."""
        if self == LOOK:
            return 0.0
        size = _OVERHEAD_POINTS + self.grid**2 + _PADDING_WEIGHT * self.padded**2
        return size * (_START_DIGITS - math.log10(self.tolerance))


LOOK = Setting(grid=24, padded=36, tolerance=3e-2)
"""The setting under which every scene is solved first."""

_OVERHEAD_POINTS = 800.0  # pixels whose work equals what every iteration takes on any grid
_PADDING_WEIGHT = 0.3  # work a point of the padded grid over that of the grid itself
_START_DIGITS = 1.5  # iterations that any tolerance takes, in those that a further digit takes


def make_menu(grids: tuple[int, ...], tolerances: tuple[float, ...] = TOLERANCES) -> tuple[Setting, ...]:
    """All settings on these grids, cheapest first."""
    settings = (
        Setting(grid=n, padded=round(n * ratio), tolerance=t)
        for n, ratio, t in itertools.product(grids, PADDINGS, tolerances)
    )
    return tuple(sorted(settings, key=lambda s: s.cost))


MENU = make_menu(GRIDS)


@struct.dataclass
class Survey:
    """Input of the law for a scene: features φ, `FEATURES` by name, and the terms of ê_wrap.

    `radius_mm` is a, `slope_share` ln s.
    """

    features: Float[Array, "... K"]
    radius_mm: Float[Array, "..."]
    slope_share: Float[Array, "..."]
    window_mm: Float[Array, "..."]
    thickness_mm: Float[Array, "..."]


@struct.dataclass
class Law:
    """Coefficients of ê as the module says them, and factors on ê.

    `margin` × ê is what is promised; the law scatters less on the coarse grids that an error above 5 % takes, so that
    the margin falls there by the power `ease` of the error.  Where no setting promises enough, the scene is still not
    given up as long as `doubt` × ê is within the promise on the best one, `doubt` < `margin`.
    """

    grid: Float[Array | np.ndarray, "K"]
    rate: Float[Array | np.ndarray, "K"]
    bend: Float[Array | np.ndarray, "K"]
    stop: Float[Array | np.ndarray, "K+2"]
    wrap: Float[Array | np.ndarray, "5"]
    margin: Float[Array | np.ndarray, ""]
    ease: Float[Array | np.ndarray, ""]
    doubt: Float[Array | np.ndarray, ""]


LAW = Law(
    grid=np.array(
        [
            -0.838,
            -0.53,
            0.938,
            0.424,
            0.073,
            0.061,
            -0.183,
            0.072,
            -0.099,
            -0.039,
            0.013,
            0.086,
            0.084,
            0.022,
            -0.664,
            -0.032,
            -0.357,
            0.326,
        ]
    ),
    rate=np.array(
        [
            -1.297,
            -0.703,
            0.699,
            0.015,
            -0.121,
            -0.384,
            -0.097,
            0.076,
            0.212,
            -0.033,
            -0.018,
            0.169,
            0.012,
            -0.009,
            -0.238,
            -0.188,
            -0.069,
            0.102,
        ]
    ),
    bend=np.array(
        [
            -0.794,
            0.133,
            -0.112,
            -0.363,
            -0.343,
            0.505,
            -0.007,
            0.162,
            -0.226,
            -0.008,
            -0.013,
            -0.101,
            0.049,
            0.01,
            0.24,
            0.195,
            -0.02,
            -0.019,
        ]
    ),
    stop=np.array(
        [
            -1.13,
            -0.064,
            -0.27,
            0.273,
            0.348,
            -0.53,
            0.43,
            0.673,
            -0.081,
            -0.018,
            -0.354,
            -0.267,
            0.014,
            -0.034,
            -0.75,
            -0.082,
            -0.122,
            0.089,
            0.046,
            0.713,
        ]
    ),
    wrap=np.array(
        [
            -0.751,
            -0.9,
            -0.148,
            -0.613,
            0.326,
        ]
    ),
    margin=np.array(1.575),
    ease=np.array(0.14),
    doubt=np.array(1.261),
)
"""Fitted to 384 scenes on four gels, margins chosen on these and 192 others: `sensors_io.scenes.chooser_fit`."""


def log_error(seen: Survey, law: Law, menu: tuple[Setting, ...]) -> Float[Array, "... T"]:
    """ln ê of every setting."""
    n = np.array([s.grid for s in menu])
    ratio = np.array([s.padded for s in menu]) / n
    x, tolerance = np.log(n / _MIDDLE_GRID), np.array([s.tolerance for s in menu])
    phi, h = seen.features, seen.thickness_mm[..., None]
    a = seen.radius_mm[..., None]
    grid = (phi @ law.grid)[..., None] + (phi @ law.rate)[..., None] * x + (phi @ law.bend)[..., None] * x**2
    stop = (phi @ law.stop[:-2])[..., None] + law.stop[-2] * x + law.stop[-1] * np.log(tolerance)
    clearance = seen.window_mm[..., None] * ratio - 2 * a
    far = law.wrap[0] + law.wrap[1] * clearance / h + law.wrap[2] * a / h
    wrap = far + law.wrap[3] * seen.slope_share[..., None] + law.wrap[4] * x
    return 0.5 * jnp.log(jnp.exp(2 * grid) + jnp.exp(2 * stop) + jnp.exp(2 * wrap))


def margin_at(error: float | Array, law: Law) -> Float[Array, ""]:
    """Margin · (error / 5 %)^−ease above 5 %, the margin itself below."""
    return jnp.asarray(law.margin) * jnp.maximum(error / EASY_ABOVE, 1.0) ** -law.ease


def pick(
    error: float | Array, log_errors: Float[Array, "T"], law: Law
) -> tuple[Int[Array, ""], Float[Array, ""], Bool[Array, ""]]:
    """Index of the first setting that promises enough, else of the least error; its promise; whether it may be met."""
    expected = jnp.exp(log_errors)
    margin = margin_at(error, law)
    enough = margin * expected <= SLACK * error
    index = jnp.where(jnp.any(enough), jnp.argmax(enough), jnp.argmin(expected))
    return index, margin * expected[index], jnp.asarray(law.doubt) * jnp.min(expected) <= SLACK * error
