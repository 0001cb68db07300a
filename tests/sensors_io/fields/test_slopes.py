"""The polynomial map, by its formula written out."""

import numpy as np
import pytest

from sensors_io.fields.slopes import (
    COLOUR_SCALE,
    ColourMap,
    SlopeReader,
    change,
    colour_powers,
    colour_terms,
    legendre,
    position_terms,
    to_slopes,
)
from tests.sensors_io.checks import refused


def random_map(degree: int, position_degree: int) -> ColourMap:
    rng = np.random.default_rng(degree)
    shape = (len(position_terms(position_degree)), len(colour_terms(degree)), 2)
    return ColourMap(
        weights=(0.1 * rng.standard_normal(shape)).astype(np.float32), degree=degree, position_degree=position_degree
    )


@pytest.mark.parametrize(("degree", "position_degree"), [(1, 0), (2, 2), (3, 1)])
def test_the_reader_is_the_formula(degree: int, position_degree: int) -> None:
    rng = np.random.default_rng(0)
    background, picture = rng.integers(60, 180, (2, 12, 16, 3)).astype(np.uint8)
    colours = random_map(degree, position_degree)
    d = np.stack(change(picture, background)).reshape(3, -1)
    wanted = np.einsum(
        "jn,kn,jkc->cn",
        legendre(12, 16, position_degree).reshape(-1, 12 * 16),
        colour_powers(d, degree),
        colours.weights,
    )
    found = np.stack(SlopeReader(colours, background).normals(picture)).reshape(2, -1)
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_change_is_in_units_of_64_levels_and_signed() -> None:
    background = np.full((12, 16, 3), 100, np.uint8)
    red, green, blue = change(
        np.dstack([background[..., 0] + 64, background[..., 1] - 32, background[..., 2]]), background
    )
    np.testing.assert_allclose([red[5, 5], green[5, 5], blue[5, 5]], [64 / COLOUR_SCALE, -0.5, 0], atol=1e-6)


def test_lower_degrees_are_a_beginning_of_higher_ones() -> None:
    assert colour_terms(3)[:9] == colour_terms(2)
    assert position_terms(4)[:10] == position_terms(3)
    assert (len(colour_terms(3)), len(position_terms(3))) == (19, 10)


def test_normal_to_slope_is_a_tangent_and_is_limited() -> None:
    """A normal of 0.93 at most, which is a slope of 2.53."""
    n = np.array([[0.0, 0.6, -0.6, 3.0]], np.float32)
    slope, other = to_slopes(n, np.zeros_like(n))
    np.testing.assert_allclose(slope, [[0, 0.75, -0.75, 0.93 / np.sqrt(1 - 0.93**2)]], rtol=1e-4)
    assert not other.any()
    alone = to_slopes(np.full((1, 1), 0.97, np.float32), np.zeros((1, 1), np.float32))[0]  # below 1, the only one
    np.testing.assert_allclose(alone, 0.93 / np.sqrt(1 - 0.93**2), rtol=1e-4)


def test_legendre_products_are_orthogonal() -> None:
    places = legendre(200, 300, 2).reshape(6, -1)
    gram = places @ places.T / places.shape[1]
    np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0, atol=1e-4)


def test_what_does_not_fit_is_refused() -> None:
    weights = np.zeros((3, 3, 2), np.float32)
    refused(ValueError, r"must be float32\[3, 9, 2\]", ColourMap, weights=weights, degree=2, position_degree=1)
    refused(ValueError, "must be float32", ColourMap, weights=weights, degree=10**6, position_degree=1)  # at once
    reader = SlopeReader(random_map(1, 0), np.zeros((12, 16, 3), np.uint8))
    refused(ValueError, "must be equal", reader, np.zeros((12, 17, 3), np.uint8))
