"""Integration by closed forms and by the sparse least-squares problem that it stands for."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import linalg

from sensors_io.fields.poisson import dirichlet, neumann
from tests.sensors_io.checks import refused

PITCH = 0.0634


def test_it_solves_the_least_squares_problem() -> None:
    """Random slopes, which no surface has, tell the boundary condition from every other."""
    rng = np.random.default_rng(0)
    h, w = 7, 9
    g_x, g_y = rng.standard_normal((2, h, w))
    step = lambda n: sparse.diags([-np.ones(n), np.ones(n)], [0, 1], (n - 1, n))
    rows = sparse.vstack([sparse.kron(sparse.eye(h), step(w)), sparse.kron(step(h), sparse.eye(w))])
    right = np.concatenate([(g_x[:, 1:] + g_x[:, :-1]).ravel(), (g_y[1:] + g_y[:-1]).ravel()]) / 2 * PITCH
    wanted = linalg.lsqr(rows, right, atol=1e-14, btol=1e-14)[0].reshape(h, w)
    np.testing.assert_allclose(neumann(g_x, g_y, PITCH), wanted - wanted.mean(), atol=1e-10)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_plane_is_exact_and_its_mean_is_zero(kind: type) -> None:
    found = neumann(np.full((20, 30), 0.2, kind), np.full((20, 30), -0.1, kind), 0.5)
    y, x = np.mgrid[:20, :30]
    np.testing.assert_allclose(found, 0.1 * (x - 14.5) - 0.05 * (y - 9.5), atol=1e-10 if kind is np.float64 else 1e-5)
    assert found.dtype == kind
    refused(ValueError, "must be one shape", neumann, np.zeros((8, 8)), np.zeros((8, 9)), 1.0)


def test_a_fixed_border_gives_zero_there_and_the_bump_inside() -> None:
    y, x = (np.mgrid[:240, :320] - np.array([120, 160])[:, None, None]) * PITCH
    z = 0.5 * np.exp(-(x**2 + y**2) / (2 * 1.5**2))
    found = dirichlet(-x / 1.5**2 * z, -y / 1.5**2 * z, PITCH)
    assert not np.any([found[0], found[-1]])
    assert not np.any([found[:, 0], found[:, -1]])
    np.testing.assert_allclose(found, z, atol=2e-3)
