"""Frictionless normal contact at a prescribed force, by spectral projected gradients in float32.

The unknown is the pressure p ≥ 0 on an [N, N] grid with Σ p dA = F.  With the compliance G of layer and object in
series and the gap g₀ of the undeformed bodies, the complementarity conditions are

    w = G ∗ p + g₀,   w = δ where p > 0,   w ≥ δ where p = 0,

those of the convex quadratic ½ pᵀGp + pᵀg₀.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

BISECTIONS = 26
MAX_ITERATIONS = 200
TOLERANCE = 1e-3
_TINY = 1e-30
_STEP_RANGE = 1e4  # Barzilai–Borwein steps stay within this factor of the first step


@struct.dataclass
class Contact:
    """One solved contact.

    `displacement_mm` is that of the gel surface, into the gel; `approach_mm` is δ, by how much the object came closer.
    `residual` is the relative violation of complementarity; `converged` says that it is below the tolerance.
    """

    pressure_mpa: Float[Array, "N N"]
    displacement_mm: Float[Array, "N N"]
    approach_mm: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


@struct.dataclass
class _State:
    p: Float[Array, "N N"]
    gradient: Float[Array, "N N"]
    step: Float[Array, ""]
    best: Float[Array, "N N"]
    best_approach: Float[Array, ""]
    best_residual: Float[Array, ""]
    iterations: Int[Array, ""]


def convolve(field: Float[Array, "N N"], spectrum: Array) -> Float[Array, "N N"]:
    """Zero-padded convolution of a field with a kernel given by its `rfft2` half plane [M, M//2 + 1]."""
    n, m = field.shape[-1], spectrum.shape[-2]
    return jnp.fft.irfft2(jnp.fft.rfft2(field, s=(m, m)) * spectrum, s=(m, m))[..., :n, :n]


def winkler_pressure(gap: Float[Array, "N N"], total: Float[Array, ""], stiffness: Float[Array, ""]) -> Array:
    """Pressure of a bed of springs, p = K max(δ − g₀, 0), with δ bisected (geometric midpoints) so that Σ p = total."""
    target = total / stiffness
    high = jnp.max(gap) + target / gap.size
    low = jnp.minimum(target / gap.size, high) * 1e-3 + 1e-9

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = jnp.sqrt(low * high)
        short = jnp.sum(jnp.maximum(middle - gap, 0)) < target
        return jnp.where(short, middle, low), jnp.where(short, high, middle)

    low, high = jax.lax.fori_loop(0, BISECTIONS, halve, (low, high))
    rise = jnp.maximum(high - gap, 0)
    rise = jnp.where(jnp.sum(rise) > 0, rise, (gap <= jnp.min(gap)).astype(gap.dtype))  # never an empty contact
    return _rescale(rise, total)


@jax.jit
def solve(
    gap_mm: Float[Array, "N N"],
    force_n: Float[Array, ""],
    gel: Float[Array, "M K"],
    body: Float[Array, "M K"],
    spacing_mm: float,
    tolerance: float = TOLERANCE,
    max_iterations: int = MAX_ITERATIONS,
) -> Contact:
    """Press a body of shape `gap_mm` into the gel by `force_n`.

        p ← P(p − τ d),   d = g where p > 0 or g < 0,   g = w − mean over p > 0 of w,

    P clips at 0 and rescales to the force; τ alternates the two Barzilai–Borwein lengths.  One convolution a step.
    Stops on  (Σ p|g| / Σ p + 0.1 max over p = 0 of −g) / δ < tolerance,  or at the cap with `converged` false and the
    best iterate seen.  No output is ever NaN for finite input; map with `jax.lax.map`, which stops per scene.

    Args:
      gap_mm: distance of the undeformed bodies [N, N], any offset.
      force_n: prescribed force, > 0.
      gel: compliance spectrum of the gel [M, M//2 + 1], mm/MPa; M − N is the padding.
      body: that of the object in series, added to the gel's; zeros for a rigid one.
      spacing_mm: pixel size.
      tolerance: stop criterion.
      max_iterations: cap.

    Source: Birgin, Martínez & Raydan 2000 (spectral projected gradients), without line search; the start is a Winkler
    bed of stiffness 1/G(q ≈ 0.2 rad/mm).
    """
    gap = gap_mm - jnp.min(gap_mm)
    total = force_n / spacing_mm**2
    compliance = gel + body
    first_step = 1 / compliance[0, compliance.shape[1] // 8]
    start = winkler_pressure(gap, total, 1 / _bed_compliance(compliance, spacing_mm))
    begin = _begin(start, gap, compliance, first_step)
    state = jax.lax.while_loop(
        lambda s: (s.best_residual >= tolerance) & (s.iterations < max_iterations),
        lambda s: _iterate(s, gap, total, compliance, first_step),
        begin,
    )
    return Contact(
        pressure_mpa=state.best,
        displacement_mm=convolve(state.best, gel),
        approach_mm=state.best_approach,
        residual=state.best_residual,
        iterations=state.iterations,
        converged=state.best_residual < tolerance,
    )


def _bed_compliance(compliance: Array, spacing_mm: float) -> Array:
    """G at the wave number next to 0.2 rad/mm, the scale of a finger-sized contact."""
    points = compliance.shape[0]
    index = jnp.round(0.2 * points * spacing_mm / (2 * jnp.pi)).astype(jnp.int32)
    return compliance[0, jnp.clip(index, 1, compliance.shape[1] - 1)]


def _rescale(p: Array, total: Array) -> Array:
    return p * (total / jnp.maximum(jnp.sum(p), _TINY))


def _gradient(p: Array, gap: Array, compliance: Array) -> tuple[Array, Array, Array]:
    """Gap minus its contact mean, that mean (the approach δ), and the relative violation of complementarity."""
    w = convolve(p, compliance) + gap
    contact = p > 0
    approach = jnp.sum(jnp.where(contact, w, 0)) / jnp.maximum(jnp.sum(contact), 1)
    g = w - approach
    uneven = jnp.sum(p * jnp.abs(g)) / jnp.maximum(jnp.sum(p), _TINY)
    penetration = jnp.max(jnp.where(contact, 0, -g))
    residual = (uneven + 0.1 * penetration) / jnp.maximum(jnp.abs(approach), _TINY)
    return g, approach, jnp.where(jnp.isfinite(residual), residual, jnp.inf)


def _begin(p: Array, gap: Array, compliance: Array, step: Array) -> _State:
    g, approach, residual = _gradient(p, gap, compliance)
    return _State(
        p=p,
        gradient=g,
        step=step,
        best=p,
        best_approach=approach,
        best_residual=residual,
        iterations=jnp.zeros((), jnp.int32),
    )


def _iterate(state: _State, gap: Array, total: Array, compliance: Array, first_step: Array) -> _State:
    p, g = state.p, state.gradient
    direction = jnp.where((p > 0) | (g < 0), g, 0)
    moved = _rescale(jnp.maximum(p - state.step * direction, 0), total)
    new_g, approach, residual = _gradient(moved, gap, compliance)
    step = _next_step(moved - p, jnp.where((p > 0) | (moved > 0), new_g - g, 0), state.iterations, first_step)
    better = residual < state.best_residual
    return _State(
        p=moved,
        gradient=new_g,
        step=step,
        best=jnp.where(better, moved, state.best),
        best_approach=jnp.where(better, approach, state.best_approach),
        best_residual=jnp.minimum(residual, state.best_residual),
        iterations=state.iterations + 1,
    )


def _next_step(s: Array, y: Array, iteration: Array, first_step: Array) -> Array:
    """Alternating Barzilai–Borwein step, safeguarded against overflow and against negative curvature by rounding."""
    sy = jnp.sum(s * y)
    long = jnp.sum(s * s) / jnp.maximum(sy, _TINY)
    short = sy / jnp.maximum(jnp.sum(y * y), _TINY)
    step = jnp.where(iteration % 2 == 0, long, short)
    step = jnp.clip(step, first_step / _STEP_RANGE, first_step * _STEP_RANGE)
    return jnp.where((sy > 0) & jnp.isfinite(step), step, first_step)
