"""Tangential contact under Coulomb friction |τ| ≤ μp, given the normal pressure, in float32.

The traction τ acts on the gel while the object's surface moves by s.  With the tangential compliance C of gel and
object in series, the slip that is left, w = s − C ∗ τ, obeys

    w = 0 where |τ| < μp (stick),   τ = μp w/|w| where w ≠ 0 (slip),

the conditions of the convex quadratic ½ τᵀCτ − sᵀτ over discs of radius μp.  That the traction moves the pressure is
neglected (Goodman 1962).  Plane vectors are complex numbers x + iy, as in `traction`.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Complex, Float, Int

from sensors_io.scenes.friction import dot, onto_discs, shift_to_total
from sensors_io.scenes.traction import Compliance, shear_displacement

MAX_ITERATIONS = 100
TOLERANCE = 2e-3
_TINY = 1e-30
_STEP_RANGE = 1e4  # Barzilai–Borwein steps stay within this factor of the first step
_FORCE_ERROR = 1e-4  # of a prescribed force, relative to the friction limit
_FIRST_WAVE = 4  # harmonic of the padded window whose compliance sets the first step: a few waves in a contact
_STICK = 1 - 1e-4  # |τ| below this share of μp counts as stick: four digits of the seven of float32


@struct.dataclass
class Traction:
    """One solved tangential contact.

    `traction_mpa` acts on the gel; `displacement_mm` is C ∗ τ.  `slide_mm` is the rigid displacement that carries a
    prescribed force, beyond the target; 0 where the displacement was prescribed.  `stick_share` is the share of the
    contact area that sticks.  `residual` is the duality gap relative to the greatest work, Σ (μp|w| − Re w̄τ) / Σ μp|s|:
    the error of the friction law, in displacement relative to the target, averaged with μp as weight.
    """

    traction_mpa: Complex[Array, "N N"]
    displacement_mm: Complex[Array, "N N"]
    slide_mm: Complex[Array, ""]
    stick_share: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


@struct.dataclass
class _State:
    traction: Complex[Array, "N N"]
    slip: Complex[Array, "N N"]
    slide: Complex[Array, ""]
    step: Float[Array, ""]
    best: Complex[Array, "N N"]
    best_slip: Complex[Array, "N N"]
    best_slide: Complex[Array, ""]
    best_residual: Float[Array, ""]
    iterations: Int[Array, ""]


@dataclasses.dataclass(frozen=True)
class _Problem:
    """Constants of a solve; `total` is the prescribed Σ τ, `None` where the displacement is prescribed."""

    limit: Array
    target: Array
    compliance: Compliance
    total: Array | None

    def nearest(self, traction: Array, step: Array, slide: Array) -> tuple[Array, Array]:
        """Nearest admissible traction to `traction` + step × slide, and the slide, which a prescribed force decides."""
        if self.total is None:
            return onto_discs(traction, self.limit), slide
        shift = shift_to_total(traction, self.limit, self.total, step * slide)
        return onto_discs(traction + shift, self.limit), shift / step

    def slip(self, traction: Array) -> Array:
        """w without the slide."""
        return self.target - shear_displacement(traction, self.compliance)

    def residual(self, traction: Array, slip: Array, slide: Array) -> Array:
        """Duality gap over the greatest work, infinite where rounding left no number."""
        left = slip + slide
        gap = jnp.sum(self.limit * jnp.abs(left) - dot(left, traction))
        most = jnp.sum(self.limit * jnp.abs(self.target + slide))
        relative = jnp.maximum(gap, 0) / jnp.maximum(most, _TINY)
        return jnp.where(jnp.isfinite(relative), relative, jnp.inf)


@jax.jit
def solve(
    limit_mpa: Float[Array, "N N"],
    target_mm: Complex[Array, "N N"],
    compliance: Compliance,
    start_mpa: Complex[Array, "N N"] | None = None,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
) -> Traction:
    """Move the surface of the object by a prescribed field.

        τ ← P(τ + αw),   w = s − C ∗ τ,   P(τ) = τ min(1, μp/|τ|)

    with α alternating between the two Barzilai–Borwein lengths; one convolution a step.  Stops when the residual is
    below the tolerance, or at the cap with `converged` false and the best iterate seen.  Never NaN for finite input.

    Args:
      limit_mpa: μp, friction times pressure [N, N], ≥ 0.
      target_mm: s [N, N], of `traction.rigid_field`, less the lateral displacement by pressure where that counts.
      compliance: of gel and object in series; M − N is the padding.
      start_mpa: first guess, such as the traction of the frame before; `None` for one along the target.
      tolerance: stop criterion.
      max_iterations: cap.

    Source: Birgin, Martínez & Raydan 2000 (spectral projected gradients), without line search.
    """
    problem = _Problem(limit_mpa, target_mm, compliance, None)
    start = _along(problem) if start_mpa is None else start_mpa
    return _minimise(problem, start, tolerance, max_iterations)


@jax.jit
def solve_force(
    limit_mpa: Float[Array, "N N"],
    force_n: Float[Array, "2"],
    target_mm: Complex[Array, "N N"],
    compliance: Compliance,
    spacing_mm: float,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
) -> Traction:
    """Move the object until it carries a prescribed force: `solve` with Σ τ dA = Q and the slide found.

    P becomes the nearest traction in the discs that carries Q: a shifted one, projected.
    A force past the friction limit cannot be carried: the traction is then full slip along it, `converged` false.

    Args:
      limit_mpa: μp [N, N].
      force_n: Q, along x and y.
      target_mm: what is prescribed besides the slide, such as the field of a twist; zeros for none.
      compliance: of gel and object in series.
      spacing_mm: pixel size.
      tolerance: stop criterion.
      max_iterations: cap.
    """
    total = jax.lax.complex(force_n[0], force_n[1]) / spacing_mm**2
    most = jnp.sum(limit_mpa)
    carried = total * jnp.minimum(1, most / jnp.maximum(jnp.abs(total), _TINY))
    problem = _Problem(limit_mpa, target_mm, compliance, carried)
    solved = _minimise(problem, limit_mpa * (carried / jnp.maximum(most, _TINY)), tolerance, max_iterations)
    missed = jnp.abs(total - jnp.sum(solved.traction_mpa))
    return dataclasses.replace(solved, converged=solved.converged & (missed <= _FORCE_ERROR * most))


def _minimise(problem: _Problem, start: Array, tolerance: float, max_iterations: int) -> Traction:
    even = problem.compliance.even
    first_step = 1 / even[0, _FIRST_WAVE]
    state = jax.lax.while_loop(
        lambda s: (s.best_residual >= tolerance) & (s.iterations < max_iterations),
        lambda s: _iterate(problem, s, first_step),
        _begin(problem, start, first_step),
    )
    contact = problem.limit > 0
    sticks = contact & (jnp.abs(state.best) < _STICK * problem.limit)
    return Traction(
        traction_mpa=state.best,
        displacement_mm=problem.target - state.best_slip,
        slide_mm=state.best_slide,
        stick_share=jnp.sum(sticks) / jnp.maximum(jnp.sum(contact), 1),
        residual=state.best_residual,
        iterations=state.iterations,
        converged=state.best_residual < tolerance,
    )


def _begin(problem: _Problem, start: Array, step: Array) -> _State:
    traction, slide = problem.nearest(start, step, jnp.zeros((), start.dtype))
    slip = problem.slip(traction)
    residual = problem.residual(traction, slip, slide)
    return _State(
        traction=traction,
        slip=slip,
        slide=slide,
        step=step,
        best=traction,
        best_slip=slip,
        best_slide=slide,
        best_residual=residual,
        iterations=jnp.zeros((), jnp.int32),
    )


def _iterate(problem: _Problem, state: _State, first_step: Array) -> _State:
    moved, slide = problem.nearest(state.traction + state.step * state.slip, state.step, state.slide)
    slip = problem.slip(moved)
    residual = problem.residual(moved, slip, slide)
    inside = problem.limit > 0
    fall = jnp.where(inside, state.slip + state.slide - slip - slide, 0)
    better = residual < state.best_residual
    return _State(
        traction=moved,
        slip=slip,
        slide=slide,
        step=_next_step(moved - state.traction, fall, state.iterations, first_step),
        best=jnp.where(better, moved, state.best),
        best_slip=jnp.where(better, slip, state.best_slip),
        best_slide=jnp.where(better, slide, state.best_slide),
        best_residual=jnp.minimum(residual, state.best_residual),
        iterations=state.iterations + 1,
    )


def _next_step(s: Array, y: Array, iteration: Array, first_step: Array) -> Array:
    """Alternating Barzilai–Borwein step, safeguarded against overflow and against negative curvature by rounding."""
    sy = jnp.sum(dot(s, y))
    long = jnp.sum(dot(s, s)) / jnp.maximum(sy, _TINY)
    short = sy / jnp.maximum(jnp.sum(dot(y, y)), _TINY)
    step = jnp.clip(jnp.where(iteration % 2 == 0, long, short), first_step / _STEP_RANGE, first_step * _STEP_RANGE)
    return jnp.where((sy > 0) & jnp.isfinite(step), step, first_step)


def _along(problem: _Problem) -> Array:
    """Traction along the target in proportion to μp|s|, of the length that minimises the energy."""
    shape = problem.limit * problem.target
    work = jnp.sum(dot(shape, problem.target))
    stiff = jnp.sum(dot(shape, shear_displacement(shape, problem.compliance)))
    return shape * (work / jnp.maximum(stiff, _TINY))
