"""Frictionless normal contact at a prescribed force, in float32.

The unknown is the pressure p ≥ 0 on an [N, N] grid with Σ p dA = F.  With the compliance G of layer and object in
series and the gap g₀ of the undeformed bodies, the complementarity conditions are

    w = G ∗ p + g₀,   w = δ where p > 0,   w ≥ δ where p = 0,

those of the convex quadratic ½ pᵀGp + pᵀg₀.  They are solved on grids 4 and 2 times coarser first, each solution being
the next one's start: a coarse iteration costs a sixteenth or a quarter of a fine one, and what is left is local.
"""

import enum
import math

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from sensors_io.scenes import nested, winkler
from sensors_io.scenes.spg import Problem, State, convolve, inverse_compliance, minimise, press_detail
from sensors_io.scenes.validity import Validity, judge

__all__ = ["MAX_ITERATIONS", "TOLERANCE", "Contact", "Known", "Tier", "convolve", "resume", "solve", "solve_winkler"]

MAX_ITERATIONS = 200
TOLERANCE = 1e-3

_COARSE_ITERATIONS = 30  # a coarse grid that needs more does not help the fine one
_COARSE_SLACK = 4.0  # a coarse solution differs from the fine one by more than this anyway


class Tier(enum.IntEnum):
    """Methods of solving a contact, cheapest first."""

    WINKLER = 1
    SPG = 2


@struct.dataclass
class Contact:
    """One solved contact.

    `displacement_mm` is that of the gel surface, into the gel; `approach_mm` is δ, by how much the object came closer.
    `residual` estimates the relative L₂ error of the displacement; `converged` says that it is below the tolerance.
    `iterations` are those on the finest grid, `coarse_iterations` those on all others; `convolutions` counts padded
    ones on the finest grid.  `strain` is the greatest displacement over the gel's thickness.  `validity` says what of
    this may be believed.
    """

    pressure_mpa: Float[Array, "N N"]
    displacement_mm: Float[Array, "N N"]
    approach_mm: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    coarse_iterations: Int[Array, ""]
    convolutions: Int[Array, ""]
    strain: Float[Array, ""]
    tier: Int[Array, ""]
    validity: Validity


@struct.dataclass
class Known:
    """A contact that was solved on some grid: gap of the undeformed bodies, any offset, and pressure."""

    gap_mm: Float[Array, "n n"]
    pressure_mpa: Float[Array, "n n"]


@jax.jit
def solve(
    gap_mm: Float[Array, "N N"],
    force_n: Float[Array, ""],
    gel: Float[Array, "M K"],
    body: Float[Array, "M K"],
    spacing_mm: float,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
    *,
    thickness_mm: float = math.inf,
) -> Contact:
    """Press a body of shape `gap_mm` into the gel by `force_n`.

    Iterates as `spg.minimise` says, from a bed of springs on the coarsest grid to the finest.  For finite input no
    output is NaN.  Map with `jax.lax.map`, which stops per scene.

    Args:
      gap_mm: distance of the undeformed bodies [N, N], N even, any offset.
      force_n: prescribed force, > 0.
      gel: compliance spectrum of the gel [M, M//2 + 1], mm/MPa; M − N is the padding.
      body: that of the object in series, added to the gel's; zeros for a rigid one.
      spacing_mm: pixel size.
      tolerance: relative error of the displacement to stop at; float32 carries down to about 2e-5.
      max_iterations: cap on the finest grid; on reaching it `converged` is false and the best iterate is returned.
      thickness_mm: of the gel, to judge its strain by; infinite for a half-space, which has none by this measure.

    Raises:
      ValueError: a gap that is not square and even, or a spectrum that does not fit it.
    """
    problem = _pose(gap_mm, force_n, gel, body, spacing_mm)
    start, coarse_iterations = _approach_from_coarse(problem, spacing_mm, tolerance, max_iterations)
    found = minimise(problem, start, tolerance, max_iterations)
    return _contact(found, gel, tolerance, thickness_mm, coarse_iterations, Tier.SPG)


@jax.jit
def resume(
    known: Known,
    gap_mm: Float[Array, "N N"],
    force_n: Float[Array, ""],
    gel: Float[Array, "M K"],
    body: Float[Array, "M K"],
    spacing_mm: float,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
    *,
    thickness_mm: float = math.inf,
) -> Contact:
    """Solve on, from a contact that was solved on a coarser grid of the same window: what that took is not lost.

    Arguments and result as for `solve`; grids coarser than the known one are left out.  `known` may be of another
    padding, and its side need not divide that of the gap.

    Raises:
      ValueError: as `solve`; a known contact on a finer grid.
    """
    finest = _pose(gap_mm, force_n, gel, body, spacing_mm)
    points, side = gap_mm.shape[0], known.gap_mm.shape[0]
    if side > points:
        raise ValueError(f"known is on {side}²: must be no finer than gap_mm on {points}²; resume on a finer grid")
    factors = tuple(f for f in (*nested.factors(points, finest.compliance.shape[0]), 1) if points // f >= side)
    coarsest = _coarser(finest, factors[0])
    before, p = (nested.resample(field, points // factors[0]) for field in (known.gap_mm, known.pressure_mpa))
    start = press_detail(winkler.rescale(p, coarsest.total), coarsest.gap - before, coarsest)
    start, coarse_iterations = _climb(finest, start, factors, tolerance, max_iterations)
    found = minimise(finest, start, tolerance, max_iterations)
    return _contact(found, gel, tolerance, thickness_mm, coarse_iterations, Tier.SPG)


@jax.jit
def solve_winkler(
    gap_mm: Float[Array, "N N"],
    force_n: Float[Array, ""],
    gel: Float[Array, "M K"],
    body: Float[Array, "M K"],
    spacing_mm: float,
    tolerance: float = TOLERANCE,
    *,
    thickness_mm: float = math.inf,
) -> Contact:
    """The pressure of a bed of springs, and the gel's true response to it: arguments as for `solve`.

    Two convolutions, one of them for an honest residual.
    """
    problem = _pose(gap_mm, force_n, gel, body, spacing_mm)
    bed = winkler.bed_compliance(problem.compliance, spacing_mm)
    found = minimise(problem, winkler.pressure(problem.gap, problem.total, 1 / bed), tolerance, 0)
    return _contact(found, gel, tolerance, thickness_mm, jnp.int32(0), Tier.WINKLER)


def _pose(gap_mm: Array, force_n: Array, gel: Array, body: Array, spacing_mm: float) -> Problem:
    """The problem on the finest grid."""
    _check(gap_mm, gel, body)
    gap = gap_mm - jnp.min(gap_mm)
    return _problem(gap, jnp.asarray(force_n / spacing_mm**2, gap.dtype), gel + body)


def _approach_from_coarse(
    finest: Problem, spacing_mm: float, tolerance: float, max_iterations: int
) -> tuple[Array, Array]:
    """Pressure on the finest grid interpolated from the solution on coarser ones, and the iterations these took."""
    factors = (*nested.factors(finest.gap.shape[0], finest.compliance.shape[0]), 1)
    coarse = _coarser(finest, factors[0])
    bed = winkler.bed_compliance(coarse.compliance, spacing_mm * factors[0])
    start = winkler.pressure(coarse.gap, coarse.total, 1 / bed)
    return _climb(finest, start, factors, tolerance, max_iterations)


def _climb(
    finest: Problem, start: Array, factors: tuple[int, ...], tolerance: float, max_iterations: int
) -> tuple[Array, Array]:
    """Solve on each grid but the last of `factors`, from `start` on the first; pressure on the last, and iterations."""
    coarse, p, iterations = _coarser(finest, factors[0]), start, jnp.int32(0)
    cap = jnp.minimum(max_iterations, _COARSE_ITERATIONS)
    for factor in factors[1:]:
        found = minimise(coarse, p, _COARSE_SLACK * tolerance, cap)
        fine = _coarser(finest, factor)
        p = press_detail(nested.refine(found.best), fine.gap - nested.refine(coarse.gap), fine)
        coarse, iterations = fine, iterations + found.iterations
    return p, iterations


def _coarser(finest: Problem, factor: int) -> Problem:
    """The problem on a grid coarser by `factor`."""
    if factor == 1:
        return finest
    gap, compliance = nested.coarsen(finest.gap, factor), nested.truncate(finest.compliance, factor)
    return _problem(gap, finest.total / factor**2, compliance)


def _problem(gap: Array, total: Array, compliance: Array) -> Problem:
    return Problem(gap=gap, total=total, compliance=compliance, inverse=inverse_compliance(compliance, gap.shape[0]))


def _contact(
    found: State, gel: Array, tolerance: float, thickness_mm: float, coarse_iterations: Array, tier: Tier
) -> Contact:
    displacement = convolve(found.best, gel)
    strain = jnp.max(displacement) / thickness_mm
    converged = found.best_residual < tolerance
    return Contact(
        pressure_mpa=found.best,
        displacement_mm=displacement,
        approach_mm=found.best_approach,
        residual=found.best_residual,
        iterations=found.iterations,
        converged=converged,
        coarse_iterations=coarse_iterations,
        convolutions=found.iterations + 2,
        strain=strain,
        tier=jnp.int32(tier),
        validity=judge(found.best, strain, converged),
    )


def _check(gap: Array, gel: Array, body: Array) -> None:
    if gap.ndim != 2 or gap.shape[0] != gap.shape[1] or gap.shape[0] % 2:
        raise ValueError(f"gap_mm has shape {gap.shape}: must be [N, N] with even N; resample the gap")
    for name, spectrum in (("gel", gel), ("body", body)):
        m = spectrum.shape[0]
        if spectrum.shape != (m, m // 2 + 1) or m < gap.shape[0]:
            raise ValueError(
                f"{name} has shape {spectrum.shape}: must be [M, M//2 + 1] with M ≥ N = {gap.shape[0]}; "
                "compute it on the padded grid"
            )
