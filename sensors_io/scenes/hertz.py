"""Closed forms of frictionless contact with a half-space: what the contact solver must reproduce in its limit.

E* = E / (1 − ν²) is the plane-strain modulus, MPa; lengths mm, forces N.
Source: Johnson, Contact Mechanics (1985), ch. 4.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hertz:
    """A rigid sphere of radius R pressed into a half-space by force F.

    a³ = 3FR / (4E*),   δ = a² / R,   p₀ = 3F / (2πa²)
    """

    radius_mm: float
    plane_modulus_mpa: float
    force_n: float

    @property
    def contact_radius_mm(self) -> float:
        """a."""
        return float((3 * self.force_n * self.radius_mm / (4 * self.plane_modulus_mpa)) ** (1 / 3))

    @property
    def approach_mm(self) -> float:
        """δ, by how much the sphere sinks in."""
        return self.contact_radius_mm**2 / self.radius_mm

    @property
    def peak_pressure_mpa(self) -> float:
        """p₀, at the centre."""
        return 3 * self.force_n / (2 * np.pi * self.contact_radius_mm**2)

    def pressure_mpa(self, r_mm: np.ndarray) -> np.ndarray:
        """p = p₀ √(1 − r²/a²) inside the contact, 0 outside; shaped as r."""
        return self.peak_pressure_mpa * np.sqrt(np.maximum(1 - (r_mm / self.contact_radius_mm) ** 2, 0))

    def displacement_mm(self, r_mm: np.ndarray) -> np.ndarray:
        """Surface displacement, shaped as r.

        (2a² − r²) / 2R inside,  a²/(πR) [(2 − r²/a²) asin(a/r) + √(r²/a² − 1)] outside
        """
        a, radius = self.contact_radius_mm, self.radius_mm
        x = np.maximum(r_mm / a, 1.0)
        outside = a**2 / (np.pi * radius) * ((2 - x**2) * np.arcsin(1 / x) + np.sqrt(x**2 - 1))
        return np.where(r_mm < a, (2 * a**2 - r_mm**2) / (2 * radius), outside)


def half_space_spectrum(points: int, spacing_mm: float, plane_modulus_mpa: float) -> np.ndarray:
    """Spectrum of the free-space half-space kernel on a doubled grid: periodic images have no effect.

    The kernel is the displacement by unit pressure on one rectangular pixel.

    Args:
      points: N, pixels of the unpadded grid.
      spacing_mm: pixel size.
      plane_modulus_mpa: E*.

    Returns:
      float64 [2N, N + 1], mm/MPa, the half plane of `rfft2`.

    Source: Love 1929 (kernel); Liu, Wang & Liu 2000 (doubled grid).
    """
    index = np.arange(2 * points)
    x = np.where(index < points, index, index - 2 * points) * spacing_mm
    half = spacing_mm / 2
    y_hi, y_lo, x_hi, x_lo = x[:, None] + half, x[:, None] - half, x[None] + half, x[None] - half
    kernel = _corner(y_hi, x_hi) + _corner(y_lo, x_lo) - _corner(y_hi, x_lo) - _corner(y_lo, x_hi)
    return np.fft.rfft2(kernel / (np.pi * plane_modulus_mpa)).real


def _corner(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    return y * np.arcsinh(x / np.abs(y)) + x * np.arcsinh(y / np.abs(x))
