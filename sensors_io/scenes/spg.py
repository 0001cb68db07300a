"""Spectral projected gradients for a pressure p ≥ 0 of given sum on one grid, preconditioned by the inverse compliance.

The convex problem is  min ½ pᵀGp + pᵀg₀  subject to  p ≥ 0,  Σ p = total.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from sensors_io.scenes.winkler import rescale

STEP = 0.6
"""Longest step in units of the preconditioner.  On the contact, the compressed inverse times the compressed compliance
has eigenvalues ≥ 1, few above 3; a longer step amplifies these."""

SHORTEST_STEP = 0.1
ESTIMATE = 2.25
"""Relative L₂ error of the displacement per unit of the raw violation, at most: over 1,000 rough, curved and patterned
scenes the error is 0.6 of the residual in the median, 1.1 in nineteen of twenty, never twice it."""

PENETRATION_WEIGHT = 0.1
"""Weight of the worst penetration outside the contact against the mean unevenness inside."""

_TINY = 1e-30


@struct.dataclass
class Problem:
    """One contact on one grid.

    Args:
      gap: g₀, least value 0, mm.
      total: Σ p, MPa.
      compliance: G of both bodies, spectrum on the padded grid, mm/MPa.
      inverse: the preconditioner's spectrum on the grid itself, MPa/mm.
    """

    gap: Float[Array, "N N"]
    total: Float[Array, ""]
    compliance: Float[Array, "M K"]
    inverse: Float[Array, "N k"]


@struct.dataclass
class State:
    """Iterate, its gradient w − δ, its approach δ and residual; the best of these seen; iterations made."""

    p: Float[Array, "N N"]
    gradient: Float[Array, "N N"]
    step: Float[Array, ""]
    best: Float[Array, "N N"]
    best_approach: Float[Array, ""]
    best_residual: Float[Array, ""]
    iterations: Int[Array, ""]


def convolve(field: Float[Array, "... N N"], spectrum: Array) -> Float[Array, "... N N"]:
    """Zero-padded convolution of a field with a kernel given by its `rfft2` half plane [M, M//2 + 1].

    Rows that are known to be zero, or not wanted, are never transformed.
    """
    n, m = field.shape[-1], spectrum.shape[-2]
    forward = jnp.fft.fft(jnp.fft.rfft(field, n=m, axis=-1), n=m, axis=-2)
    back = jnp.fft.ifft(forward * spectrum, axis=-2)[..., :n, :]
    return jnp.fft.irfft(back, n=m, axis=-1)[..., :n]


def inverse_compliance(compliance: Float[Array, "M K"], points: int) -> Float[Array, "N k"]:
    """Approximate inverse of the compliance on the unpadded grid, √(D(q_x)² + D(q_y)²) with D = 1/G.

    G is replaced by its greatest value at or above q, so that D grows with q also where a nearly incompressible layer
    does not yield (G → 0 as q → 0).  Exact for G ∝ 1/q, what every layer tends to for qh ≫ 1.

    Args:
      compliance: spectrum on the padded grid, mm/MPa.
      points: N, even.

    Returns:
      `rfft2` half plane [N, N//2 + 1], MPa/mm.
    """
    axis = jax.lax.cummax(compliance[0], reverse=True)
    k = jnp.arange(points // 2 + 1) * (compliance.shape[0] / points)
    below = jnp.clip(k.astype(jnp.int32), 0, axis.shape[0] - 2)
    share = k - below
    stiffness = 1 / jnp.maximum(axis[below] * (1 - share) + axis[below + 1] * share, _TINY)
    rows = jnp.concatenate([stiffness, stiffness[1 : (points + 1) // 2][::-1]])
    return jnp.hypot(rows[:, None], stiffness[None])


def misfit(p: Array, problem: Problem) -> tuple[Array, Array, Array]:
    """Gradient g = w − δ, approach δ, and the estimated relative error of the displacement.

        residual = 2.25 · (√(Σ p g² / Σ p) + 0.1 max over p = 0 of −g) / (Σ p u / Σ p),   w = u + g₀,  u = G ∗ p

    One convolution.
    """
    u = convolve(p, problem.compliance)
    w, contact = u + problem.gap, p > 0
    approach = jnp.sum(jnp.where(contact, w, 0)) / jnp.maximum(jnp.sum(contact), 1)
    g = w - approach
    uneven = jnp.sqrt(jnp.sum(p * g**2) / problem.total)
    penetration = jnp.max(jnp.where(contact, 0, -g))
    depth = jnp.sum(p * u) / problem.total
    residual = ESTIMATE * (uneven + PENETRATION_WEIGHT * penetration) / jnp.maximum(depth, _TINY)
    return g, approach, jnp.where(jnp.isfinite(residual), residual, jnp.inf)


def press_detail(p: Array, detail: Array, problem: Problem) -> Array:
    """Pressure that follows a gap with a detail that was not there before, without a padded convolution.

        p ← P(p − D d),   d = detail minus its mean, on p > 0

    Args:
      p: pressure that solves the problem without the detail [N, N].
      detail: what came to the gap [N, N], mm.
      problem: the one with the detail.
    """
    contact = p > 0
    mean = jnp.sum(jnp.where(contact, detail, 0)) / jnp.maximum(jnp.sum(contact), 1)
    response = precondition(jnp.where(contact, detail - mean, 0), problem)
    return _project(jnp.where(contact, p - response, 0), p, problem.total)


def precondition(field: Array, problem: Problem) -> Array:
    """D ∗ field, periodic on the unpadded grid."""
    return jnp.fft.irfft2(jnp.fft.rfft2(field) * problem.inverse, s=field.shape)


def minimise(problem: Problem, start: Array, tolerance: Array | float, max_iterations: Array | int) -> State:
    """Iterate from `start` until the residual is below the tolerance, or the cap is reached.

        p ← P(p − τ d),   d = D g on p > 0,   d = D̄ g where p = 0 and g < 0

    P clips at 0 and rescales; D acts on the contact alone (two-metric projection); τ is the Barzilai–Borwein length in
    the metric of D, at most `STEP`.  One padded and one unpadded convolution a step.

    Source: Birgin, Martínez & Raydan 2000; Bertsekas 1982 (two-metric projection).  Departure: no line search; the best
    iterate is kept instead.
    """
    g, approach, residual = misfit(start, problem)
    state = State(
        p=start,
        gradient=g,
        step=jnp.asarray(STEP, start.dtype),
        best=start,
        best_approach=approach,
        best_residual=residual,
        iterations=jnp.zeros((), jnp.int32),
    )
    unfinished = lambda s: (s.best_residual >= tolerance) & (s.iterations < max_iterations)
    return jax.lax.while_loop(unfinished, lambda s: _advance(s, problem), state)


def _advance(state: State, problem: Problem) -> State:
    p, g = state.p, state.gradient
    contact = p > 0
    inside = precondition(jnp.where(contact, g, 0), problem)
    single = problem.inverse[0, problem.inverse.shape[1] // 2]  # stiffness of a pixel pressed alone
    direction = jnp.where(contact, inside, jnp.where(g < 0, single * g, 0))
    moved = _project(p - state.step * direction, p, problem.total)
    new_g, approach, residual = misfit(moved, problem)
    better = residual < state.best_residual
    return State(
        p=moved,
        gradient=new_g,
        step=_next_step(state.step, moved - p, g, new_g),
        best=jnp.where(better, moved, state.best),
        best_approach=jnp.where(better, approach, state.best_approach),
        best_residual=jnp.minimum(residual, state.best_residual),
        iterations=state.iterations + 1,
    )


def _project(p: Array, before: Array, total: Array) -> Array:
    """Clip at 0 and restore the force; where nothing is left in contact, the pressure from before."""
    clipped = jnp.maximum(p, 0)
    return rescale(jnp.where(jnp.sum(clipped) > 0, clipped, before), total)


def _next_step(step: Array, s: Array, g: Array, new_g: Array) -> Array:
    """Barzilai–Borwein length sᵀD⁻¹s / sᵀy with D⁻¹s ≈ −τ g, kept within its bounds."""
    descent, curvature = -jnp.sum(s * g), jnp.sum(s * (new_g - g))
    length = jnp.clip(step * descent / jnp.maximum(curvature, _TINY), SHORTEST_STEP, STEP)
    return jnp.where((descent > 0) & (curvature > 0), length, STEP)
