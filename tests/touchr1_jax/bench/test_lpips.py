"""LPIPS with made-up weights: its shapes, its properties, and one layer by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax.bench.lpips import CHANNELS, CONVOLUTIONS, KERNELS, check_weights, lpips


def made_up(seed: int = 0) -> dict[str, np.ndarray]:
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


def test_it_is_a_symmetric_distance(images):
    weights, (a, b) = made_up(), images
    run = jax.jit(lambda x, y: lpips(x, y, weights))
    np.testing.assert_array_equal(run(a, a), [0, 0])
    np.testing.assert_allclose(run(a, b), run(b, a), rtol=1e-6)
    assert (run(a, b) > 0).all()
    np.testing.assert_allclose(run(a, 0.9 * a + 0.1 * b), run(0.9 * a + 0.1 * b, a), rtol=1e-5)


def test_the_first_layer_by_hand(images):
    """All heads but the first are zero, and the first layer is a single filter of its middle pixel's red."""
    weights = {name: np.zeros_like(x) for name, x in made_up().items()}
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


def test_weights_of_another_network_are_refused():
    weights = made_up()
    check_weights(weights)
    wrong = {**weights, "features.3.weight": weights["features.3.weight"][:, :3]}
    with pytest.raises(ValueError, match=r"weights\['features.3.weight'\] has shape \(192, 3, 5, 5\): must be"):
        check_weights(wrong)
    with pytest.raises(ValueError, match=r"weights\['lin4.model.1.weight'\] has shape None"):
        check_weights({name: x for name, x in weights.items() if name != "lin4.model.1.weight"})
