"""Which grid, padding and tolerance a contact needs to stay below an error, chosen from a look that solves nothing.

A bed of springs tells where the bodies touch.  How much of the slope of its imprint is lost on grids two and four times
coarser tells how the error falls with the grid; how far off its periodic image lies, what padding is needed.  The law

    ê² = ê_grid² + ê_stop² + ê_wrap²
    ln ê_grid = α·φ + (β·φ) ln(n/32),   ln ê_stop = γ·φ + c ln(tolerance),   ln ê_wrap = ε·(1, clearance/h, a/h)

is that of the greater of the relative L₂ errors of displacement and slope; φ are the features of `Survey`, n the side
of the grid, a the radius of the springs' contact, h the gel's thickness, clearance the padded side less 2a.  Its
coefficients were fitted to random scenes (`LAW`); its margin is such that nearly all of these keep the promise.  No
setting is a bed of springs alone: that is off by tens of per cent on every grid.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from sensors_io.scenes import contact, layer, nested, winkler
from sensors_io.scenes.config import require
from sensors_io.scenes.layer import Layer

LOOK_GRID = 48
"""Side of the grid that is looked at."""

GRIDS = (24, 32, 48, 64, 96, 128, 192)
PADDINGS = (1.5, 2.0)
"""Sides of the padded grid over those of the window, the same for every gel, so that all share their programs."""

TOLERANCES = (3e-2, 1e-2, 3e-3)

SLACK = 1.5
"""A promise is kept by an error up to this multiple of the one asked for."""

_LEAST = 1e-3  # least value of what a logarithm is taken of
_SLOPE = 0.01  # slope that no camera sees
_TINY = 1e-30

Gap = Callable[[int], Array] | Array
"""Distance of the undeformed bodies, mm: on a square grid of the window, or a function of the grid's side."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """How a contact may be solved: sides of the grid and of the padded grid, tolerance of the solver."""

    grid: int
    padded: int
    tolerance: float

    @property
    def cost(self) -> float:
        """Time of a solve in arbitrary units, fitted to times on two cores; only its order matters."""
        size = _OVERHEAD_POINTS + self.grid**2 + _PADDING_WEIGHT * self.padded**2
        return size * (_START_DIGITS - math.log10(self.tolerance))


_OVERHEAD_POINTS = 2000.0  # pixels whose work equals what every iteration takes on any grid
_PADDING_WEIGHT = 0.45  # work a point of the padded grid over that of the grid itself
_START_DIGITS = 1.0  # iterations from first guess to a tenth, in those that a further digit takes


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
    """What the law knows of a scene: features φ, the radius of the springs' contact and the gel's thickness.

    φ = (1, ln r₂, ln r₄/r₂, ln a/h, border, ln (edge · h / area), ln slope, ln (depth/h), ln (gel's share)):
    r₂ and r₄ are the shares of the imprint's slope that grids two and four times coarser than the look's lose, `border`
    the share of the window's border that touches, edge and area those of the contact, slope that of the gap inside it,
    depth the springs' greatest compression, of which the gel has its share and the body the rest.
    """

    features: Float[Array, "K"]
    radius_mm: Float[Array, ""]
    window_mm: Float[Array, ""]
    thickness_mm: Float[Array, ""]


@struct.dataclass
class Law:
    """Coefficients of ê as the module says them, and the factor from ê to what is promised."""

    grid: Float[Array | np.ndarray, "K"]
    rate: Float[Array | np.ndarray, "K"]
    stop: Float[Array | np.ndarray, "K+1"]
    wrap: Float[Array | np.ndarray, "3"]
    margin: Float[Array | np.ndarray, ""]


LAW = Law(
    grid=np.array([-0.104, 1.612, -0.653, 0.272, 0.116, 0.050, 0.094, -0.101, -0.117]),
    rate=np.array([-2.293, -0.644, -0.460, 0.084, -0.102, -0.005, 0.268, -0.258, 0.035]),
    stop=np.array([-2.129, -0.773, -0.343, -0.015, 1.005, -0.095, -0.537, 0.288, -0.036, 0.643]),
    wrap=np.array([-1.340, -0.743, -0.041]),
    margin=np.array(1.646),
)
"""Fitted to 140 scenes on four gels, all on grids padded to 1.5 times the side."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Choice:
    """How to solve a contact, and what may be expected of it.

    `promised_error` is the law's bound of the error.  `met` says that it keeps the promise, `promised_error` ≤ 1.5
    times the error asked for; where it is false the setting is the one of least promised error, and not enough.
    """

    grid: int
    padded: int
    tolerance: float
    tier: contact.Tier
    promised_error: float
    met: bool


def choose(error: float, gap: Gap, force_n: float, gel: Layer, body: Layer | None, window_mm: float) -> Choice:
    """Choose the cheapest setting whose promised error is at most 1.5 times the error asked for.

    Args:
      error: relative L₂ error that displacement and slope may have, in (0, 1].
      gap: of the undeformed bodies, mm; an array's side must be a multiple of `LOOK_GRID`.
      force_n: prescribed force, > 0.
      gel: the layer.
      body: the object in series as a layer; `None` for a rigid one.
      window_mm: side of the square window.

    Raises:
      ValueError: an error, a force or a window out of range, a gap that does not fit the look.
    """
    require(0 < error <= 1, "error", error, "must lie in (0, 1]")
    require(force_n > 0, "force_n", force_n, "must be > 0")
    require(window_mm > 0, "window_mm", window_mm, "must be > 0")
    seen = gap_on(gap, LOOK_GRID)
    soft = look_compliance(gel, window_mm)
    series = 0 * soft if body is None else look_compliance(body, window_mm)
    index, promised, met = jax.device_get(_choose(error, seen, force_n, soft, series, window_mm, gel.thickness_mm))
    setting = MENU[index]
    return Choice(
        grid=setting.grid,
        padded=setting.padded,
        tolerance=setting.tolerance,
        tier=contact.Tier.SPG,
        promised_error=float(promised),
        met=bool(met),
    )


def solve(
    error: float, gap: Gap, force_n: float, gel: Layer, body: Layer | None, window_mm: float
) -> tuple[Choice, contact.Contact]:
    """Choose as `choose` does, and solve; an array's side must be a multiple of every grid of the menu.

    Compiles one program for every grid and padding that is ever chosen.
    """
    choice = choose(error, gap, force_n, gel, body, window_mm)
    spacing = window_mm / choice.grid
    soft = jnp.asarray(_compliance(gel, choice.padded, spacing), jnp.float32)
    series = 0 * soft if body is None else jnp.asarray(_compliance(body, choice.padded, spacing), jnp.float32)
    found = contact.solve(
        gap_on(gap, choice.grid), force_n, soft, series, spacing, choice.tolerance, thickness_mm=gel.thickness_mm
    )
    return choice, found


def pick(error: float | Array, promised: Float[Array, "T"]) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Index of the first setting that keeps the promise, and whether one does; else that of the least error."""
    keeps = promised <= SLACK * error
    met = jnp.any(keeps)
    return jnp.where(met, jnp.argmax(keeps), jnp.argmin(promised)), met


def promise(seen: Survey, law: Law = LAW, menu: tuple[Setting, ...] = MENU) -> Float[Array, "T"]:
    """Error that the law promises of every setting, margin × ê."""
    return jnp.asarray(law.margin) * jnp.exp(log_error(seen, law, menu))


def log_error(seen: Survey, law: Law, menu: tuple[Setting, ...]) -> Float[Array, "T"]:
    """ln ê of every setting."""
    n = np.array([s.grid for s in menu])
    padded = np.array([s.padded for s in menu])
    tolerance = np.array([s.tolerance for s in menu])
    phi, h = seen.features, seen.thickness_mm
    clearance = seen.window_mm * (padded / n) - 2 * seen.radius_mm
    resolution = law.grid @ phi + (law.rate @ phi) * np.log(n / 32)
    stop = law.stop[:-1] @ phi + law.stop[-1] * np.log(tolerance)
    wrap = law.wrap[0] + law.wrap[1] * clearance / h + law.wrap[2] * seen.radius_mm / h
    return 0.5 * jnp.log(jnp.exp(2 * resolution) + jnp.exp(2 * stop) + jnp.exp(2 * wrap))


def survey(
    gap_mm: Float[Array, "L L"],
    force_n: Float[Array, ""],
    gel: Float[Array, "M K"],
    body: Float[Array, "M K"],
    window_mm: float,
    thickness_mm: float,
) -> Survey:
    """Look at a scene, without a convolution.

    Args:
      gap_mm: distance of the undeformed bodies [L, L], L a multiple of 4.
      force_n: prescribed force, > 0.
      gel, body: `look_compliance` of either; zeros for a rigid body.
      window_mm, thickness_mm: sides of the window, thickness of the gel.
    """
    spacing, points = window_mm / gap_mm.shape[0], gap_mm.shape[0]
    seen = winkler.look(gap_mm, force_n, gel + body, spacing)
    p, bed = seen.pressure_mpa, winkler.bed_compliance(gel + body, spacing)
    halved, quartered = nested.refine(nested.coarsen(p, 2)), nested.refine(nested.refine(nested.coarsen(p, 4)))
    whole = jnp.maximum(_slope_norm(p), _TINY)  # 0 under a flat pad, which loses nothing
    fine, coarse = (_slope_norm(p - q) / whole for q in (halved, quartered))
    area = jnp.sum(seen.contact)
    edges = jnp.sum(jnp.diff(seen.contact, axis=0)) + jnp.sum(jnp.diff(seen.contact, axis=1))
    at_border = area - jnp.sum(seen.contact[1:-1, 1:-1])
    ln = lambda x: jnp.log(jnp.maximum(x, _LEAST))
    features = (
        jnp.ones(()),
        ln(fine),
        ln(coarse) - ln(fine),
        ln(seen.radius_mm / thickness_mm),
        at_border / (4 * points),
        ln(edges * thickness_mm / (area * spacing)),
        ln(seen.slope + _SLOPE),
        ln(bed * jnp.max(p) / thickness_mm),
        ln(winkler.bed_compliance(gel, spacing) / bed),
    )
    return Survey(
        features=jnp.stack(features),
        radius_mm=seen.radius_mm,
        window_mm=jnp.asarray(window_mm, jnp.float32),
        thickness_mm=jnp.asarray(thickness_mm, jnp.float32),
    )


def look_compliance(body: Layer, window_mm: float) -> Float[Array, "M K"]:
    """Spectrum of a layer for `survey`, on twice the window."""
    return jnp.asarray(_compliance(body, 2 * LOOK_GRID, window_mm / LOOK_GRID), jnp.float32)


def gap_on(gap: Gap, grid: int) -> Float[Array, "N N"]:
    """The gap on a grid of that side: called for, or the mean over blocks of a finer one.

    Raises:
      ValueError: an array that is not square, or whose side is no multiple of the grid's.
    """
    if callable(gap):
        return gap(grid)
    fits = gap.ndim == 2 and gap.shape[0] == gap.shape[1] and gap.shape[0] % grid == 0
    require(fits, "gap", gap.shape, f"must be square with a side that is a multiple of {grid}, or a function of it")
    return nested.coarsen(gap, gap.shape[0] // grid)


@jax.jit
def _choose(
    error: Array, gap: Array, force_n: Array, gel: Array, body: Array, window_mm: float, thickness_mm: float
) -> tuple[Array, Array, Array]:
    """Index in the menu, promised error, whether it is met."""
    promised = promise(survey(gap, force_n, gel, body, window_mm, thickness_mm))
    index, met = pick(error, promised)
    return index, promised[index], met


@functools.lru_cache(maxsize=64)
def _compliance(body: Layer, padded: int, spacing_mm: float) -> np.ndarray:
    return layer.normal_compliance(np.hypot(*layer.wave_numbers(padded, spacing_mm)), body)


def _slope_norm(field: Array) -> Array:
    """Root of the sum of squared differences between neighbours."""
    return jnp.sqrt(jnp.sum(jnp.diff(field, axis=0) ** 2) + jnp.sum(jnp.diff(field, axis=1) ** 2))
