"""Renderers: patterns move as the gel does, light answers to slope, nothing leaves its range."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.scenes import optics
from tests.sensors_io.scenes.references import deformed, light

PX, WINDOW_MM = 80, 16.0
X = (np.arange(PX) + 0.5) * WINDOW_MM / PX - WINDOW_MM / 2
ZERO = np.zeros((PX, PX))


def _gel(depth=ZERO, x=ZERO, y=ZERO, marker_depth=ZERO) -> optics.DeformedGel:
    return deformed(WINDOW_MM, depth, x, y, marker_depth)


def _light(shift: tuple[float, float] = (0.0, 0.0)) -> optics.Light:
    return light(optics.speckle_texture(np.random.default_rng(0), 192, 5.0), shift=shift)


DOTS, SPECKLE, EXPOSE = jax.jit(optics.dots), jax.jit(optics.speckle), jax.jit(optics.expose)


@pytest.mark.parametrize("render", [DOTS, SPECKLE])
def test_a_uniform_displacement_moves_the_pattern_along(render) -> None:
    moved = render(_gel(x=ZERO + 0.4, y=ZERO - 0.2), _light())
    np.testing.assert_allclose(moved, render(_gel(), _light((0.4, -0.2))), atol=1e-4)


def test_indentation_magnifies_the_pattern() -> None:
    factor = 1.0 / optics.CAMERA_DISTANCE_MM
    stretched = SPECKLE(_gel(x=factor * X[None] + ZERO, y=factor * X[:, None] + ZERO), _light())
    np.testing.assert_allclose(SPECKLE(_gel(marker_depth=ZERO + 1.0), _light()), stretched, atol=1e-4)


def test_noise_grows_from_read_to_shot_noise_channel_by_channel() -> None:
    image = jnp.broadcast_to(jnp.array([0.0, 0.25, 0.64]), (60, 60, 3)) + 0.1
    noise = jnp.asarray(np.random.default_rng(0).standard_normal((60, 60, 3)), jnp.float32)
    read, shot = (0.02, 0.01, 0.0), (0.0, 0.02, 0.05)
    pixels = np.asarray(EXPOSE(image, noise, read, shot)) / 255
    want = np.array(read) + np.array(shot) * np.sqrt([0.1, 0.35, 0.74])
    np.testing.assert_allclose(pixels.std((0, 1)), want, rtol=0.05)


def test_cubic_matrix_keeps_constants_and_lines() -> None:
    matrix = np.asarray(optics.cubic_matrix(112, 64))
    np.testing.assert_allclose(matrix.sum(1), 1, atol=1e-5)
    line = (np.arange(64) + 0.5) / 64
    np.testing.assert_allclose((matrix @ line)[4:-4], ((np.arange(112) + 0.5) / 112)[4:-4], atol=1e-5)
