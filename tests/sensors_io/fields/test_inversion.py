"""The compliance matrix against the scenes' spectra, the inversion against loads that are known."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.fields.compliance import NodeGrid, compliance_matrix, total_force, total_moment
from sensors_io.fields.helmholtz import decompose, shear_matrix
from sensors_io.fields.inversion import InverseConfig, LayerInverse
from sensors_io.fields.shear import ShearReader
from sensors_io.layer import Layer
from sensors_io.scenes.traction import displacement, make_response
from tests.sensors_io.checks import refused

GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=3.5)
SIDE, PITCH = 16, 1.0
GRID = NodeGrid(shape=(SIDE, SIDE), pitch_mm=(PITCH, PITCH), marker_depth_mm=0.3, depth_mm=0.3)
CONFIG = InverseConfig(lateral_noise_mm=0.008, depth_noise_mm=0.015)
NOISE_MM = np.array([0.008, 0.008, 0.015])


def load(centre=(7.0, 8.0), radius=4.0):
    """A Hertzian pressure and a traction of 0.4 of it along x, 0.2 against y; [h, w, 3] on the gel, MPa."""
    y, x = np.mgrid[:SIDE, :SIDE] * PITCH
    pressure = 0.15 * np.sqrt(np.maximum(1 - ((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / radius**2, 0))
    return np.stack([0.4 * pressure, -0.2 * pressure, -pressure], -1)


def rms(field):
    return np.sqrt((field**2).sum(-1).mean())


def moved(traction, depth_mm=0.3):
    """The scenes' own displacement of the marker plane [h, w, 3]."""
    response = make_response(GEL, 96, PITCH, depth_mm)
    along, depth = displacement(
        jnp.asarray(-traction[..., 2]), jnp.asarray(traction[..., 0] + 1j * traction[..., 1]), response
    )
    return np.stack([along.real, along.imag, depth], -1).astype(np.float64)


@pytest.fixture(scope="module")
def inverse():
    return LayerInverse(GEL, GRID, CONFIG)


@pytest.fixture(scope="module")
def noisy():
    return moved(load()) + NOISE_MM * np.random.default_rng(0).standard_normal((SIDE, SIDE, 3))


def test_the_matrix_is_the_scenes_response():
    stacked = np.concatenate([part.ravel() for part in np.moveaxis(load() * [1, 1, -1], -1, 0)])  # (τ_x, τ_y, p)
    found = (compliance_matrix(GEL, GRID) @ stacked).reshape(3, SIDE, SIDE)
    np.testing.assert_allclose(np.moveaxis(found, 0, -1), moved(load()), atol=5e-4)


def test_the_matrix_is_symmetric_at_the_surface():
    """Maxwell and Betti: what a force here does there, it does there here; u_z and p point into the gel."""
    surface = NodeGrid(shape=(6, 8), pitch_mm=(1.0, 0.7), marker_depth_mm=0.0, depth_mm=0.0)
    matrix = compliance_matrix(GEL, surface)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())


def test_pressing_nodes_alone_carry_the_load(inverse, noisy):
    found = inverse.contact(noisy[..., :2], noisy[..., 2])
    true = total_force(load(), GRID.pitch_mm)
    np.testing.assert_allclose(total_force(found.traction_mpa, GRID.pitch_mm), true, atol=0.06 * abs(true[2]))
    assert np.all(found.traction_mpa[..., 2] <= 0)
    assert np.all(found.traction_mpa[0] == 0)
    anywhere = inverse.contact(noisy[..., :2], noisy[..., 2], np.ones((SIDE, SIDE), bool)).traction_mpa
    assert not anywhere[anywhere[..., 2] == 0].any()


def test_shear_is_what_the_traction_makes(inverse, noisy):
    traction = load() * [1, 1, 0]
    true = moved(traction)[..., :2]
    found = inverse.contact(noisy[..., :2], noisy[..., 2])
    assert rms(found.by_traction_mm - true) < 0.06 * rms(true)
    assert rms(noisy[..., :2] - found.by_pressure_mm - true) < 0.013
    linear = inverse.linear(noisy[..., :2], noisy[..., 2])
    assert rms(found.by_traction_mm - true) < rms(linear.by_traction_mm - true)


def test_a_tenth_of_the_displacement_is_a_tenth_of_the_load(inverse, noisy):
    found, tenth = (inverse.contact(scale * noisy[..., :2], scale * noisy[..., 2]) for scale in (1.0, 0.1))
    np.testing.assert_allclose(10 * tenth.traction_mpa, found.traction_mpa, atol=1e-5)


def test_where_every_node_presses_the_solution_is_the_linear_one(inverse):
    seen = moved(np.full((SIDE, SIDE, 3), [0.0, 0.0, -0.1]))
    linear = inverse.linear(seen[..., :2], seen[..., 2])
    assert np.all(linear.traction_mpa[..., 2] < 0)
    found = inverse.contact(seen[..., :2], seen[..., 2], np.ones((SIDE, SIDE), bool))
    np.testing.assert_allclose(found.traction_mpa, linear.traction_mpa, atol=1e-4)


def test_half_of_every_length_is_the_same_load(noisy):
    half = LayerInverse(
        dataclasses.replace(GEL, thickness_mm=GEL.thickness_mm / 2),
        NodeGrid(shape=(8, 9), pitch_mm=(0.5, 0.4), marker_depth_mm=0.15, depth_mm=0.15),
        InverseConfig(lateral_noise_mm=0.004, depth_noise_mm=0.0075, smooth_mm=CONFIG.smooth_mm / 2),
    )
    whole = LayerInverse(GEL, dataclasses.replace(GRID, shape=(8, 9), pitch_mm=(1.0, 0.8)), CONFIG)
    part = noisy[:8, :9]
    found, expected = half.linear(part[..., :2] / 2, part[..., 2] / 2), whole.linear(part[..., :2], part[..., 2])
    np.testing.assert_allclose(found.traction_mpa, expected.traction_mpa, atol=1e-4)


def test_without_gradients_a_wrong_layer_makes_no_traction(noisy):
    """A gel taken for thinner, and for harder to compress, than it is."""
    wrong = Layer(modulus_mpa=0.3, poisson=0.495, thickness_mm=3.5 / 1.3)
    true = moved(load() * [1, 1, 0])[..., :2]
    error = {}
    for free in (True, False):
        inverse = LayerInverse(wrong, GRID, dataclasses.replace(CONFIG, gradient_free=free))
        error[free] = rms(inverse.contact(noisy[..., :2], noisy[..., 2]).by_traction_mm - true)
    assert error[True] < 0.5 * error[False]


def test_the_shear_matrix_is_the_decomposition():
    field = np.random.default_rng(4).normal(size=(5, 6, 2))
    flat = np.moveaxis(field, -1, 0).ravel()
    found = np.moveaxis((shear_matrix((5, 6), (1.0, 0.8)) @ flat).reshape(2, 5, 6), 0, -1)
    np.testing.assert_allclose(found, decompose(field, (1.0, 0.8)).shear, atol=1e-12)


def test_nothing_touches_nothing_acts(inverse):
    found = inverse.contact(np.zeros((SIDE, SIDE, 2)), np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE), bool))
    assert not found.traction_mpa.any()


def test_loads_without_smoothness_know_nothing_of_each_other(noisy):
    """ℓ of 0 is its limit."""
    grid, part = dataclasses.replace(GRID, shape=(6, 8)), noisy[:6, :8]
    none, least = (LayerInverse(GEL, grid, dataclasses.replace(CONFIG, smooth_mm=mm)) for mm in (0.0, 1e-3))
    found, expected = (x.linear(part[..., :2], part[..., 2]).traction_mpa for x in (none, least))
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.long
def test_magnification_is_undone(noisy):
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    seen = noisy[..., :2] + noisy[..., 2:] / 25.0 * np.stack([x, y], -1)
    plain = ShearReader(GEL, GRID, CONFIG).read(noisy[..., :2], noisy[..., 2])
    undone = ShearReader(GEL, GRID, CONFIG, camera_mm=25.0).read(seen, noisy[..., 2])
    np.testing.assert_allclose(undone.shear_mm, plain.shear_mm, atol=1e-5)


def test_totals_by_hand():
    """1 MPa on one node of 2 mm × 3 mm, at x = 2 mm, y = −3 mm from the centre: 6 N."""
    field = np.zeros((3, 3, 3))
    field[0, 2] = [1.0, 0.5, -2.0]
    np.testing.assert_allclose(total_force(field, (2.0, 3.0)), [6, 3, -12])
    # r × f = (y f_z, −x f_z, x f_y − y f_x)
    np.testing.assert_allclose(total_moment(field, (2.0, 3.0)), [36, 24, 2 * 3 + 3 * 6])


def test_bad_input_is_named(inverse):
    refused(ValueError, r"must be \[16, 16, 2\]", lambda: inverse.linear(np.zeros((8, 8, 2)), np.zeros((8, 8))))
    with pytest.raises(ValueError, match="fill unread nodes"):
        inverse.linear(np.full((SIDE, SIDE, 2), np.nan), np.zeros((SIDE, SIDE)))
    refused(ValueError, "lateral_noise_mm is 0", InverseConfig, lateral_noise_mm=0)
    with pytest.raises(ValueError, match="depth_mm is 9"):
        LayerInverse(GEL, NodeGrid(shape=(4, 4), pitch_mm=(1, 1), marker_depth_mm=9.0, depth_mm=0.0))
    refused(ValueError, "camera_mm is 0", ShearReader, GEL, GRID, camera_mm=0.0)
