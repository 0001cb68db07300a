"""Friction: closed forms of a sphere on a half-space, a float64 host solution of layers, the limits, the flags."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.layer import Layer
from sensors_io.scenes import tangential, traction
from sensors_io.scenes.hertz import Hertz
from sensors_io.scenes.mindlin import FrictionalSphere, half_space
from tests.sensors_io.scenes.references import off

N, WINDOW_MM = 48, 16.0
SPACING = WINDOW_MM / N
X = (np.arange(N) + 0.5) * SPACING - WINDOW_MM / 2
RADIUS = np.hypot(X[None], X[:, None])
GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
SHEAR_MODULUS, FRICTION = 0.15, 0.5
SPHERE = FrictionalSphere(
    normal=Hertz(radius_mm=8.0, plane_modulus_mpa=2 * SHEAR_MODULUS, force_n=2.0),
    shear_modulus_mpa=SHEAR_MODULUS,
    friction=FRICTION,
)
A_MM = SPHERE.normal.contact_radius_mm
STILL = jnp.zeros((N, N), jnp.complex64)
SHEAR_DISPLACEMENT = jax.jit(traction.shear_displacement)


@functools.cache
def _half_space() -> traction.Compliance:
    return half_space(N, SPACING, 2 * SHEAR_MODULUS)


@functools.cache
def _layer() -> traction.Compliance:
    return traction.make_compliance(GEL, 2 * N, SPACING)


def _limit() -> np.ndarray:
    """μp of the sphere, which carries the force exactly."""
    return SPHERE.limit_mpa(RADIUS, SPACING)


def _slide(limit: np.ndarray, target: np.ndarray | complex, compliance: traction.Compliance, **kwargs):
    field = jnp.asarray(np.broadcast_to(target, limit.shape), jnp.complex64)
    return jax.device_get(tangential.solve(jnp.asarray(limit, jnp.float32), field, compliance, **kwargs))


def _pull(limit: np.ndarray, force: tuple[float, float], compliance: traction.Compliance, tolerance: float = 1e-4):
    q = jnp.asarray(force, jnp.float32)
    return jax.device_get(
        tangential.solve_force(jnp.asarray(limit, jnp.float32), q, STILL, compliance, SPACING, tolerance)
    )


def _rough_pressure(seed: int = 0) -> np.ndarray:
    """A ragged contact, as of dots on a ball."""
    rng = np.random.default_rng(seed)
    wavy = np.cos(X[None] * 2.1 + rng.uniform(0, 6)) * np.cos(X[:, None] * 1.9 + rng.uniform(0, 6))
    return 0.15 * np.maximum(1 - RADIUS**2 / 25 + 0.8 * wavy, 0) * (RADIUS < 6)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_cattaneo_and_mindlin(share: float) -> None:
    most = SPHERE.most_n
    solved = _pull(_limit(), (share * most, 0.0), _half_space())
    assert solved.converged
    assert complex(solved.slide_mm) == pytest.approx(SPHERE.slide_mm(share), rel=0.01)
    assert solved.stick_share == pytest.approx((SPHERE.stick_radius_mm(share) / A_MM) ** 2, abs=0.06)
    assert off(solved.traction_mpa, SPHERE.pulled_mpa(share, RADIUS)) < 0.06
    pulled = complex(solved.traction_mpa.sum(dtype=np.complex128)) * SPACING**2
    assert pulled == pytest.approx(share * most, rel=1e-5)


@pytest.mark.parametrize("stick_ratio", [0.8, 0.5, 0.2, 0.0])
def test_lubkin_twist(stick_ratio: float) -> None:
    """Down to the whole contact slipping, at a torque of 3π/16 μFa."""
    twist, torque = SPHERE.twist(stick_ratio) if stick_ratio else (100.0, 3 * np.pi / 16 * SPHERE.most_n * A_MM)
    solved = _slide(_limit(), 1j * twist * (X[None] + 1j * X[:, None]), _half_space(), tolerance=1e-4)
    x = jnp.asarray(X, jnp.float32)
    force, moment = jax.jit(traction.resultant)(jnp.zeros((N, N)), solved.traction_mpa, x, SPACING)
    assert moment[2] == pytest.approx(torque, rel=0.02)
    np.testing.assert_allclose(force, 0, atol=1e-4)
    assert solved.stick_share == pytest.approx(stick_ratio**2, abs=0.08)


def test_the_force_limit_is_a_flag() -> None:
    most = _limit().sum() * SPACING**2
    past, at = (_pull(_limit(), (share * most, 0.0), _half_space()) for share in (1.2, 0.999))
    assert (bool(past.converged), bool(at.converged)) == (False, True)
    np.testing.assert_allclose(past.traction_mpa, _limit(), rtol=0.01, atol=1e-6)


def test_no_contact_or_no_motion_no_traction() -> None:
    empty, still = _slide(np.zeros((N, N)), 0.3, _layer()), _slide(_rough_pressure(), 0.0, _layer())
    pulled = _pull(np.zeros((N, N)), (1.0, 0.0), _layer())
    assert (empty.converged, empty.iterations, empty.stick_share) == (True, 0, 0)
    assert (bool(still.converged), bool(pulled.converged)) == (True, False)
    for solved in (empty, still, pulled):
        np.testing.assert_array_equal(solved.traction_mpa, 0)


GRIPS = {
    "sphere": (_limit(), np.full((N, N), 0.2 + 0j)),
    "dots": (_rough_pressure(1), np.full((N, N), 0.1 + 0.15j)),
    "twist": (_rough_pressure(2), 0.1j * (X[None] + 1j * X[:, None])),
    "slide and twist": (_rough_pressure(3), 0.1 + 0.06j * (X[None] - 2 + 1j * X[:, None])),
}


@pytest.mark.parametrize("tolerance", [tangential.TOLERANCE, 5e-5])
@pytest.mark.parametrize("name", GRIPS)
def test_the_gap_of_the_friction_law_closes(name: str, tolerance: float) -> None:
    """The problem is convex: an admissible traction without a gap is the solution."""
    limit, target = GRIPS[name]
    solved = _slide(limit, target, _layer(), tolerance=tolerance, max_iterations=400)
    slip = target - jax.device_get(SHEAR_DISPLACEMENT(jnp.asarray(solved.traction_mpa, jnp.complex64), _layer()))
    gap = np.sum(limit * np.abs(slip) - (slip.conj() * solved.traction_mpa).real) / np.sum(limit * np.abs(target))
    assert gap == pytest.approx(float(solved.residual), abs=1e-5)
    assert solved.converged
    assert solved.residual < tolerance
    assert np.all(np.abs(solved.traction_mpa) <= limit * (1 + 1e-5))


HARD_CASES = {
    "one pixel": (0.1 * (np.arange(N * N) == N * N // 2 + N // 2).reshape(N, N), 0.2, GEL),
    "full pad": (np.full((N, N), 0.05), 0.3 + 0.1j, GEL),
    "white noise": (0.1 * np.random.default_rng(0).random((N, N)), 0.2, GEL),
    "thin gel": (_rough_pressure(), 0.05, dataclasses.replace(GEL, thickness_mm=0.3)),
    "incompressible": (_rough_pressure(), 0.2, dataclasses.replace(GEL, poisson=0.5)),
    "very soft gel": (_rough_pressure(), 5.0, dataclasses.replace(GEL, modulus_mpa=0.01)),
    "tiny pressure": (1e-8 * _rough_pressure(), 0.2, GEL),
    "tiny slide": (_rough_pressure(), 1e-7, GEL),
}


@pytest.mark.parametrize("name", HARD_CASES)
def test_hard_cases_converge_without_nan(name: str) -> None:
    limit, target, gel = HARD_CASES[name]
    solved = _slide(limit, target, traction.make_compliance(gel, 2 * N, SPACING))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(solved))
    assert solved.converged
    assert np.all(np.abs(solved.traction_mpa) <= limit * (1 + 1e-5))
