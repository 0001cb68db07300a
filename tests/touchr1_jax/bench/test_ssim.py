"""SSIM against scikit-image, and its properties."""

import importlib.util

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchr1_jax.bench.ssim import ssim

GOLDEN = {
    ("plain", "noisy"): 0.6082879197597487,
    ("plain", "flat"): 0.9234341623491703,
    ("noisy", "flat"): 0.537241459075141,
}
"""`structural_similarity(a, b, channel_axis=-1, data_range=1.0, gaussian_weights=True, sigma=1.5,
use_sample_covariance=False)` of scikit-image 0.26 on `pictures()`."""


def pictures() -> dict[str, np.ndarray]:
    """Waves, a product and an edge in three channels; the same with noise; the same with less contrast."""
    y, x = np.mgrid[0:24, 0:31] / 31.0
    plain = np.stack([0.5 + 0.4 * np.sin(9 * x + 4 * y), x * y, 0.2 + 0.6 * (x > 0.5)], -1)
    noise = np.sin(np.arange(plain.size) * 12.9898).reshape(plain.shape)
    return {"plain": plain, "noisy": np.clip(plain + 0.08 * noise, 0, 1), "flat": np.clip(0.7 * plain + 0.1, 0, 1)}


@pytest.mark.parametrize("pair", GOLDEN)
def test_equals_scikit_image(pair):
    shown = pictures()
    a, b = (shown[name] for name in pair)
    np.testing.assert_allclose(ssim(a, b), GOLDEN[pair], atol=1e-6, rtol=0)
    np.testing.assert_allclose(ssim(a.astype(np.float32), b.astype(np.float32)), GOLDEN[pair], atol=1e-6, rtol=0)


@pytest.mark.skipif(importlib.util.find_spec("skimage") is None, reason="scikit-image is not installed")
def test_golden_values_are_those_of_this_scikit_image():
    from skimage.metrics import structural_similarity

    shown = pictures()
    options = {"channel_axis": -1, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5}
    for (a, b), golden in GOLDEN.items():
        found = structural_similarity(shown[a], shown[b], use_sample_covariance=False, **options)
        np.testing.assert_allclose(found, golden, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_it_is_symmetric_at_most_one_and_one_for_equals(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.random((2, 3, 12, 15, 3))
    assert ssim(a, b).shape == (3,)
    np.testing.assert_allclose(ssim(a, b), ssim(b, a), rtol=1e-12)
    np.testing.assert_allclose(ssim(a, a), 1.0, rtol=1e-12)
    assert (ssim(a, b) < 1).all()


def test_constant_images_by_hand():
    """No variance: (2 μν + C₁)/(μ² + ν² + C₁)."""
    a, b = np.full((11, 11, 1), 0.2), np.full((11, 11, 1), 0.6)
    np.testing.assert_allclose(ssim(a, b), (0.24 + 1e-4) / (0.4 + 1e-4), rtol=1e-9)
    np.testing.assert_allclose(ssim(255 * a, 255 * b, data_range=255.0), ssim(a, b), rtol=1e-9)


def test_bad_images_are_refused():
    with pytest.raises(ValueError, match=r"shapes are \(12, 12, 3\) and \(12, 13, 3\): they must be equal"):
        ssim(np.zeros((12, 12, 3)), np.zeros((12, 13, 3)))
    with pytest.raises(ValueError, match="images are 10×12 px: must be ≥ 11"):
        ssim(np.zeros((10, 12, 3)), np.zeros((10, 12, 3)))
