"""Sequences: reversal after Mindlin and Deresiewicz, forgetting, equivariance, one scan for all frames."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.layer import Layer
from sensors_io.scenes import drag, traction
from sensors_io.scenes.hertz import Hertz
from sensors_io.scenes.mindlin import half_space

N, M, WINDOW_MM = 40, 80, 16.0
SPACING = WINDOW_MM / N
X = (np.arange(N) + 0.5) * SPACING - WINDOW_MM / 2
GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
FRICTION, SHEAR_MODULUS = 0.5, 0.15


def _pressure(force: float, x: float = 0.0) -> np.ndarray:
    hertz = Hertz(radius_mm=8.0, plane_modulus_mpa=2 * SHEAR_MODULUS, force_n=force)
    p = hertz.pressure_mpa(np.hypot(X[None] - x, X[:, None]))
    return p * force / (p.sum() * SPACING**2)


@functools.cache
def _half_space() -> drag.Bodies:
    compliance = half_space(N, SPACING, 2 * SHEAR_MODULUS)
    return drag.Bodies(compliance=compliance, coupling=None, response=traction.make_response(GEL, M, SPACING, 0.5))


@functools.cache
def _layer() -> drag.Bodies:
    return drag.Bodies(
        compliance=traction.make_compliance(GEL, M, SPACING),
        coupling=traction.make_coupling(GEL, M, SPACING),
        response=traction.make_response(GEL, M, SPACING, 0.5),
    )


@jax.jit
def _run(pressures, slides, twists, bodies, tolerance):
    def one(history, frame):
        pressure, slide, twist = frame
        step = drag.RigidMotion(slide_mm=slide, twist_rad=twist, centre_mm=jnp.zeros(2))
        return drag.advance(history, pressure, FRICTION, step, bodies, jnp.asarray(X, jnp.float32), tolerance, 200)

    return jax.lax.scan(one, drag.at_rest(N), (pressures, slides, twists))[1]


def _frames(pressures, slides: np.ndarray, bodies: drag.Bodies, twists: np.ndarray | None = None, tolerance=1e-4):
    """Slides [F, 2] and twists [F] are absolute; the steps are their differences."""
    f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    turned = np.zeros(len(slides)) if twists is None else twists
    steps = np.diff(slides, axis=0, prepend=0), np.diff(turned, prepend=0)
    return jax.device_get(_run(f32(np.stack(pressures)), f32(steps[0]), f32(steps[1]), bodies, tolerance))


def _mindlin(slide: np.ndarray | float, force: float) -> np.ndarray:
    """Q of the virgin curve, δ = 3μF/(8Ga) [1 − (1 − Q/μF)^⅔] at ν = 0."""
    a = Hertz(radius_mm=8.0, plane_modulus_mpa=2 * SHEAR_MODULUS, force_n=force).contact_radius_mm
    full = 3 * FRICTION * force / (8 * SHEAR_MODULUS * a)
    return FRICTION * force * (1 - (1 - np.minimum(np.asarray(slide) / full, 1)) ** 1.5)


def test_reversal_after_mindlin_and_deresiewicz() -> None:
    """Loading is the virgin curve, and each branch after a reversal is that curve at twice the scale (Masing)."""
    force, top = 2.0, 0.5
    there, back, again = (np.linspace(a, b, 11)[1:] for a, b in ((0, top), (top, -top), (-top, top)))
    slide = np.stack([np.concatenate([[0.0], there, back, again]), np.zeros(31)], 1)
    made = _frames([_pressure(force)] * 31, slide, _half_space())
    q_top = _mindlin(top, force)
    expected = np.concatenate(
        [
            [0.0],
            _mindlin(there, force),
            q_top - 2 * _mindlin((top - back) / 2, force),
            -q_top + 2 * _mindlin((top + again) / 2, force),
        ]
    )
    np.testing.assert_allclose(made.force_n[:, 0], expected, atol=0.015 * q_top)
    assert made.converged.all()
    loop = np.trapezoid(made.force_n[10:, 0], slide[10:, 0])
    assert loop > 0.2 * q_top * top  # friction takes energy


def test_a_long_slide_carries_the_friction_limit_and_turns_round() -> None:
    slide = np.stack([np.concatenate([np.linspace(0, 2, 9), np.linspace(1.75, 0, 8)]), np.zeros(17)], 1)
    made = _frames([_pressure(2.0, x) for x in slide[:, 0]], slide, _layer())
    limit = FRICTION * 2.0
    np.testing.assert_allclose(made.force_n[6:9, 0], limit, rtol=0.01)
    np.testing.assert_allclose(made.force_n[-3:, 0], -limit, rtol=0.01)
    np.testing.assert_allclose(made.force_n[:, 2], -2.0, rtol=1e-4)
    np.testing.assert_allclose(made.force_n[:, 1], 0, atol=5e-3)
    np.testing.assert_allclose(made.moment_nmm[:, 1], 2.0 * slide[:, 0], atol=2e-2)  # −x f_z


def test_what_lets_go_forgets() -> None:
    slide = np.zeros((4, 2))
    slide[1:] = [0.2, 0.0]
    pressures = [_pressure(2.0), _pressure(2.0), np.zeros((N, N)), _pressure(2.0)]
    made = _frames(pressures, slide, _half_space())
    assert made.force_n[1, 0] > 0.1
    np.testing.assert_array_equal(made.traction_mpa[2], 0)
    np.testing.assert_allclose(made.force_n[3, 0], 0, atol=1e-4)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(made))


def test_pressing_harder_keeps_the_pull() -> None:
    """What sticks carries on: the tangential force stays while the contact grows at rest."""
    pressures = [_pressure(f) for f in (2.0, 2.0, 3.0, 4.0)]
    slide = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.0]])
    made = _frames(pressures, slide, _half_space())
    np.testing.assert_allclose(made.force_n[2:, 0], made.force_n[1, 0], rtol=0.05)


def test_x_and_y_are_alike() -> None:
    slide = np.stack([np.linspace(0, 0.4, 4), np.zeros(4)], 1)
    along_x = _frames([_pressure(2.0)] * 4, slide, _layer())
    along_y = _frames([_pressure(2.0)] * 4, slide[:, ::-1], _layer())
    x, y, z = np.moveaxis(along_x.displacement_mm, 1, 0)
    by_swap = np.stack([y, x, z], 1).transpose(0, 1, 3, 2)
    np.testing.assert_allclose(along_y.displacement_mm, by_swap, atol=2e-3 * np.abs(x).max())


def test_a_twist_turns_the_gel_and_slips_at_its_torque() -> None:
    made = _frames([_pressure(2.0)] * 8, np.zeros((8, 2)), _half_space(), np.linspace(0, 6, 8))
    a = Hertz(radius_mm=8.0, plane_modulus_mpa=2 * SHEAR_MODULUS, force_n=2.0).contact_radius_mm
    assert made.moment_nmm[-1, 2] == pytest.approx(3 * np.pi / 16 * FRICTION * 2.0 * a, rel=0.03)
    assert np.all(np.diff(made.moment_nmm[:, 2]) > -1e-3)
    np.testing.assert_allclose(made.force_n[:, :2], 0, atol=1e-3)
