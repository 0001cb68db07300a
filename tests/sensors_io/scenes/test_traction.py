"""Tractions and displacements: complex spectra against plain real ones, reciprocity, resultants by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.layer import Layer, depth_response, longitudinal_compliance, shear_compliance, wave_numbers
from sensors_io.scenes import traction
from tests.sensors_io.scenes.references import directions, shear_tensor

N, M, SPACING = 24, 36, 0.5
X = (np.arange(N) + 0.5) * SPACING - N * SPACING / 2
GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
BODY = Layer(modulus_mpa=1.0, poisson=0.4, thickness_mm=20.0)
RNG = np.random.default_rng(0)
PRESSURE = np.abs(RNG.standard_normal((N, N)))
DISPLACEMENT = jax.jit(traction.displacement)
SHEAR_DISPLACEMENT = jax.jit(traction.shear_displacement)
TRACTION = RNG.standard_normal((N, N)) + 1j * RNG.standard_normal((N, N))


def _real(spectrum: np.ndarray, field: np.ndarray) -> np.ndarray:
    return np.fft.irfft2(np.fft.rfft2(field, s=(M, M)) * spectrum, s=(M, M))[:N, :N]


def _by_components(depth_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """u_x + iu_y and u_z from five real spectra on the half plane, one product per pair of components."""
    q_y, q_x = wave_numbers(M, SPACING)
    at = depth_response(np.hypot(q_y, q_x), GEL, depth_mm)
    (xx, xy), (_, yy) = shear_tensor(GEL, M, SPACING, depth_mm)
    c, s = directions(M, SPACING)
    t_x, t_y = TRACTION.real, TRACTION.imag
    u_x = _real(xx, t_x) + _real(xy, t_y) + _real(1j * c * at.lateral_pressure, PRESSURE)
    u_y = _real(xy, t_x) + _real(yy, t_y) + _real(1j * s * at.lateral_pressure, PRESSURE)
    u_z = _real(at.normal_pressure, PRESSURE)
    u_z += _real(-1j * c * at.normal_shear, t_x) + _real(-1j * s * at.normal_shear, t_y)
    return u_x + 1j * u_y, u_z


@pytest.mark.parametrize("depth_mm", [0.0, 0.5])
def test_displacement_equals_component_by_component(depth_mm: float) -> None:
    response = traction.make_response(GEL, M, SPACING, depth_mm)
    pressure, shear = jnp.asarray(PRESSURE, jnp.float32), jnp.asarray(TRACTION, jnp.complex64)
    along, depth = DISPLACEMENT(pressure, shear, response)
    want_along, want_depth = _by_components(depth_mm)
    np.testing.assert_allclose(along, want_along, atol=1e-5 * np.abs(want_along).max())
    np.testing.assert_allclose(depth, want_depth, atol=1e-5 * np.abs(want_depth).max())


def test_the_surface_response_is_made_of_compliance_and_coupling() -> None:
    response = traction.make_response(GEL, M, SPACING, 0.0)
    compliance = traction.make_compliance(GEL, M, SPACING)
    np.testing.assert_allclose(response.shear.even, compliance.even, rtol=1e-5)
    np.testing.assert_allclose(response.shear.odd, compliance.odd, atol=1e-6 * np.abs(compliance.odd).max())
    np.testing.assert_array_equal(response.lateral, traction.make_coupling(GEL, M, SPACING))


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.48, 0.5])
def test_longitudinal_compliance_in_closed_form(poisson: float) -> None:
    layer = Layer(modulus_mpa=0.3, poisson=poisson, thickness_mm=4.0)
    q = np.array([0.0, 1e-3, 0.1, 1.0, 10.0, 200.0])
    np.testing.assert_allclose(
        longitudinal_compliance(q, layer), depth_response(q, layer, 0.0).lateral_shear, rtol=1e-8
    )
    assert longitudinal_compliance(np.zeros(1), layer)[0] == pytest.approx(4.0 / layer.shear_modulus_mpa)
    half_space = (1 - poisson) / (layer.shear_modulus_mpa * 200.0)
    assert longitudinal_compliance(np.array([200.0]), layer)[0] == pytest.approx(half_space)


def test_bodies_in_series_add() -> None:
    gel, body = traction.make_compliance(GEL, M, SPACING), traction.make_compliance(BODY, M, SPACING)
    q = np.hypot(*wave_numbers(M, SPACING))[0]
    both = jax.jit(traction.in_series)(gel, body, 1.1, 5.0)
    along = longitudinal_compliance(q, GEL) / 1.1 + longitudinal_compliance(q, BODY) / 5
    across = shear_compliance(q, GEL) / 1.1 + shear_compliance(q, BODY) / 5
    np.testing.assert_allclose(both.even[0, : len(q)], (along + across) / 2, rtol=1e-5)


def test_rigid_fields() -> None:
    x = jnp.asarray(X, jnp.float32)
    slid = jax.jit(traction.rigid_field)(x, np.array([0.3, -0.1], np.float32), 0.0, np.zeros(2, np.float32))
    np.testing.assert_allclose(slid, 0.3 - 0.1j, rtol=1e-6)
    twisted = jax.jit(traction.rigid_field)(x, np.zeros(2, np.float32), 0.2, np.array([1.0, 2.0], np.float32))
    np.testing.assert_allclose(twisted.real, np.broadcast_to(-0.2 * (X[:, None] - 2), (N, N)), atol=1e-6)
    np.testing.assert_allclose(twisted.imag, np.broadcast_to(0.2 * (X[None] - 1), (N, N)), atol=1e-6)


def test_resultant_of_two_point_loads() -> None:
    pressure, shear = np.zeros((N, N), np.float32), np.zeros((N, N), np.complex64)
    pressure[3, 5] = 8.0  # 2 N on a pixel of 0.25 mm²
    shear[7, 2] = 4.0 - 12.0j  # (1, −3) N
    x = jnp.asarray(X, jnp.float32)
    force, moment = jax.device_get(jax.jit(traction.resultant)(jnp.asarray(pressure), jnp.asarray(shear), x, SPACING))
    np.testing.assert_allclose(force, [1.0, -3.0, -2.0], rtol=1e-6)
    by_hand = np.cross([X[5], X[3], 0], [0, 0, -2.0]) + np.cross([X[2], X[7], 0], [1.0, -3.0, 0])
    np.testing.assert_allclose(moment, by_hand, atol=1e-5)
