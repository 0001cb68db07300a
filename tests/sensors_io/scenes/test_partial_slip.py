"""The cheap tier: exact where it should be, within its promise elsewhere, and interpolation in a press ramp."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.layer import Layer
from sensors_io.scenes import partial_slip, tangential, traction
from sensors_io.scenes.hertz import Hertz
from sensors_io.scenes.mindlin import half_space
from tests.sensors_io.scenes.references import off

N, M, WINDOW_MM = 40, 80, 16.0
SPACING = WINDOW_MM / N
X = (np.arange(N) + 0.5) * SPACING - WINDOW_MM / 2
RADIUS = np.hypot(X[None], X[:, None])
FRICTION, FORCE, SHEAR_MODULUS = 0.5, 4.0, 0.15
BODY = Layer(modulus_mpa=1.0, poisson=0.4, thickness_mm=20.0)
STILL = jnp.zeros((N, N), jnp.complex64)
IN_RAMP = jax.jit(partial_slip.in_ramp)


def _pressure(force: float) -> np.ndarray:
    hertz = Hertz(radius_mm=8.0, plane_modulus_mpa=2 * SHEAR_MODULUS, force_n=force)
    p = hertz.pressure_mpa(RADIUS)
    return p * force / (p.sum() * SPACING**2)


@functools.cache
def _ramp(levels: int = 16) -> tuple[jax.Array, jax.Array]:
    forces = np.geomspace(0.05, FORCE, levels)
    return jnp.asarray(np.stack([_pressure(f) for f in forces]), jnp.float32), jnp.asarray(forces, jnp.float32)


@functools.cache
def _half_space() -> traction.Compliance:
    """ν = 0: the tangential compliance is the normal one, so that the superposition is exact."""
    return half_space(N, SPACING, 2 * SHEAR_MODULUS)


def _sum(field: jax.Array) -> complex:
    return complex(np.asarray(field).sum(dtype=np.complex128)) * SPACING**2


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_half_space_is_exact(share: float) -> None:
    """The superposition obeys the friction law of the exact problem to the discretisation of the pressures."""
    pull = share * FRICTION * FORCE
    cheap = partial_slip.ciavarella_jaeger(_pressure(FORCE), _pressure(FORCE - pull / FRICTION), FRICTION, 1j)
    limit = jnp.asarray(FRICTION * _pressure(FORCE), jnp.float32)
    exact = tangential.solve_force(limit, jnp.array([0.0, pull]), STILL, _half_space(), SPACING, 1e-4)
    assert _sum(cheap) == pytest.approx(1j * pull, rel=0.02)
    assert off(exact.traction_mpa, cheap) < 0.06


@pytest.mark.parametrize(("levels", "error"), [(8, 0.16), (16, 0.06)])
def test_interpolation_meets_the_ramp_carries_every_force_and_is_near_between(levels: int, error: float) -> None:
    pressures, forces = _ramp(levels)
    at = lambda force: np.asarray(IN_RAMP(pressures, forces, jnp.float32(force)))
    for k in (0, 7, levels - 1):
        np.testing.assert_allclose(at(forces[k]), pressures[k], atol=1e-6)
    for force in (0.0, 0.01, 0.3, 2.9, 4.0, 5.0):
        assert _sum(at(force)).real == pytest.approx(force, rel=1e-4, abs=1e-6)
    for force in (0.4, 1.6, 2.8):
        assert off(at(force), _pressure(force)) < error


def test_a_prescribed_slide_finds_its_force() -> None:
    """Cattaneo and Mindlin: δ = 3μF/(8Ga) [1 − (1 − Q/μF)^⅔]."""
    pressures, forces = _ramp()
    slides = jax.jit(partial_slip.core_slide)(pressures, _half_space(), jnp.complex64(1))
    a = Hertz(radius_mm=8.0, plane_modulus_mpa=2 * SHEAR_MODULUS, force_n=FORCE).contact_radius_mm
    full = 3 * FRICTION * FORCE / (8 * SHEAR_MODULUS * a)
    stuck = jax.jit(partial_slip.stuck_force)
    for share in (0.0, 0.2, 0.5, 0.8):
        slide = full * (1 - (1 - share) ** (2 / 3))
        found = stuck(forces, slides, jnp.float32(FORCE), FRICTION, jnp.float32(slide))
        assert float(FORCE - found) == pytest.approx(share * FORCE, abs=0.03 * FORCE)
    assert stuck(forces, slides, jnp.float32(FORCE), FRICTION, jnp.float32(1.05 * full)) == 0


@pytest.mark.parametrize(("body", "error"), [(None, 0.02331), (BODY, 0.01993)])
def test_the_promised_error_by_hand(body: Layer | None, error: float) -> None:
    """Of its formula, worked out once; `pareto_tangential` measures whether the promise is kept."""
    gel = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
    assert partial_slip.promised_error(gel, body, 2.0) == pytest.approx(error, rel=1e-3)
