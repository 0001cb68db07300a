"""Adhesion: whether it changes a contact by more than a tolerance, and the contact where it does.

The generator solves contacts without it.  It asks here for the least force at which that is within a tolerance and
flags the frames of lighter touches; roughness, which keeps most surfaces from sticking, counts.  Leaving such frames
out instead would reveal the labels, since only smooth objects would lose theirs, and would tear every ramp open.

E* = E / (1 − ν²) is the plane-strain modulus, MPa; w the work of adhesion, N/mm (1 J/m² = 1e-3 N/mm).
Sources: Johnson, Kendall & Roberts 1971; Derjaguin, Muller & Toporov 1975; Tabor 1977; Johnson & Greenwood 1997;
Persson & Tosatti 2001 (roughness); Ciavarella 2018 (any shape).
"""

import dataclasses

import numpy as np

from sensors_io.layer import Layer
from sensors_io.scenes.config import require

RANGE_MM = 3e-7
"""Range of the surface forces, 0.3 nm, an interatomic distance."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Adhesion:
    """A smooth sphere of radius R on an elastic half-space, with work of adhesion w."""

    radius_mm: float
    plane_modulus_mpa: float
    work_n_per_mm: float

    def __post_init__(self) -> None:
        require(self.radius_mm > 0, "radius_mm", self.radius_mm, "must be > 0")
        require(self.plane_modulus_mpa > 0, "plane_modulus_mpa", self.plane_modulus_mpa, "must be > 0")
        require(self.work_n_per_mm >= 0, "work_n_per_mm", self.work_n_per_mm, "must be ≥ 0")

    @property
    def tabor(self) -> float:
        """(R w² / (E*² z₀³))^{1/3}: elastic stretch at pull-off over the range of the surface forces."""
        stretch = self.radius_mm * self.work_n_per_mm**2 / self.plane_modulus_mpa**2
        return float((stretch / RANGE_MM**3) ** (1 / 3))

    def least_force_n(self, tolerance: float) -> float:
        """Force from which on adhesion widens the contact by no more than `tolerance`: where the change equals it.

            JKR  F = 6πwR s / (s − 1)²,   DMT  F = 2πwR / (s − 1),   s = (1 + tolerance)³

        Raises:
          ValueError: a tolerance not above 0.
        """
        require(tolerance > 0, "tolerance", tolerance, "must be > 0")
        unit = np.pi * self.work_n_per_mm * self.radius_mm
        excess = (1 + tolerance) ** 3 - 1
        return float(6 * unit * (1 + excess) / excess**2 if self.tabor >= 1 else 2 * unit / excess)


def plane_modulus_mpa(*bodies: Layer) -> float:
    """E* of bodies in series, taken as half-spaces: 1/E* = Σ (1 − ν²)/E."""
    return 1 / sum((1 - body.poisson**2) / body.modulus_mpa for body in bodies)


def work_left(
    work_n_per_mm: float, modulus_mpa: float, wave_numbers: np.ndarray, wave_amplitudes_mm: np.ndarray
) -> float:
    """Work of adhesion that is left of w on a rough surface, what it takes to flatten its waves paid: at least 0.

        w − Σ E* |k| a² / 8

    Args:
      work_n_per_mm: w of the smooth surface.
      modulus_mpa: E*.
      wave_numbers: k [K, 2], rad/mm.
      wave_amplitudes_mm: a [K].

    Source: Persson & Tosatti 2001, J. Chem. Phys. 115, 5597–5610.  Waves finer than those given would lessen it more.
    """
    flattening = modulus_mpa * np.hypot(*wave_numbers.T) * wave_amplitudes_mm**2 / 8
    return max(float(work_n_per_mm - flattening.sum()), 0.0)


def adhesive_ramp(
    force_n: np.ndarray, approach_mm: np.ndarray, area_mm2: np.ndarray, work_n_per_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Force and approach with adhesion, from a press without it, at equal contact areas.

        F = F₁ − F₁'(δ₁) c,   δ = δ₁ − c,   c = √(2w A'(δ₁) / F₁''(δ₁))

    Exact for a sphere, where it is JKR; what lies below the least F is not stable under a prescribed force.  The
    pressure is p(F₁) − (F₁ − F) ∂p/∂F₁, the last factor that of a flat punch of the contact's shape.

    Args:
      force_n: F₁ [K], of a ramp without adhesion.
      approach_mm: δ₁ [K], ascending.
      area_mm2: contact area [K].
      work_n_per_mm: w.

    Raises:
      ValueError: a ramp that does not stiffen or does not widen, of which the formula knows nothing.

    Source: Ciavarella 2018, J. Mech. Phys. Solids 114, 209–218.
    """
    slope = np.gradient(force_n, approach_mm)
    stiffening, widening = np.gradient(slope, approach_mm), np.gradient(area_mm2, approach_mm)
    require(bool(np.all(stiffening > 0)), "force_n", float(stiffening.min()), "must stiffen with the approach")
    require(bool(np.all(widening >= 0)), "area_mm2", float(widening.min()), "must not shrink with the approach")
    stretch = np.sqrt(2 * work_n_per_mm * widening / stiffening)
    return force_n - slope * stretch, approach_mm - stretch
