"""Pictures of gels, drawn: dots on a shaded skin, a dense pattern, a bare skin under a load."""

import cv2
import numpy as np

SIDE = (160, 200)
_FINE = 8  # subpixels of a drawn dot


def skin(shape: tuple[int, int] = SIDE) -> np.ndarray:
    """Smooth shading, float64 [H, W]."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return 150 + 30 * np.sin(x / shape[1] * 2) - 20 * (y / shape[0]) ** 2


def dots(points: np.ndarray, radius: float = 4.0, contrast: float = 90.0, shape: tuple[int, int] = SIDE) -> np.ndarray:
    """Dark dots with soft edges at (x, y) [P, 2] on the skin, float64 [H, W]."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    away = np.min(np.hypot(x[None] - points[:, 0, None, None], y[None] - points[:, 1, None, None]), 0)
    return skin(shape) - contrast / (1 + np.exp((away - radius) / 0.6))


def lattice(pitch: float = 20.0, shape: tuple[int, int] = SIDE) -> np.ndarray:
    """Points (x, y) [P, 2] a pitch apart."""
    y, x = (np.arange(0.75 * pitch, n - 0.7 * pitch, pitch) for n in shape)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) + 0.3


def speckle(shape: tuple[int, int] = SIDE, seed: int = 0) -> np.ndarray:
    """A dense random pattern, float64 [H, W]."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    band = cv2.GaussianBlur(noise, (0, 0), 1.5) - cv2.GaussianBlur(noise, (0, 0), 3.0)
    return 128 + 60 * np.tanh(1.5 * band / band.std())


def loaded(shape: tuple[int, int] = SIDE) -> np.ndarray:
    """The skin with the shading of a ball on it, float64 [H, W]."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    bell = np.exp(-((x - 100) ** 2 + (y - 80) ** 2) / (2 * 18**2))
    return skin(shape) + 40 * bell * (x - 100) / 18


def exposed(picture: np.ndarray, noise: float = 1.5, seed: int = 0) -> np.ndarray:
    """With camera noise, uint8 [H, W]."""
    noisy = picture + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.round(np.clip(noisy, 0, 255)).astype(np.uint8)


def rgb(grey: np.ndarray) -> np.ndarray:
    """uint8 [H, W] → [H, W, 3]."""
    return np.repeat(grey[..., None], 3, -1)
