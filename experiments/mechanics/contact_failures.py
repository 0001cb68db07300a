"""Scenes at which contact solvers are known to fail: overflow, cycling, empty contacts, broken assumptions."""

import dataclasses

import numpy as np

from experiments.mechanics.contact_scenes import GelKernels
from sensors_io.layer import Layer, normal_compliance, wave_numbers

SIDE_MM = 16.0
GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FailureCase:
    """A rigid body over a gel; `refused` says that the theory does not carry it, so that it must be flagged."""

    name: str
    gap_mm: np.ndarray
    force_n: float
    gel: Layer = GEL
    refused: bool = False

    def kernels(self) -> GelKernels:
        """Spectra of this gel on a grid padded to one and a half times its side."""
        grid = self.gap_mm.shape[0]
        spacing = SIDE_MM / grid
        gel = normal_compliance(np.hypot(*wave_numbers(grid * 3 // 2, spacing)), self.gel)
        return GelKernels(gel=gel, body=np.zeros_like(gel), spacing_mm=spacing, thickness_mm=self.gel.thickness_mm)


def suite(grid: int) -> tuple[FailureCase, ...]:
    """Every case on a grid of that side, a multiple of 4.

    Kernel overflow is that of sinh(qh) in float32, at qh > 88: the finest wave of a thick gel.
    """
    x = (np.arange(grid) + 0.5) * SIDE_MM / grid - SIDE_MM / 2
    r2 = x[None] ** 2 + x[:, None] ** 2
    noise = np.random.default_rng(0).standard_normal((grid, grid))
    thick, thin = (dataclasses.replace(GEL, thickness_mm=h) for h in (40.0, 0.3))
    spacing = SIDE_MM / grid
    dimple = r2 / (2 * 1e3 * (2 * spacing) ** 3)  # a dozen pixels at 1 mN, so flat that the gel hardly dents
    return (
        FailureCase(name="kernel overflow: h = 40 mm", gap_mm=r2 / 16, force_n=5.0, gel=thick),
        FailureCase(name="a few pixels at 1 mN", gap_mm=r2 / 16, force_n=1e-3, refused=True),
        FailureCase(name="a dozen pixels at 1 mN", gap_mm=dimple, force_n=1e-3),
        FailureCase(name="needle beside a shoulder", gap_mm=_needle(grid), force_n=2.0),
        FailureCase(name="rough flat, 75 % contact", gap_mm=_waves(x, 0.03), force_n=15.0),
        FailureCase(name="full pad", gap_mm=np.zeros((grid, grid)), force_n=5.0),
        FailureCase(name="white noise", gap_mm=0.1 * noise, force_n=5.0),
        FailureCase(name="ν = 0.4999", gap_mm=r2 / 16, force_n=5.0, gel=dataclasses.replace(GEL, poisson=0.4999)),
        FailureCase(name="ν = 0.5", gap_mm=r2 / 16, force_n=5.0, gel=dataclasses.replace(GEL, poisson=0.5)),
        FailureCase(name="h = 0.3 mm", gap_mm=r2 / 16, force_n=5.0, gel=thin, refused=True),
        FailureCase(name="tilt", gap_mm=r2 / 60 + 0.2 * x[None], force_n=5.0),
        FailureCase(
            name="E = 0.01 MPa",
            gap_mm=r2 / 16,
            force_n=1.0,
            gel=dataclasses.replace(GEL, modulus_mpa=0.01),
            refused=True,
        ),
        FailureCase(name="sphere at 20 N, strain > 0.3", gap_mm=r2 / 8, force_n=20.0, refused=True),
        FailureCase(name="pin R 0.5 mm at 5 N", gap_mm=_pin(r2), force_n=5.0, refused=True),
    )


def _needle(grid: int) -> np.ndarray:
    """A needle of 2 × 2 pixels beside a flat shoulder 0.6 mm higher up, which just touches."""
    gap, half = np.full((grid, grid), 5.0), grid // 2
    gap[:, : half - 4] = 0.6
    gap[half - 1 : half + 1, half + 4 : half + 6] = 0.0
    return gap


def _waves(x: np.ndarray, rms_mm: float) -> np.ndarray:
    """A flat with sixty waves between 4 and 0.9 mm."""
    rng = np.random.default_rng(3)
    q, angle, phase = rng.uniform(1.6, 7.0, 60), rng.uniform(0, 2 * np.pi, 60), rng.uniform(0, 2 * np.pi, 60)
    along = np.cos(angle)[:, None, None] * x[None, None] + np.sin(angle)[:, None, None] * x[None, :, None]
    height = np.cos(q[:, None, None] * along + phase[:, None, None]).sum(0)
    return height / height.std() * rms_mm


def _pin(r2: np.ndarray, radius: float = 0.5) -> np.ndarray:
    """A hemisphere, and a steep cone beyond it."""
    cap = radius - np.sqrt(np.maximum(radius**2 - r2, 0))
    return np.where(r2 < radius**2, cap, radius + 3 * (np.sqrt(r2) - radius))
