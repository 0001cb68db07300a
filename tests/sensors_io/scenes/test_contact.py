"""The contact solver against closed forms, against a float64 reference by another method, and where it may fail."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.layer import Layer, normal_compliance, wave_numbers
from sensors_io.scenes import contact, spg
from sensors_io.scenes.hertz import Hertz, half_space_spectrum
from sensors_io.scenes.objects import rough_waves
from sensors_io.scenes.reference import convolve, solve_reference
from tests.sensors_io.checks import refused
from tests.sensors_io.scenes.references import off

N, M, WINDOW_MM = 48, 72, 16.0
SPACING = WINDOW_MM / N
X = (np.arange(N) + 0.5) * SPACING - WINDOW_MM / 2
R2 = X[None] ** 2 + X[:, None] ** 2
GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
BODY = Layer(modulus_mpa=1.0, poisson=0.4, thickness_mm=20.0)


def _spectrum(layer: Layer, points: int = M, spacing: float = SPACING) -> np.ndarray:
    return normal_compliance(np.hypot(*wave_numbers(points, spacing)), layer)


def _rough(rms_mm: float, seed: int = 0) -> np.ndarray:
    k, a, phase = rough_waves(np.random.default_rng(seed), rms_mm, 2.5 * SPACING)
    angle = k[:, 0, None, None] * X[None] + k[:, 1, None, None] * X[:, None] + phase[:, None, None]
    return np.sum(a[:, None, None] * np.cos(angle), 0)


def _dots(pitch: float = 4.0) -> np.ndarray:
    f = X / pitch - np.round(X / pitch)
    return 1 - np.exp(-(f[None] ** 2 + f[:, None] ** 2) / 0.08) + R2 / 80


def _solve(gap: np.ndarray, force: float, gel: np.ndarray, body: np.ndarray | float = 0.0, **kwargs) -> contact.Contact:
    gel32 = jnp.asarray(gel, jnp.float32)
    body32 = jnp.broadcast_to(jnp.asarray(body, jnp.float32), gel32.shape)
    return jax.device_get(contact.solve(jnp.asarray(gap, jnp.float32), force, gel32, body32, SPACING, **kwargs))


def _check_finite(solved: contact.Contact) -> None:
    for leaf in jax.tree.leaves(solved):
        assert np.all(np.isfinite(leaf))
    assert np.all(solved.pressure_mpa >= 0)


@functools.cache
def _hertz_presses(points: int = 64, radius: float = 8.0, modulus: float = 0.4) -> list[tuple[Hertz, contact.Contact]]:
    """Spheres whose apex lies on a pixel, with contact radii of 4 to 16 pixels."""
    spacing = WINDOW_MM / points
    x = (np.arange(points) - points // 2) * spacing
    gap = jnp.asarray((x[None] ** 2 + x[:, None] ** 2) / (2 * radius), jnp.float32)
    kernel = jnp.asarray(half_space_spectrum(points, spacing, modulus), jnp.float32)
    presses = []
    for pixels in (4, 6, 8, 12, 16):
        force = 4 * modulus * (pixels * spacing) ** 3 / (3 * radius)
        solved = contact.solve(gap, force, kernel, jnp.zeros_like(kernel), spacing, 1e-5)
        presses.append((Hertz(radius_mm=radius, plane_modulus_mpa=modulus, force_n=force), jax.device_get(solved)))
    return presses


def test_half_space_reproduces_hertz() -> None:
    """Approach, peak, displacement; force grows with depth to the power 3/2."""
    for hertz, solved in _hertz_presses():
        assert solved.converged
        np.testing.assert_allclose(solved.approach_mm, hertz.approach_mm, rtol=0.002)
        np.testing.assert_allclose(solved.pressure_mpa.max(), hertz.peak_pressure_mpa, rtol=0.01)
        points = solved.pressure_mpa.shape[0]
        x = (np.arange(points) - points // 2) * WINDOW_MM / points
        u = hertz.displacement_mm(np.hypot(x[None], x[:, None]))
        np.testing.assert_allclose(solved.displacement_mm, u, atol=0.01 * u.max())
    force, depth = zip(*((h.force_n, float(c.approach_mm)) for h, c in _hertz_presses()), strict=True)
    assert np.polyfit(np.log(depth), np.log(force), 1)[0] == pytest.approx(1.5, abs=0.002)


SCENES = {
    "stiff sphere": (R2 / 16, 1e3, 5.0),
    "soft sphere": (R2 / 16, 0.1, 5.0),
    "rough sphere": (R2 / 30 + _rough(0.05), 20.0, 2.0),
    "soft rough": (R2 / 60 + _rough(0.1, 1), 0.4, 20.0),
    "dots": (_dots(), 5.0, 8.0),
    "flat rough": (_rough(0.02, 2), 1e3, 1.0),
}


def _scene(name: str) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Gap, force, and the compliance of gel and body."""
    gap, modulus, force = SCENES[name]
    return gap, force, _spectrum(GEL), _spectrum(BODY) / modulus


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_the_float64_reference(name: str) -> None:
    gap, force, gel, body = _scene(name)
    reference = solve_reference(gap, force, gel + body, SPACING)
    for tolerance, u_error, p_error in ((1e-3, 2e-3, 0.05), (2e-5, 4e-5, 1e-3)):
        solved = _solve(gap, force, gel, body, tolerance=tolerance)
        assert solved.converged
        assert off(solved.displacement_mm, convolve(reference.pressure_mpa, gel)) < u_error
        assert off(solved.pressure_mpa, reference.pressure_mpa) < p_error
        assert solved.approach_mm == pytest.approx(reference.approach_mm, rel=max(u_error, 1e-4))


def _pin(radius: float = 0.5) -> np.ndarray:
    r = np.sqrt(R2)
    return np.where(r < radius, radius - np.sqrt(np.maximum(radius**2 - R2, 0)), radius + 3 * (r - radius))


HARD_CASES = {
    "few pixels at 1 mN": (R2 / 4, 1e-3, GEL),
    "nearly full contact": (_rough(0.03, 3), 15.0, GEL),
    "full pad": (np.zeros((N, N)), 5.0, GEL),
    "white noise": (0.1 * np.random.default_rng(0).standard_normal((N, N)), 5.0, GEL),
    "nearly incompressible": (R2 / 16, 5.0, dataclasses.replace(GEL, poisson=0.4999)),
    "thin gel": (R2 / 16, 5.0, dataclasses.replace(GEL, thickness_mm=0.3)),
    "tilt": (R2 / 60 + 0.2 * X[None], 5.0, GEL),
    "very soft gel": (R2 / 16, 1.0, dataclasses.replace(GEL, modulus_mpa=0.01)),
    "pin": (_pin(), 5.0, GEL),
}


@pytest.mark.parametrize("name", HARD_CASES)
def test_hard_cases_give_no_nan_and_an_honest_flag(name: str) -> None:
    gap, force, gel = HARD_CASES[name]
    compliance = _spectrum(gel)
    solved = _solve(gap, force, compliance)
    _check_finite(solved)
    p = solved.pressure_mpa.astype(np.float64)
    assert p.sum() * SPACING**2 == pytest.approx(force, rel=1e-4)
    assert bool(solved.converged) == (solved.residual < contact.TOLERANCE)
    assert _residual(p, compliance, gap - gap.min()) == pytest.approx(float(solved.residual), rel=0.05, abs=2e-6)
    u = convolve(solve_reference(gap, force, compliance, SPACING, 1e-8, 20_000).pressure_mpa, compliance)
    assert np.linalg.norm(solved.displacement_mm - u) < 2 * max(solved.residual, 1e-6) * np.linalg.norm(u)


def _residual(p: np.ndarray, compliance: np.ndarray, gap: np.ndarray) -> float:
    """The residual in float64, from its definition."""
    u = convolve(p, compliance)
    g = u + gap - (u + gap)[p > 0].mean()
    uneven = np.sqrt(np.sum(p * g**2) / p.sum())
    return spg.ESTIMATE * (uneven + 0.1 * max(0.0, np.max(-g[p == 0], initial=0))) / (np.sum(p * u) / p.sum())


@pytest.mark.parametrize(
    ("name", "broken"),
    [("pin", "small_strain"), ("thin gel", "small_strain"), ("very soft gel", "small_strain"),
     ("few pixels at 1 mN", "resolved"), ("tilt", None), ("white noise", None), ("full pad", None)],
)  # fmt: skip
def test_what_the_theory_does_not_carry_is_flagged(name: str, broken: str | None) -> None:
    gap, force, gel = HARD_CASES[name]
    judged = _solve(gap, force, _spectrum(gel), thickness_mm=gel.thickness_mm).validity
    kept = {"converged": judged.converged, "small_strain": judged.small_strain, "resolved": judged.resolved}
    assert {n for n, ok in kept.items() if not ok} == ({broken} if broken else set())
    assert bool(judged.all) == (broken is None)


def test_the_cap_clears_converged() -> None:
    solved = _solve(*_scene("soft rough"), max_iterations=2)
    _check_finite(solved)
    assert (bool(solved.converged), solved.iterations) == (False, 2)
    assert solved.residual >= contact.TOLERANCE


def test_the_winkler_tier_says_that_it_is_off() -> None:
    gap, force, *spectra = _scene("rough sphere")
    f32 = [jnp.asarray(a, jnp.float32) for a in (gap, *spectra)]
    rough = jax.device_get(contact.solve_winkler(f32[0], force, *f32[1:], SPACING))
    error = off(rough.displacement_mm, _solve(gap, force, *spectra, tolerance=1e-5).displacement_mm)
    assert rough.tier == contact.Tier.WINKLER
    assert not rough.converged
    assert 0.3 * error < rough.residual < 5 * error


def test_refuses_what_does_not_fit() -> None:
    refused(ValueError, "gap_mm has shape", _solve, np.zeros((48, 40)), 1.0, np.zeros((72, 37)))
    refused(ValueError, "even N", _solve, np.zeros((47, 47)), 1.0, np.zeros((72, 37)))
    refused(ValueError, "gel has shape", _solve, np.zeros((48, 48)), 1.0, np.zeros((72, 36)))
    refused(ValueError, "M ≥ N = 48", _solve, np.zeros((48, 48)), 1.0, np.zeros((40, 21)))
