"""The parts of the contact solver: the bed of springs, nested grids, the preconditioned step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.layer import Layer, normal_compliance, wave_numbers
from sensors_io.scenes import nested, spg, winkler

N, M, SPACING = 32, 48, 0.5
X = (np.arange(N) + 0.5) * SPACING - N * SPACING / 2
R2 = (X[None] ** 2 + X[:, None] ** 2).astype(np.float32)
GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)

# each operation alone would be compiled
PRESSURE, LOOK, BED = jax.jit(winkler.pressure), jax.jit(winkler.look), jax.jit(winkler.bed_compliance)
CONVOLVE, INVERSE = jax.jit(spg.convolve), jax.jit(spg.inverse_compliance, static_argnums=1)
REFINE, COARSEN = jax.jit(nested.refine), jax.jit(nested.coarsen, static_argnums=1)


def _compliance(points: int, spacing: float = SPACING, gel: Layer = GEL) -> jnp.ndarray:
    return jnp.asarray(normal_compliance(np.hypot(*wave_numbers(points, spacing)), gel), jnp.float32)


def test_springs_carry_the_force_at_one_level() -> None:
    p = PRESSURE(jnp.asarray(R2 / 16), jnp.float32(9.0), jnp.float32(0.1))
    assert float(np.sum(p)) == pytest.approx(9.0, rel=1e-5)
    level = (np.asarray(p) / 0.1 + R2 / 16)[np.asarray(p) > 0]
    np.testing.assert_allclose(level, level.mean(), rtol=1e-3)


def test_springs_under_a_sphere_touch_within_the_closed_form_radius() -> None:
    """F = π K a⁴ / 4R."""
    gel, force, radius = _compliance(M), 2.0, 8.0
    stiffness = 1 / float(BED(gel, SPACING))
    seen = LOOK(jnp.asarray(R2 / (2 * radius)), jnp.float32(force), gel, SPACING)
    assert float(seen.radius_mm) == pytest.approx((4 * radius * force / (np.pi * stiffness)) ** 0.25, rel=0.03)
    assert not seen.at_border
    inside = np.asarray(seen.contact)
    assert float(seen.slope) == pytest.approx(np.sqrt((R2[inside] / radius**2).mean()), rel=0.02)


@pytest.mark.parametrize(
    ("points", "padded", "found"),
    [(128, 216, (4, 2)), (128, 180, (4, 2)), (48, 72, (2,)), (64, 90, (2,)), (24, 36, ()), (64, 65, ())],
)
def test_factors_divide_both_grids_and_leave_enough(points: int, padded: int, found: tuple[int, ...]) -> None:
    assert nested.factors(points, padded) == found


def test_refining_a_plane_is_exact_inside_and_coarsening_undoes_it() -> None:
    plane = X[None] * 0.3 - X[:, None] * 0.1 + 1
    up = np.asarray(REFINE(jnp.asarray(plane, jnp.float32)))
    fine = (np.arange(2 * N) + 0.5) * SPACING / 2 - N * SPACING / 2
    np.testing.assert_allclose(up[2:-2, 2:-2], (fine[None] * 0.3 - fine[:, None] * 0.1 + 1)[2:-2, 2:-2], atol=1e-5)
    np.testing.assert_allclose(np.asarray(COARSEN(jnp.asarray(up), 2))[1:-1, 1:-1], plane[1:-1, 1:-1], atol=1e-5)


@pytest.mark.parametrize("shape", [(N, N), (3, N, N)])
@pytest.mark.parametrize("padded", [M, M + 1, N])
def test_convolution_equals_two_full_transforms(shape: tuple[int, ...], padded: int) -> None:
    field = np.random.default_rng(0).random(shape)
    spectrum = np.asarray(_compliance(padded), np.float64)
    full = np.fft.irfft2(np.fft.rfft2(field, s=(padded, padded)) * spectrum, s=(padded, padded))[..., :N, :N]
    found = CONVOLVE(jnp.asarray(field, jnp.float32), jnp.asarray(spectrum, jnp.float32))
    np.testing.assert_allclose(found, full, rtol=1e-4, atol=1e-5 * np.abs(full).max())


@pytest.mark.parametrize("poisson", [0.3, 0.48, 0.5])
def test_the_preconditioner_is_near_the_inverse_and_positive(poisson: float) -> None:
    gel = Layer(modulus_mpa=0.3, poisson=poisson, thickness_mm=4.0)
    inverse = np.asarray(INVERSE(_compliance(M, gel=gel), N))
    assert np.all(np.isfinite(inverse))
    assert np.all(inverse > 0)
    product = inverse * np.asarray(_compliance(N, gel=gel))
    np.testing.assert_allclose(product[2:-2, 2:], 1, atol=0.12)  # all but the longest waves
