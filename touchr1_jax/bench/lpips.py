"""Learned perceptual similarity (Zhang et al. 2018, LPIPS v0.1 on AlexNet), by weights that the user brings.

No weights come with this code.  They are an `.npz` of the arrays of torchvision's AlexNet,
`features.{0,3,6,8,10}.weight` and `.bias`, and of the published linear heads, `lin{0..4}.model.1.weight`.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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


def check_weights(weights: Mapping[str, np.ndarray]) -> None:
    """Hold the weights to the published shapes.

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
