"""The friction discs: the projection by hand, and the nearest traction that carries a force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.scenes.friction import dot, onto_discs, shift_to_total


def test_projection_and_scalar_product_by_hand() -> None:
    tangential, limit = np.array([[3 + 4j, 0.3 + 0.4j], [0, -2.0]]), np.array([[1.0, 1.0], [1.0, 0.0]])
    np.testing.assert_allclose(onto_discs(tangential, limit), [[0.6 + 0.8j, 0.3 + 0.4j], [0, 0]], rtol=1e-6)
    assert dot(jnp.complex64(1 + 2j), jnp.complex64(3 - 1j)) == 1.0


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.97])
def test_the_shifted_projection_carries_the_force(share: float, scale: float) -> None:
    """From tractions within, about and far past the discs; the nearest one, as any other carrying the force shows."""
    rng = np.random.default_rng(int(10 * scale + 100 * share))
    limit = rng.random((24, 24)) * (rng.random((24, 24)) < 0.5)
    traction = scale * (rng.standard_normal((24, 24)) + 1j * rng.standard_normal((24, 24)) + 0.7)
    total = share * limit.sum() * np.exp(2j)
    shift = jax.jit(shift_to_total)(
        jnp.asarray(traction, jnp.complex64), limit.astype(np.float32), total, jnp.complex64(0)
    )
    nearest = np.asarray(onto_discs(traction + complex(shift), limit))
    assert abs(nearest.sum() - total) < 1e-4 * limit.sum()
    other = limit * share * np.exp(2j)  # admissible, carries the force too
    assert np.sum(((traction - nearest).conj() * (other - nearest)).real) < 1e-3 * np.sum(limit * np.abs(traction))
