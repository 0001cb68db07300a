"""Published contact solvers, measured where they are installed: `pip install touchr1-jax[oracles]`.

Tamaas solves a periodic half-space, ContactMechanics a periodic layer bonded to a rigid base; both by conjugate
gradients in float64.  No package depends on them.
"""

import contextlib
import importlib.util
import time
import warnings
from collections.abc import Iterator

import numpy as np

from sensors_io.layer import Layer


def installed() -> tuple[str, ...]:
    """Which of the two can be imported."""
    return tuple(name for name in ("tamaas", "ContactMechanics") if importlib.util.find_spec(name) is not None)


def half_space_spectrum(points: int, spacing_mm: float, plane_modulus_mpa: float) -> np.ndarray:
    """Periodic half-space, G = 2 / (E* q), G(0) = 0: what Tamaas solves; [N, N//2 + 1], mm/MPa."""
    q = np.hypot(
        2 * np.pi * np.fft.fftfreq(points, spacing_mm)[:, None], 2 * np.pi * np.fft.rfftfreq(points, spacing_mm)[None]
    )
    return np.divide(2, plane_modulus_mpa * q, out=np.zeros_like(q), where=q > 0)


def tamaas_pressure(
    gap_mm: np.ndarray, force_n: float, side_mm: float, gel: Layer, tolerance: float
) -> tuple[np.ndarray, float]:
    """Pressure [N, N] MPa on a periodic half-space of the gel's stuff, and the seconds that the solve took."""
    import tamaas

    tamaas.set_log_level(tamaas.LogLevel.error)
    model = tamaas.ModelFactory.createModel(tamaas.model_type.basic_2d, [side_mm, side_mm], list(gap_mm.shape))
    model.E, model.nu = gel.modulus_mpa, gel.poisson
    solver = tamaas.PolonskyKeerRey(model, gap_mm.min() - gap_mm, tolerance)
    began = time.perf_counter()
    solver.solve(force_n / side_mm**2)
    return np.array(model.traction).reshape(gap_mm.shape), time.perf_counter() - began


def contact_mechanics_pressure(
    gap_mm: np.ndarray, force_n: float, side_mm: float, gel: Layer, tolerance: float
) -> tuple[np.ndarray, float]:
    """Pressure [N, N] MPa on a periodic layer, and the seconds that the solve took.

    Args:
      tolerance: greatest penetration relative to the rms of the gap.

    Raises:
      RuntimeError: it did not converge.
    """
    n, sides = gap_mm.shape[0], (side_mm, side_mm)
    with _quietly():
        from ContactMechanics import PeriodicFFTElasticHalfSpace
        from ContactMechanics.Optimization import constrained_conjugate_gradients
        from SurfaceTopography import Topography

        base = PeriodicFFTElasticHalfSpace(
            gap_mm.shape, gel.modulus_mpa, sides, thickness=gel.thickness_mm, poisson=gel.poisson
        )
        rigid = Topography(gap_mm.min() - gap_mm, sides)
        began = time.perf_counter()
        found = constrained_conjugate_gradients(
            base, rigid, external_force=force_n, pentol=tolerance * float(np.std(gap_mm)), maxiter=5000
        )
    if not found.success:
        raise RuntimeError(f"ContactMechanics stopped at {found.nit} iterations: {found.message}; raise its cap")
    return np.asarray(found.jac) * (n / side_mm) ** 2, time.perf_counter() - began


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Its kernel overflows and repairs itself; it warns that it runs without MPI."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", ImportWarning)
        yield
