"""The bonded layer: two independent solutions agree, limits are those of the literature."""

import dataclasses

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors_io.layer import Layer, depth_response, normal_compliance, shear_compliance
from tests.sensors_io.checks import refused

GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
Q = np.geomspace(1e-3, 50, 60)

layers = st.builds(
    Layer, modulus_mpa=st.floats(0.01, 10), poisson=st.floats(0.0, 0.499), thickness_mm=st.floats(0.3, 30)
)


def _literal(q: np.ndarray, layer: Layer) -> np.ndarray:
    kappa, s = 3 - 4 * layer.poisson, q * layer.thickness_mm
    ratio = (kappa * np.sinh(2 * s) - 2 * s) / (kappa * np.cosh(2 * s) + 2 * s**2 + (1 + kappa**2) / 2)
    return (1 - layer.poisson) / (layer.shear_modulus_mpa * q) * ratio


@settings(max_examples=40, deadline=None)
@given(layer=layers)
def test_closed_forms_are_the_literal_formula_and_the_boundary_value_problem(layer: Layer) -> None:
    q = np.geomspace(0.1, 50, 20) / layer.thickness_mm
    response = depth_response(q, layer, 0.0)
    np.testing.assert_allclose(normal_compliance(q, layer), _literal(q, layer), rtol=1e-9)
    np.testing.assert_allclose(response.normal_pressure, _literal(q, layer), rtol=1e-9)
    np.testing.assert_allclose(response.transverse, shear_compliance(q, layer), rtol=1e-12)


@settings(max_examples=40, deadline=None)
@given(layer=layers)
def test_reciprocity(layer: Layer) -> None:
    response = depth_response(Q, layer, 0.0)
    scale = np.abs(response.normal_shear).max()
    np.testing.assert_allclose(response.lateral_pressure, response.normal_shear, atol=1e-10 * scale, rtol=0)


def test_long_waves_compress_the_layer_uniformly() -> None:
    mu, nu, h = GEL.shear_modulus_mpa, GEL.poisson, GEL.thickness_mm
    expected = h * (1 - 2 * nu) / (2 * mu * (1 - nu))
    np.testing.assert_allclose(normal_compliance(np.array([0.0, 1e-9, 1e-6]), GEL), expected, rtol=1e-9)
    at_zero = depth_response(np.zeros(1), GEL, 1.0)
    np.testing.assert_allclose(at_zero.normal_pressure, expected * (h - 1) / h)
    np.testing.assert_allclose(at_zero.lateral_shear, (h - 1) / mu)


def test_no_overflow_in_float32_range() -> None:
    q = np.array([0.0, 1e-12, 44 / 4, 200.0, 1e6])
    assert np.all(np.isfinite(normal_compliance(q, GEL).astype(np.float32)))
    for field in vars(depth_response(q, GEL, 0.5)).values():
        assert np.all(np.isfinite(field))


def test_the_base_is_bonded() -> None:
    for field in vars(depth_response(Q, GEL, GEL.thickness_mm)).values():
        np.testing.assert_allclose(field, 0, atol=1e-9)


def test_impossible_layers_and_markers_outside_are_refused() -> None:
    refused(ValueError, "modulus_mpa", dataclasses.replace, GEL, modulus_mpa=0.0)
    refused(ValueError, "poisson", dataclasses.replace, GEL, poisson=0.51)
    refused(ValueError, "thickness_mm", dataclasses.replace, GEL, thickness_mm=-1.0)
    refused(ValueError, r"depth_mm is 5\.0: must lie in", depth_response, Q, GEL, 5.0)
