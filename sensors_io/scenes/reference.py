"""Float64 reference for the contact solver: slow, on the host, by another method.  Used as an oracle."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReferenceContact:
    """Pressure [N, N] MPa, approach mm, worst relative violation of complementarity, iterations."""

    pressure_mpa: np.ndarray
    approach_mm: float
    residual: float
    iterations: int


def convolve(field: np.ndarray, spectrum: np.ndarray) -> np.ndarray:
    """Zero-padded convolution of [N, N] with the `rfft2` half plane [M, M//2 + 1] of a kernel, float64."""
    n, m = field.shape[0], spectrum.shape[0]
    return np.fft.irfft2(np.fft.rfft2(field, s=(m, m)) * spectrum, s=(m, m))[:n, :n]


def solve_reference(
    gap_mm: np.ndarray,
    force_n: float,
    compliance: np.ndarray,
    spacing_mm: float,
    tolerance: float = 1e-9,
    max_iterations: int = 5000,
) -> ReferenceContact:
    """Frictionless normal contact at a prescribed force by the constrained conjugate gradients of Polonsky & Keer 1999.

    Complementarity is measured against the approach: max |w − δ| over p > 0 and max (δ − w) over p = 0, over δ.

    Args:
      gap_mm: distance of the undeformed bodies [N, N].
      force_n: prescribed force, > 0.
      compliance: total compliance spectrum [M, M//2 + 1], mm/MPa.
      spacing_mm: pixel size.
      tolerance: worst relative violation to stop at.
      max_iterations: cap.

    Raises:
      RuntimeError: the cap was reached; a reference that has not converged must not be used.
    """
    total = force_n / spacing_mm**2
    p = np.full(gap_mm.shape, total / gap_mm.size)
    direction, previous, conjugate = np.zeros_like(p), 1.0, 0.0
    for iteration in range(max_iterations):
        w = convolve(p, compliance) + gap_mm
        contact = p > 0
        approach = float(w[contact].mean())
        g = w - approach
        scale = approach - float(gap_mm.min())
        residual = max(float(np.abs(g[contact]).max()), float(np.max(-g[~contact], initial=0.0))) / scale
        if residual < tolerance:
            return ReferenceContact(pressure_mpa=p, approach_mm=scale, residual=residual, iterations=iteration)
        norm = float(np.sum(g[contact] ** 2))
        direction = np.where(contact, g + conjugate * norm / previous * direction, 0.0)
        response = convolve(direction, compliance)
        response -= response[contact].mean()
        curvature = float(np.sum(response[contact] * direction[contact]))
        step = float(np.sum(g[contact] * direction[contact])) / max(curvature, 1e-300)
        p = np.maximum(p - step * direction, 0.0)
        overlap = (p == 0) & (g < 0)
        p[overlap] = -step * g[overlap]
        conjugate, previous = float(not overlap.any()), max(norm, 1e-300)
        p *= total / p.sum()
    raise RuntimeError(f"reference contact: residual {residual:.1e} after {max_iterations} iterations; raise the cap")
