"""Presses of a ball under lamps that are known: three directions, fading across the picture."""

import numpy as np
from scipy import ndimage

from sensors_io.calibration.presses import BallPresses, indentation

LAMPS = np.array([[1.0, 0.1, 0.0], [-0.5, 0.9, 0.0], [-0.5, -0.9, 0.0]])  # in-plane direction of each channel's lamp
GREY = 110.0
BLUR_MM = 0.18  # of coating and lens


def press_ball(
    touches: np.ndarray,
    radius_mm: float = 3.0,
    mm_per_px: float = 0.15,
    shape: tuple[int, int] = (80, 106),
    blur_mm: float = BLUR_MM,
) -> BallPresses:
    """Pictures of touches [P, 3] in px: I = GREY (1 + fade lamp·n), blurred, and noise of one level."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    fade = 1 + 0.3 * (x / shape[1] - 0.5)[..., None] * np.array([1.0, -0.5, -0.5])
    pictures = []
    for at_x, at_y, contact in touches:
        _, d_x, d_y = indentation((x - at_x) * mm_per_px, (y - at_y) * mm_per_px, contact * mm_per_px, radius_mm)
        up = 1 / np.sqrt(1 + d_x**2 + d_y**2)
        shade = 0.8 * fade * (LAMPS[:, 0] * (d_x * up)[..., None] + LAMPS[:, 1] * (d_y * up)[..., None])
        shade = ndimage.gaussian_filter(shade, (blur_mm / mm_per_px, blur_mm / mm_per_px, 0))
        pictures.append(GREY * (1 + shade) + rng.standard_normal((*shape, 3)))
    background = np.full((*shape, 3), GREY)
    to_bytes = lambda image: np.clip(image, 0, 255).round().astype(np.uint8)
    return BallPresses(
        pictures=to_bytes(np.stack(pictures)), background=to_bytes(background), radius_mm=radius_mm, mm_per_px=mm_per_px
    )


def spread_touches(count: int, seed: int = 1, shape: tuple[int, int] = (80, 106)) -> np.ndarray:
    """Touches [P, 3] all over the picture, contacts of 0.45 to 0.6 ball radii (9 to 12 px)."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(18, shape[1] - 18, count), rng.uniform(18, shape[0] - 18, count)
    return np.stack([x, y, rng.uniform(9, 12, count)], -1)
