"""Closed forms of a sphere on a half-space with friction: what the friction solver must reproduce in its limit.

G is the shear modulus, MPa; lengths mm, forces N.  They are exact for ν = 0, where the half-space is as compliant along
a wave as across it (`half_space`).
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from sensors_io.scenes.hertz import Hertz, half_space_spectrum
from sensors_io.scenes.traction import Compliance


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrictionalSphere:
    """A sphere pressed without friction by force F, then pulled by Q or twisted, with friction μ."""

    normal: Hertz
    shear_modulus_mpa: float
    friction: float

    @property
    def most_n(self) -> float:
        """μF, the greatest tangential force."""
        return self.friction * self.normal.force_n

    def limit_mpa(self, r_mm: np.ndarray, spacing_mm: float) -> np.ndarray:
        """μp on pixels at distances r from the centre, scaled so that their sum carries the force exactly."""
        p = self.normal.pressure_mpa(r_mm)
        return self.friction * p * self.normal.force_n / (p.sum() * spacing_mm**2)

    def slide_mm(self, share: float) -> float:
        """The rigid slide that carries Q = share · μF:  δ = 3μF/(8Ga) [1 − (1 − Q/μF)^⅔].

        Sources: Cattaneo 1938; Mindlin 1949.
        """
        full = 3 * self.most_n / (8 * self.shear_modulus_mpa * self.normal.contact_radius_mm)
        return full * (1 - (1 - share) ** (2 / 3))

    def stick_radius_mm(self, share: float) -> float:
        """Radius of the part that sticks under Q = share · μF:  c = a (1 − Q/μF)^⅓."""
        return self.normal.contact_radius_mm * (1 - share) ** (1 / 3)

    def pulled_mpa(self, share: float, r_mm: np.ndarray) -> np.ndarray:
        """The traction that carries Q = share · μF:  τ = μ [p_a(r) − (c/a) p_c(r)], shaped as r."""
        stick = self.stick_radius_mm(share)
        peak = self.normal.peak_pressure_mpa * stick / self.normal.contact_radius_mm
        inner = peak * np.sqrt(np.maximum(1 - (r_mm / stick) ** 2, 0))
        return self.friction * (self.normal.pressure_mpa(r_mm) - inner)

    def twist(self, stick_ratio: float) -> tuple[float, float]:
        """Twist, rad, and torque, N mm, of the sphere that sticks within c = stick_ratio · a, 0 < stick_ratio < 1.

        A stack of twisted punches of radius t (Reissner & Sagoci 1944: torque 16/3 G t³ each) makes τ = μp outside c:
        θ(c) = 3μF/(4πGa²) [K(k) − E(k)],  k² = 1 − c²/a²;  the torque is ∫ 16/3 G t³ dθ(t).

        Source: Lubkin 1951.
        """
        a, angle = self.normal.contact_radius_mm, np.linspace(0, np.pi / 2, 4001)
        ratio = np.linspace(stick_ratio, 1, 400)
        root = np.sqrt(1 - (1 - ratio[:, None] ** 2) * np.sin(angle) ** 2)
        scale = 3 * self.friction * self.normal.force_n / (4 * np.pi * self.shear_modulus_mpa * a**2)
        twist = scale * np.trapezoid(1 / root - root, angle, axis=1)
        return float(twist[0]), float(np.trapezoid(16 / 3 * self.shear_modulus_mpa * (ratio * a) ** 3, -twist))


def half_space(points: int, spacing_mm: float, modulus_mpa: float) -> Compliance:
    """Tangential compliance of a half-space of ν = 0, which is isotropic and equals the normal one."""
    half = half_space_spectrum(points, spacing_mm, modulus_mpa)
    even = np.concatenate([half, np.roll(half[::-1], 1, 0)[:, points - 1 : 0 : -1]], 1)
    return Compliance(even=jnp.asarray(even, jnp.float32), odd=jnp.zeros(even.shape, jnp.complex64))
