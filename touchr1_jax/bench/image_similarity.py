"""Similarity of images: structural (SSIM) and learned (LPIPS).

SSIM: Wang, Bovik, Sheikh and Simoncelli, IEEE TIP 13, 600 (2004).  LPIPS: Zhang et al. (2018), v0.1 on AlexNet.  The
weights of LPIPS are not part of this code; the user brings them as an `.npz` of the arrays of torchvision's AlexNet,
`features.{0,3,6,8,10}.weight` and `.bias`, and of the published linear heads, `lin{0..4}.model.1.weight`.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

SIGMA_PX = 1.5
RADIUS_PX = 5  # of the 11 × 11 window
K1, K2 = 0.01, 0.03

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of the published ScalingLayer, for pixels in [−1, 1]
TINY = 1e-10  # the published floor of a feature's length

CONVOLUTIONS: tuple[tuple[int, int, int, bool], ...] = (
    (0, 4, 2, False),
    (3, 1, 2, True),
    (6, 1, 1, True),
    (8, 1, 1, False),
    (10, 1, 1, False),
)
"""Number in `features`, stride, padding, whether a 3 × 3 maximum of stride 2 stands before it."""

CHANNELS = (3, 64, 192, 384, 256, 256)
KERNELS = (11, 5, 3, 3, 3)


def ssim(
    image: Float[np.ndarray, "*n H W C"],
    other: Float[np.ndarray, "..."],
) -> Float[np.ndarray, "*n"]:
    """Mean structural similarity of image pairs, the published 11 × 11 Gaussian window with σ = 1.5 px.

        SSIM = (2 μ_x μ_y + C₁)(2 σ_xy + C₂) / ((μ_x² + μ_y² + C₁)(σ_x² + σ_y² + C₂)),   C_i = K_i²

    with weighted means, population (co)variances, and the mean over all windows that lie inside the image and over the
    channels.  In float64: σ² is the difference of two squares, which float32 keeps no digits of.

    Args:
      image, other: pixels in [0, 1].

    Raises:
      ValueError: the shapes differ, or an image is smaller than the window.

    Departure: none from `skimage.metrics.structural_similarity(..., gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False)`, which it equals to rounding.
    """
    if image.shape != other.shape:
        raise ValueError(f"shapes are {image.shape} and {other.shape}: they must be equal; resize one")
    side = 2 * RADIUS_PX + 1
    if min(image.shape[-3:-1]) < side:
        raise ValueError(
            f"images are {image.shape[-3]}×{image.shape[-2]} px: must be ≥ {side}, the window; enlarge them"
        )
    x, y = image.astype(np.float64), other.astype(np.float64)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    var_x = _window_mean(x * x) - mean_x**2
    var_y = _window_mean(y * y) - mean_y**2
    cov = _window_mean(x * y) - mean_x * mean_y
    c1, c2 = K1**2, K2**2
    similar = (2 * mean_x * mean_y + c1) * (2 * cov + c2)
    scale = (mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2)
    return np.asarray((similar / scale).mean((-3, -2, -1)))


def _window_mean(x: Float[np.ndarray, "*n H W C"]) -> Float[np.ndarray, "*n C h w"]:
    """Gaussian mean of every window that lies inside the image; one product with a band matrix for each axis."""
    return _windows(x.shape[-3]) @ np.moveaxis(x, -1, -3) @ _windows(x.shape[-2]).T


def _windows(size: int) -> Float[np.ndarray, "inside size"]:
    """One normalised Gaussian window in each row."""
    offset = np.arange(size) - np.arange(RADIUS_PX, size - RADIUS_PX)[:, None]
    rows = np.where(np.abs(offset) <= RADIUS_PX, np.exp(-0.5 * (offset / SIGMA_PX) ** 2), 0.0)
    return rows / rows.sum(1, keepdims=True)


def check_weights(weights: Mapping[str, np.ndarray]) -> None:
    """Check the weights against the published shapes.

    Raises:
      ValueError: naming the array, its shape and the one that it must have.
    """
    for i, ((number, *_), kernel) in enumerate(zip(CONVOLUTIONS, KERNELS, strict=True)):
        shapes = {
            f"features.{number}.weight": (CHANNELS[i + 1], CHANNELS[i], kernel, kernel),
            f"features.{number}.bias": (CHANNELS[i + 1],),
            f"lin{i}.model.1.weight": (1, CHANNELS[i + 1], 1, 1),
        }
        for name, shape in shapes.items():
            found = weights[name].shape if name in weights else None
            if found != shape:
                raise ValueError(f"weights[{name!r}] has shape {found}: must be {shape}; export LPIPS v0.1 on AlexNet")


def lpips(
    image: Float[Array, "n H W 3"], other: Float[Array, "n H W 3"], weights: Mapping[str, np.ndarray]
) -> Float[Array, "n"]:
    """Σ_l mean_hw w_l · (φ̂_l(x) − φ̂_l(y))², φ̂ the AlexNet features of layer l, each pixel's scaled to length 1.

    Args:
      image, other: pixels in [0, 1], at least 63 px a side.
      weights: see the module.
    """
    distance = jnp.zeros(image.shape[0])
    for i, (a, b) in enumerate(zip(_features(image, weights), _features(other, weights), strict=True)):
        head = jnp.asarray(weights[f"lin{i}.model.1.weight"])[0, :, 0, 0]
        distance += ((_unit(a) - _unit(b)) ** 2 @ head).mean((1, 2))
    return distance


def _features(image: Float[Array, "n H W 3"], weights: Mapping[str, np.ndarray]) -> list[Float[Array, "n h w c"]]:
    x = (2 * image - 1 - jnp.array(SHIFT)) / jnp.array(SCALE)
    layers = []
    for number, stride, padding, pooled in CONVOLUTIONS:
        if pooled:
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "VALID")
        kernel, bias = (jnp.asarray(weights[f"features.{number}.{part}"]) for part in ("weight", "bias"))
        pads = ((padding, padding),) * 2
        x = jax.lax.conv_general_dilated(x, kernel, (stride, stride), pads, dimension_numbers=("NHWC", "OIHW", "NHWC"))
        x = jax.nn.relu(x + bias)
        layers.append(x)
    return layers


def _unit(x: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
    return x / (jnp.sqrt(jnp.sum(x**2, -1, keepdims=True)) + TINY)
