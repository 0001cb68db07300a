"""Methods for normal contact: the package's solver, and solvers from the literature that it is compared with.

Every method maps one scene (gap [N, N] mm, force N, gel and total compliance [M, M//2 + 1] mm/MPa, pixel size mm) to
the gel's displacement [N, N] mm and the number of padded convolutions that it took.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sensors_io.scenes import contact, spg, winkler

_TINY = 1e-30
_BLURS_MM = (0.8, 0.4, 0.2)
_STEP_RANGE = 1e4
_MOST_ITERATIONS = 200

ContactSolver = Callable[[Array, Array, Array, Array, float], tuple[Array, Array]]


class ContactMethod(NamedTuple):
    """A solver; `kind` is its group in the chart."""

    kind: str
    solve: ContactSolver


def spg_nested(tolerance: float) -> ContactSolver:
    """The package's own solver."""

    def solve(gap: Array, force: Array, gel: Array, total: Array, spacing: float) -> tuple[Array, Array]:
        found = contact.solve(gap, force, gel, total - gel, spacing, tolerance)
        return found.displacement_mm, found.convolutions

    return solve


def winkler_only(gap: Array, force: Array, gel: Array, total: Array, spacing: float) -> tuple[Array, Array]:
    """Springs alone: u = p / K_gel."""
    share = winkler.bed_compliance(gel, spacing)
    return share * _winkler(gap, force, total, spacing), jnp.int32(0)


def winkler_and_response(gap: Array, force: Array, gel: Array, total: Array, spacing: float) -> tuple[Array, Array]:
    """The pressure of the springs, applied to the true gel."""
    return _convolve(_winkler(gap, force, total, spacing), gel), jnp.int32(1)


def blur(gap: Array, force: Array, gel: Array, total: Array, spacing: float) -> tuple[Array, Array]:
    """The interpenetration of the springs, blurred by ever narrower Gaussians that leave the contact unchanged.

    Source: Si & Yuan 2022 (Taxim); their kernel sizes in pixels are lengths here.
    """
    sheet = winkler.bed_compliance(gel, spacing) * _winkler(gap, force, total, spacing)
    pressed, contact_ = sheet, sheet > 0
    for width in _BLURS_MM:
        sheet = jnp.where(contact_, pressed, _gaussian(sheet, width / spacing))
    return _gaussian(sheet, _BLURS_MM[-1] / spacing), jnp.int32(0)


def spg_plain(tolerance: float, published: bool) -> ContactSolver:
    """Projected Barzilai–Borwein steps from a bed of springs, on the finest grid only, without preconditioner.

    The `published` stop is on (Σ p|g| / Σ p + 0.1 penetration) / δ; the residual of the package's solver is stricter.

    Source: Birgin, Martínez & Raydan 2000, without line search.
    """

    def solve(gap: Array, force: Array, gel: Array, total: Array, spacing: float) -> tuple[Array, Array]:
        gap = gap - jnp.min(gap)
        load = force / spacing**2
        first = 1 / total[0, total.shape[1] // 8]
        start = _winkler(gap, force, total, spacing)
        residual, g = _misfit(start, gap, total, load, published)

        def advance(state: tuple[Array, ...]) -> tuple[Array, ...]:
            p, g, step, best, lowest, made = state
            direction = jnp.where((p > 0) | (g < 0), g, 0)
            moved = winkler.rescale(jnp.maximum(p - step * direction, 0), load)
            residual, new_g = _misfit(moved, gap, total, load, published)
            s, y = moved - p, jnp.where((p > 0) | (moved > 0), new_g - g, 0)
            step = _barzilai_borwein(s, y, made, first)
            best = jnp.where(residual < lowest, moved, best)
            return moved, new_g, step, best, jnp.minimum(residual, lowest), made + 1

        state: tuple[Array, ...] = (start, g, first, start, residual, jnp.int32(0))
        *_, best, _, made = jax.lax.while_loop(
            lambda s: (s[4] >= tolerance) & (s[5] < _MOST_ITERATIONS), advance, state
        )
        return _convolve(best, gel), made + 2

    return solve


def polonsky_keer(iterations: int) -> ContactSolver:
    """Constrained conjugate gradients, a fixed number of iterations of two convolutions each.

    Source: Polonsky & Keer 1999.
    """

    def solve(gap: Array, force: Array, gel: Array, total: Array, spacing: float) -> tuple[Array, Array]:
        load = force / spacing**2

        def advance(_: int, state: tuple[Array, ...]) -> tuple[Array, ...]:
            p, direction, norm, conjugate = state
            touching = p > 0
            count = jnp.maximum(jnp.sum(touching), 1)
            centred = lambda w: w - jnp.sum(jnp.where(touching, w, 0)) / count
            g = centred(_convolve(p, total) + gap)
            new_norm = jnp.sum(jnp.where(touching, g**2, 0))
            direction = jnp.where(touching, g + conjugate * new_norm / jnp.maximum(norm, _TINY) * direction, 0)
            response = centred(_convolve(direction, total))
            curvature = jnp.sum(jnp.where(touching, response * direction, 0))
            step = jnp.sum(jnp.where(touching, g * direction, 0)) / jnp.maximum(curvature, _TINY)
            p = jnp.where(touching, jnp.maximum(p - step * direction, 0), 0)
            overlap = (p <= 0) & (g < 0)
            p = winkler.rescale(jnp.where(overlap, -step * g, p), load)
            return p, direction, new_norm, jnp.where(jnp.any(overlap), 0.0, 1.0)

        p = jnp.full(gap.shape, load / gap.size, gap.dtype)
        p, *_ = jax.lax.fori_loop(0, iterations, advance, (p, 0 * p, jnp.float32(1), jnp.float32(0)))
        return _convolve(p, gel), jnp.int32(2 * iterations + 1)

    return solve


_TOLERANCES = ("1e-2", "1e-3", "1e-4", "1e-5")

METHODS: Mapping[str, ContactMethod] = {
    "Winkler": ContactMethod("no iteration", winkler_only),
    "blur": ContactMethod("no iteration", blur),
    "Winkler + response": ContactMethod("no iteration", winkler_and_response),
    **{f"nested {t}": ContactMethod("nested SPG", spg_nested(float(t))) for t in _TOLERANCES},
    **{f"plain {t}": ContactMethod("plain SPG", spg_plain(float(t), False)) for t in _TOLERANCES},
    "plain 1e-3 as published": ContactMethod("published stop", spg_plain(1e-3, True)),
    "PK-25": ContactMethod("Polonsky–Keer", polonsky_keer(25)),
}
"""Name → method, cheapest first within each kind."""


def _convolve(field: Array, spectrum: Array) -> Array:
    """Zero-padded convolution by two full transforms."""
    n, m = field.shape[-1], spectrum.shape[-2]
    return jnp.fft.irfft2(jnp.fft.rfft2(field, s=(m, m)) * spectrum, s=(m, m))[:n, :n]


def _winkler(gap: Array, force: Array, total: Array, spacing: float) -> Array:
    return winkler.pressure(gap - jnp.min(gap), force / spacing**2, 1 / winkler.bed_compliance(total, spacing))


def _misfit(p: Array, gap: Array, total: Array, load: Array, published: bool) -> tuple[Array, Array]:
    """Residual and gradient."""
    u = _convolve(p, total)
    w, touching = u + gap, p > 0
    approach = jnp.sum(jnp.where(touching, w, 0)) / jnp.maximum(jnp.sum(touching), 1)
    g = w - approach
    penetration = spg.PENETRATION_WEIGHT * jnp.max(jnp.where(touching, 0, -g))
    if published:
        return (jnp.sum(p * jnp.abs(g)) / load + penetration) / jnp.maximum(jnp.abs(approach), _TINY), g
    uneven, depth = jnp.sqrt(jnp.sum(p * g**2) / load), jnp.sum(p * u) / load
    return spg.ESTIMATE * (uneven + penetration) / jnp.maximum(depth, _TINY), g


def _barzilai_borwein(s: Array, y: Array, iteration: Array, first: Array) -> Array:
    """The long and the short step length in turn."""
    sy = jnp.sum(s * y)
    long, short = jnp.sum(s * s) / jnp.maximum(sy, _TINY), sy / jnp.maximum(jnp.sum(y * y), _TINY)
    step = jnp.clip(jnp.where(iteration % 2 == 0, long, short), first / _STEP_RANGE, first * _STEP_RANGE)
    return jnp.where(sy > 0, step, first)


def _gaussian(field: Array, width_px: float) -> Array:
    """Periodic blur by a Gaussian of standard deviation `width_px`."""
    n = field.shape[0]
    q_y, q_x = 2 * jnp.pi * jnp.fft.fftfreq(n)[:, None], 2 * jnp.pi * jnp.fft.rfftfreq(n)[None]
    return jnp.fft.irfft2(jnp.fft.rfft2(field) * jnp.exp(-(width_px**2) * (q_x**2 + q_y**2) / 2), s=field.shape)
