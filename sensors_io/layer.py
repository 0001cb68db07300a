"""Linear response of an elastic layer bonded to a rigid base, per wave number, in float64 on the host.

Lengths mm, moduli MPa, z points into the layer.  A surface load of wave vector q makes, with s = qz and κ = 3 − 4ν,

    u_z = W(z) e^{iqx},   u_x = i U(z) e^{iqx},
    W = (a + bs) e^{−s} − (c + ds') e^{−s'},   U = (−a + b(κ − s)) e^{−s} + (−c + d(κ − s')) e^{−s'},   s' = q(h − z),

two families that decay from the surface and from the base, so nothing grows and nothing overflows.
"""

import dataclasses

import numpy as np

_SERIES_BELOW = 0.5  # where sinh x − x cancels; the series is exact to rounding there


@dataclasses.dataclass(frozen=True, kw_only=True)
class Layer:
    """A homogeneous isotropic layer: Young's modulus, Poisson ratio, thickness."""

    modulus_mpa: float
    poisson: float
    thickness_mm: float

    def __post_init__(self) -> None:
        _require(self.modulus_mpa > 0, "modulus_mpa", self.modulus_mpa, "must be > 0")
        _require(0 <= self.poisson <= 0.5, "poisson", self.poisson, "must lie in [0, 0.5]")
        _require(self.thickness_mm > 0, "thickness_mm", self.thickness_mm, "must be > 0")

    @property
    def shear_modulus_mpa(self) -> float:
        """μ = E / (2 (1 + ν))."""
        return self.modulus_mpa / (2 * (1 + self.poisson))


@dataclasses.dataclass(frozen=True, kw_only=True)
class DepthResponse:
    """Displacement at one depth per unit surface load, mm/MPa, each array shaped as the wave numbers.

    For pressure p and tractions τ_l along and τ_t across the wave vector:
    u_z = normal_pressure p − i normal_shear τ_l,  u_l = i lateral_pressure p + lateral_shear τ_l,
    u_t = transverse τ_t.
    """

    normal_pressure: np.ndarray
    lateral_pressure: np.ndarray
    lateral_shear: np.ndarray
    normal_shear: np.ndarray
    transverse: np.ndarray


def wave_numbers(points: int, spacing_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Angular wave numbers of a `rfft2` half plane: q_y [M, 1] and q_x [1, M//2 + 1], rad/mm, for arrays [y, x]."""
    q_y = 2 * np.pi * np.fft.fftfreq(points, spacing_mm)[:, None]
    q_x = 2 * np.pi * np.fft.rfftfreq(points, spacing_mm)[None, :]
    return q_y, q_x


def normal_compliance(q: np.ndarray, layer: Layer) -> np.ndarray:
    """Surface displacement per unit pressure, in closed form.

        G = (1−ν)/(μq) · (κ sinh 2s − 2s) / (κ cosh 2s + 2s² + (1+κ²)/2),  s = qh,  G(0) = h(1−2ν) / (2μ(1−ν))

    Args:
      q: wave numbers of any shape, rad/mm, ≥ 0.
      layer: the layer.

    Returns:
      G in mm/MPa, shaped as q.

    Source: Carbone & Mangialardi 2008, eq. A.30.  Both polynomials are multiplied by 2e^{−2s} here (sinh overflows
    float32 near s = 44), and the numerator is split into (κ−1) sinh 2s + (sinh 2s − 2s) so that ν → ½ loses no digits.
    """
    nu, h = layer.poisson, layer.thickness_mm
    kappa = 3 - 4 * nu
    s = np.asarray(q, np.float64) * h
    decay = np.exp(-2 * s)
    numerator = -(kappa - 1) * np.expm1(-4 * s) + 2 * _decayed_sinh_minus(2 * s)
    denominator = kappa * (1 + decay**2) + (4 * s**2 + 1 + kappa**2) * decay
    slope = 4 * (kappa - 1)  # of the numerator at s = 0
    per_s = np.divide(numerator, s, out=np.full_like(s, slope), where=s > 0)
    return (1 - nu) * h / layer.shear_modulus_mpa * per_s / denominator


def shear_compliance(q: np.ndarray, layer: Layer) -> np.ndarray:
    """Surface displacement across the wave vector per unit traction across it: tanh(qh)/(μq), h/μ at q = 0; mm/MPa."""
    s = np.asarray(q, np.float64) * layer.thickness_mm
    per_s = np.divide(np.tanh(s), s, out=np.ones_like(s), where=s > 0)
    return layer.thickness_mm / layer.shear_modulus_mpa * per_s


def longitudinal_compliance(q: np.ndarray, layer: Layer) -> np.ndarray:
    """Surface displacement along the wave vector per unit traction along it, in closed form.

        G = (1−ν)/(μq) · (κ sinh 2s + 2s) / (κ cosh 2s + 2s² + (1+κ²)/2),  s = qh,  G(0) = h/μ

    Args:
      q: wave numbers of any shape, rad/mm, ≥ 0.
      layer: the layer.

    Returns:
      G in mm/MPa, shaped as q.

    Source: the boundary value problem of `depth_response` solved at the surface; the sum of two positive terms where
    `normal_compliance` has their difference.
    """
    nu, h = layer.poisson, layer.thickness_mm
    kappa = 3 - 4 * nu
    s = np.asarray(q, np.float64) * h
    decay = np.exp(-2 * s)
    sinh_per_s = np.divide(-np.expm1(-4 * s), s, out=np.full_like(s, 4.0), where=s > 0)
    denominator = kappa * (1 + decay**2) + (4 * s**2 + 1 + kappa**2) * decay
    return (1 - nu) * h / layer.shear_modulus_mpa * (kappa * sinh_per_s + 4 * decay) / denominator


def depth_response(q: np.ndarray, layer: Layer, depth_mm: float) -> DepthResponse:
    """Displacement at `depth_mm` below the surface, from the four boundary conditions solved per wave number.

        σ_zz(0) = −p,  σ_xz(0) = −τ,  u(h) = 0

    Args:
      q: wave numbers of any shape, rad/mm, ≥ 0.
      layer: the layer.
      depth_mm: where the markers lie, in [0, h].

    Raises:
      ValueError: a depth outside the layer.
    """
    h = layer.thickness_mm
    _require(0 <= depth_mm <= h, "depth_mm", depth_mm, f"must lie in [0, {h}], inside the layer")
    q = np.asarray(q, np.float64)
    positive = np.where(q > 0, q, 1.0).ravel()
    load = np.zeros((positive.size, 4, 2))
    load[:, 0, 0] = load[:, 1, 1] = -1.0
    amplitude = np.linalg.solve(_boundary(positive, layer), load)
    u, w = _displacement(positive, layer, depth_mm)
    scale = 1 / (2 * layer.shear_modulus_mpa * positive)
    normal, lateral = (np.einsum("nk,nkl->ln", rows, amplitude) * scale for rows in (w, u))
    rest = h - depth_mm
    across = _sinh_over_cosh(positive, h, rest) / (layer.shear_modulus_mpa * positive)
    uniform_shear = rest / layer.shear_modulus_mpa
    uniform_normal = rest / h * float(normal_compliance(np.zeros(()), layer))

    def spread(found: np.ndarray, at_zero: float) -> np.ndarray:
        return np.where(q > 0, found.reshape(q.shape), at_zero)

    return DepthResponse(
        normal_pressure=spread(normal[0], uniform_normal),
        lateral_pressure=spread(lateral[0], 0.0),
        lateral_shear=spread(lateral[1], uniform_shear),
        normal_shear=spread(normal[1], 0.0),
        transverse=spread(across, uniform_shear),
    )


def _decayed_sinh_minus(x: np.ndarray) -> np.ndarray:
    """e^{−x} (sinh x − x) without cancellation."""
    small = np.minimum(x, _SERIES_BELOW)
    y = small**2
    series = small**3 / 6 * (1 + y / 20 * (1 + y / 42 * (1 + y / 72 * (1 + y / 110 * (1 + y / 156)))))
    direct = -np.expm1(-2 * x) / 2 - x * np.exp(-x)
    return np.where(x < _SERIES_BELOW, np.exp(-x) * series, direct)


def _displacement(q: np.ndarray, layer: Layer, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of U and W at depth z for the unknowns (a, b, c, d), each [n, 4]."""
    kappa = 3 - 4 * layer.poisson
    s, t = q * z, q * (layer.thickness_mm - z)
    top, base = np.exp(-s), np.exp(-t)
    u = np.stack([-top, (kappa - s) * top, -base, (kappa - t) * base], -1)
    w = np.stack([top, s * top, -base, -t * base], -1)
    return u, w


def _boundary(q: np.ndarray, layer: Layer) -> np.ndarray:
    """The four conditions [n, 4, 4]; stresses in units of 2μq, dilatation in closed form (finite at ν = ½)."""
    nu = layer.poisson
    half = (1 + 3 - 4 * nu) / 2
    t = q * layer.thickness_mm
    base, one = np.exp(-t), np.ones_like(q)
    sigma = np.stack([-one, (1 - 2 * nu) * one, -base, (1 - 2 * nu - t) * base], -1)
    tau = np.stack([one, -half * one, -base, (half - t) * base], -1)
    return np.stack([sigma, tau, *_displacement(q, layer, layer.thickness_mm)], 1)


def _sinh_over_cosh(q: np.ndarray, h: float, rest: float) -> np.ndarray:
    """sinh(q rest) / cosh(q h) by decaying exponentials."""
    return np.exp(-q * (h - rest)) * -np.expm1(-2 * q * rest) / (1 + np.exp(-2 * q * h))


def _require(ok: bool, field: str, value: object, constraint: str) -> None:
    if not ok:
        raise ValueError(f"{field} is {value!r}: {constraint}; change {field}")
