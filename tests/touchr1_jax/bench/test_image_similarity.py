"""SSIM against scikit-image, LPIPS with made-up weights against one layer by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.bench.image_similarity import CHANNELS, CONVOLUTIONS, KERNELS, check_weights, lpips, ssim

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
    found = ssim(np.stack([a, b, a]), np.stack([b, a, a]))
    np.testing.assert_allclose(found, [GOLDEN[pair], GOLDEN[pair], 1], atol=1e-6, rtol=0)
    np.testing.assert_allclose(ssim(a.astype(np.float32), b.astype(np.float32)), GOLDEN[pair], atol=1e-6, rtol=0)


def test_bad_images_are_refused():
    with pytest.raises(ValueError, match=r"shapes are \(12, 12, 3\) and \(12, 13, 3\): they must be equal"):
        ssim(np.zeros((12, 12, 3)), np.zeros((12, 13, 3)))
    with pytest.raises(ValueError, match="images are 10×12 px: must be ≥ 11"):
        ssim(np.zeros((10, 12, 3)), np.zeros((10, 12, 3)))


def lpips_weights(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    weights = {}
    for i, ((number, *_), kernel) in enumerate(zip(CONVOLUTIONS, KERNELS, strict=True)):
        shape = (CHANNELS[i + 1], CHANNELS[i], kernel, kernel)
        weights[f"features.{number}.weight"] = rng.normal(0, (CHANNELS[i] * kernel**2) ** -0.5, shape).astype(
            np.float32
        )
        weights[f"features.{number}.bias"] = np.zeros(CHANNELS[i + 1], np.float32)
        weights[f"lin{i}.model.1.weight"] = rng.random((1, CHANNELS[i + 1], 1, 1)).astype(np.float32)
    return weights


@pytest.fixture(scope="module")
def images():
    return jnp.asarray(np.random.default_rng(1).random((2, 2, 63, 63, 3)), jnp.float32)


@pytest.mark.long
def test_lpips_is_a_symmetric_distance(images):
    weights, (a, b) = lpips_weights(), images
    run = jax.jit(lambda x, y: lpips(x, y, weights))
    np.testing.assert_array_equal(run(a, a), [0, 0])
    np.testing.assert_allclose(run(a, b), run(b, a), rtol=1e-6)
    assert (run(a, b) > 0).all()
    np.testing.assert_allclose(run(a, 0.9 * a + 0.1 * b), run(0.9 * a + 0.1 * b, a), rtol=1e-5)


def test_the_first_layer_of_lpips_by_hand(images):
    """All heads but the first are zero, and the first layer is a single filter of its middle pixel's red."""
    weights = {name: np.zeros_like(x) for name, x in lpips_weights().items()}
    weights["features.0.weight"][0, 0, 2, 2] = 1.0  # padding of 2: the first window's pixel (0, 0)
    weights["features.0.weight"][1, 1, 2, 2] = 1.0
    weights["lin0.model.1.weight"][0, :2] = 1.0
    a, b = (np.asarray(x, np.float64) for x in images)
    red, green = (
        (lambda x, i=i, m=m, s=s: np.maximum((2 * x[:, ::4, ::4, i] - 1 - m) / s, 0))
        for i, m, s in ((0, -0.030, 0.458), (1, -0.088, 0.448))
    )
    size = 15  # (63 + 4 − 11) / 4 + 1

    def unit(x):
        pair = np.stack([red(x), green(x)], -1)[:, :size, :size]
        return pair / (np.sqrt((pair**2).sum(-1, keepdims=True)) + 1e-10)

    expected = ((unit(a) - unit(b)) ** 2).sum(-1).mean((1, 2))
    np.testing.assert_allclose(jax.jit(lambda x, y: lpips(x, y, weights))(*images), expected, rtol=1e-5)


def test_lpips_weights_of_another_network_are_refused():
    weights = lpips_weights()
    check_weights(weights)
    wrong = {**weights, "features.3.weight": weights["features.3.weight"][:, :3]}
    with pytest.raises(ValueError, match=r"weights\['features.3.weight'\] has shape \(192, 3, 5, 5\): must be"):
        check_weights(wrong)
    with pytest.raises(ValueError, match=r"weights\['lin4.model.1.weight'\] has shape None"):
        check_weights({name: x for name, x in weights.items() if name != "lin4.model.1.weight"})
