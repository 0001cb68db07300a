"""Structural similarity of images (Wang, Bovik, Sheikh and Simoncelli, IEEE TIP 13, 600, 2004)."""

import numpy as np
from jaxtyping import Float

SIGMA_PX = 1.5
RADIUS_PX = 5  # of the 11 × 11 window
K1, K2 = 0.01, 0.03


def ssim(
    image: Float[np.ndarray, "*n H W C"], other: Float[np.ndarray, "..."], *, data_range: float = 1.0
) -> Float[np.ndarray, "*n"]:
    """Mean structural similarity of image pairs, the published 11 × 11 Gaussian window with σ = 1.5 px.

        SSIM = (2 μ_x μ_y + C₁)(2 σ_xy + C₂) / ((μ_x² + μ_y² + C₁)(σ_x² + σ_y² + C₂)),   C_i = (K_i R)²

    with weighted means, population (co)variances, and the mean over all windows that lie inside the image and over the
    channels.  In float64: σ² is the difference of two squares, which float32 leaves no digits of.

    Args:
      image, other: the two images.
      data_range: R, largest possible value less the smallest one.

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
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
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
