"""Tractions on the gel and what they do by linear elasticity: displacement at any depth, total force and moment.

A vector along the surface (x, y) is kept as the complex number x + iy: a rotation is a product, both components share
one complex transform.  Frames as in the schema: x right, y down, z out of the gel; tractions and forces act on the gel,
so that a pressure p is a traction −p along z; `depth` counts into the gel.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Complex, Float

from sensors_io.layer import Layer, depth_response, longitudinal_compliance, shear_compliance, wave_numbers


@struct.dataclass
class Compliance:
    """Surface displacement per traction along the surface, on the whole plane of wave numbers, mm/MPa.

        û(q) = even τ̂(q) + odd conj τ̂(−q),  even = (G_l + G_t)/2,  odd = (G_l − G_t)/2 e^{2iφ}

    with G_l and G_t the compliances along and across the wave vector, φ its direction.
    """

    even: Float[Array, "M M"]
    odd: Complex[Array, "M M"]


@struct.dataclass
class Response:
    """Displacement at one depth, on the whole plane: along the surface and into the gel, by p and by τ, mm/MPa.

        û = even τ̂ + odd conj τ̂(−q) + lateral p̂,   û_z = depth p̂ − i normal τ̂_l

    `lateral` = i U e^{iφ} and `normal` = S e^{−iφ} with U and S of `layer.DepthResponse`; `depth` is a half plane.
    """

    shear: Compliance
    lateral: Complex[Array, "M M"]
    normal: Complex[Array, "M M"]
    depth: Float[Array, "M K"]


def make_compliance(layer: Layer, points: int, spacing_mm: float) -> Compliance:
    """Compliance of a layer's surface on a padded grid of `points`² pixels, made in float64, kept in float32."""
    q, phase = _plane(points, spacing_mm)
    return _compliance(longitudinal_compliance(q, layer), shear_compliance(q, layer), phase)


def make_response(layer: Layer, points: int, spacing_mm: float, depth_mm: float) -> Response:
    """Response at `depth_mm` below the surface on a padded grid of `points`² pixels, likewise.

    Raises:
      ValueError: a depth outside the layer.
    """
    q, phase = _plane(points, spacing_mm)
    at = depth_response(q, layer, depth_mm)
    return Response(
        shear=_compliance(at.lateral_shear, at.transverse, phase),
        lateral=jnp.asarray(1j * at.lateral_pressure * phase, jnp.complex64),
        normal=jnp.asarray(at.normal_shear * phase.conj(), jnp.complex64),
        depth=jnp.asarray(at.normal_pressure[:, : points // 2 + 1], jnp.float32),
    )


def in_series(gel: Compliance, body: Compliance, gel_factor: Array | float, body_mpa: Array | float) -> Compliance:
    """Compliance of the gel at a modulus `gel_factor` times its model's, and of a body given per MPa."""
    return jax.tree.map(lambda a, b: a / gel_factor + b / body_mpa, gel, body)


def shear_displacement(traction_mpa: Complex[Array, "N N"], compliance: Compliance) -> Complex[Array, "N N"]:
    """C ∗ τ at the surface, mm, zero-padded."""
    n, m = traction_mpa.shape[-1], compliance.even.shape[-1]
    return jnp.fft.ifft2(_shear_spectrum(jnp.fft.fft2(traction_mpa, s=(m, m)), compliance))[:n, :n]


def make_coupling(layer: Layer, points: int, spacing_mm: float) -> Complex[Array, "M M"]:
    """Spectrum i U e^{iφ} of the lateral displacement of a layer's surface by pressure, mm/MPa.

    The object's surface moves likewise, so that the two differ by gel − object, which is 0 for equal materials.
    """
    q, phase = _plane(points, spacing_mm)
    return jnp.asarray(1j * depth_response(q, layer, 0.0).lateral_pressure * phase, jnp.complex64)


def lateral_displacement(pressure_mpa: Float[Array, "N N"], coupling: Complex[Array, "M M"]) -> Complex[Array, "N N"]:
    """Displacement along the surface by pressure, mm, zero-padded."""
    n, m = pressure_mpa.shape[-1], coupling.shape[-1]
    return jnp.fft.ifft2(jnp.fft.fft2(pressure_mpa, s=(m, m)) * coupling)[:n, :n]


def displacement(
    pressure_mpa: Float[Array, "N N"], traction_mpa: Complex[Array, "N N"], response: Response
) -> tuple[Complex[Array, "N N"], Float[Array, "N N"]]:
    """Displacement at the depth of `response` by both loads: along the surface (complex) and into the gel."""
    n, m = pressure_mpa.shape[-1], response.lateral.shape[-1]
    pressure, traction = jnp.fft.fft2(pressure_mpa, s=(m, m)), jnp.fft.fft2(traction_mpa, s=(m, m))
    along = _shear_spectrum(traction, response.shear) + response.lateral * pressure
    half = m // 2 + 1
    # S τ_l = (S e^{−iφ} τ̂ + S e^{iφ} conj τ̂(−q)) / 2, the field of a real quantity
    longitudinal = (response.normal * traction + jnp.conj(response.normal) * _mirrored(traction)) / 2
    depth = response.depth * pressure[:, :half] - 1j * longitudinal[:, :half]
    return jnp.fft.ifft2(along)[:n, :n], jnp.fft.irfft2(depth, s=(m, m))[:n, :n]


def rigid_field(
    x_mm: Float[Array, "N"], slide_mm: Float[Array, "2"], twist_rad: Array | float, centre_mm: Float[Array, "2"]
) -> Complex[Array, "N N"]:
    """Displacement of a rigid surface on the grid [y, x] of `x_mm` × `x_mm`, s + iθ(r − c): (−θy, θx) for a twist."""
    r = (x_mm[None, :] - centre_mm[0]) + 1j * (x_mm[:, None] - centre_mm[1])
    return jax.lax.complex(slide_mm[0], slide_mm[1]) + 1j * twist_rad * r


def resultant(
    pressure_mpa: Float[Array, "N N"],
    traction_mpa: Complex[Array, "N N"],
    x_mm: Float[Array, "N"],
    spacing_mm: Array | float,
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Total force on the gel, N, and its moment about the window's centre, N mm: f = Σ (τ_x, τ_y, −p), m = Σ r × f."""
    x, y = x_mm[None, :], x_mm[:, None]
    area = spacing_mm**2
    force = jnp.stack([jnp.sum(traction_mpa.real), jnp.sum(traction_mpa.imag), -jnp.sum(pressure_mpa)]) * area
    about_z = x * traction_mpa.imag - y * traction_mpa.real
    moment = jnp.stack([-jnp.sum(y * pressure_mpa), jnp.sum(x * pressure_mpa), jnp.sum(about_z)]) * area
    return force, moment


def _plane(points: int, spacing_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """|q| [M, M] and e^{iφ}, 0 at q = 0 and at the Nyquist wave number, where odd kernels have no real field."""
    q_y, _ = wave_numbers(points, spacing_mm)
    q = q_y.T + 1j * q_y
    nyquist = np.abs(q_y) > np.pi / spacing_mm * (1 - 1e-9)
    odd_exists = (np.abs(q) > 0) & ~(nyquist | nyquist.T)
    return np.abs(q), np.where(odd_exists, q / np.where(q == 0, 1, np.abs(q)), 0)


def _compliance(along: np.ndarray, across: np.ndarray, phase: np.ndarray) -> Compliance:
    odd = (along - across) / 2 * phase**2
    return Compliance(even=jnp.asarray((along + across) / 2, jnp.float32), odd=jnp.asarray(odd, jnp.complex64))


def _shear_spectrum(spectrum: Array, compliance: Compliance) -> Array:
    return compliance.even * spectrum + compliance.odd * _mirrored(spectrum)


def _mirrored(spectrum: Array) -> Array:
    """conj f̂(−q), the transform of the conjugate field."""
    return jnp.conj(jnp.roll(spectrum[::-1, ::-1], (1, 1), (0, 1)))
