"""Noise from a counter: its moments, its independence, and that keys part streams."""

import jax
import numpy as np
import pytest

from sensors_io.scenes import noise

SHAPE = (512, 512)


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """Eight frames of one key and eight of another, [16, 512, 512]."""
    draw = jax.jit(lambda key, i: noise.normal(noise.fold(key, i), SHAPE))
    return np.stack([draw(noise.key(np.random.default_rng(s)), i) for s in range(2) for i in range(8)])


def test_moments_are_those_of_the_docstring(frames):
    x = frames.astype(np.float64).ravel()
    assert abs(x.mean()) < 4 / np.sqrt(x.size)
    assert x.var() == pytest.approx(1, abs=5 * np.sqrt(2 / x.size))
    assert abs((x**3).mean()) < 5 * np.sqrt(15 / x.size)
    assert (x**4).mean() - 3 == pytest.approx(-0.062, abs=5 * np.sqrt(96 / x.size))
    assert np.abs(x).max() <= 5.8


@pytest.mark.parametrize("lag", [(0, 1), (1, 0), (1, 1), (0, 3), (7, 0), (0, 112)])
def test_neighbours_are_independent(frames, lag):
    y, x = lag
    for part in (frames, frames**2 - 1, np.abs(frames) - np.abs(frames).mean()):
        product = part[:, y:, x:] * part[:, : SHAPE[0] - y, : SHAPE[1] - x]
        assert abs(product.mean()) < 5 * part.var() / np.sqrt(product.size)


def test_frames_and_keys_are_independent(frames):
    flat = frames.reshape(16, -1)
    correlation = np.corrcoef(flat) - np.eye(16)
    assert np.abs(correlation).max() < 5 / np.sqrt(flat.shape[1])
    assert np.abs(np.corrcoef(flat**2) - np.eye(16)).max() < 5 / np.sqrt(flat.shape[1])


@pytest.mark.long
def test_uniform_numbers_fill_the_interval():
    x = np.asarray(jax.jit(noise.uniform, static_argnums=1)(noise.key(np.random.default_rng(3)), (200_000,)))
    assert 0 <= x.min() < x.max() < 1
    counts = np.histogram(x, 50, (0, 1))[0]
    assert ((counts - 4000) ** 2 / 4000).sum() < 49 + 5 * np.sqrt(2 * 49)
