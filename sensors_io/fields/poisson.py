"""Slopes to depth: least-squares integration by a fast cosine or sine transform.

The surface z that minimises Σ (z_{i+1} − z_i − g_{i+½})² over all pairs of neighbours solves the discrete Poisson
equation Lz = div g with half-pixel slopes g_{i+½} = (g_i + g_{i+1}) / 2 and, at the border, the natural condition of
this sum: no flux beyond the slopes (Neumann).  The cosine transform of type II diagonalises L, with eigenvalues

    λ_kl = 2 cos(πk/H) − 2 + 2 cos(πl/W) − 2,   k = 0 … H−1, l = 0 … W−1.

Indices 1 … H instead, as in widely copied code, make every mode come out wrong, the longest by a factor of four.
"""

import functools

import numpy as np
from scipy import fft


def neumann(slope_x: np.ndarray, slope_y: np.ndarray, mm_per_px: float) -> np.ndarray:
    """Depth whose slopes are given, up to a constant: its mean is 0.

    Args:
      slope_x, slope_y: ∂z/∂x and ∂z/∂y at the pixels, float [H, W], mm/mm; float32 is computed in float32.
      mm_per_px: pitch.

    Returns:
      z, mm, [H, W] of the type of the slopes.

    Raises:
      ValueError: slopes that are not two arrays of one shape [H, W].

    Source: Simchony, Chellappa & Shao 1990, section III, with the half-pixel slopes of a staggered grid.
    """
    _check(slope_x, slope_y)
    modes = fft.dctn(_divergence(slope_x, slope_y), type=2, norm="ortho", overwrite_x=True)
    modes *= _inverse_eigenvalues(slope_x.shape, slope_x.dtype.char) * slope_x.dtype.type(mm_per_px)
    depth: np.ndarray = fft.idctn(modes, type=2, norm="ortho", overwrite_x=True)
    return depth


def dirichlet(slope_x: np.ndarray, slope_y: np.ndarray, mm_per_px: float) -> np.ndarray:
    """Depth whose slopes are given and which is 0 on the border of the picture; as `neumann` otherwise.

    It is right where the gel is held flat at its border, and wrong for a contact near it.
    """
    _check(slope_x, slope_y)
    height, width = slope_x.shape
    inner = _divergence(slope_x, slope_y)[1:-1, 1:-1]
    values = [2 * np.cos(np.pi * np.arange(1, n - 1) / (n - 1)) - 2 for n in (height, width)]
    modes = fft.dstn(inner, type=1, norm="ortho") / (values[0][:, None] + values[1]).astype(slope_x.dtype)
    depth = np.zeros_like(slope_x)
    depth[1:-1, 1:-1] = fft.idstn(modes, type=1, norm="ortho") * slope_x.dtype.type(mm_per_px)
    return depth


def _divergence(slope_x: np.ndarray, slope_y: np.ndarray) -> np.ndarray:
    """Of the half-pixel slopes, nothing flowing over the border, [H, W]."""
    half = slope_x.dtype.type(0.5)
    across = (slope_x[:, 1:] + slope_x[:, :-1]) * half
    down = (slope_y[1:] + slope_y[:-1]) * half
    flux = np.empty_like(slope_x)
    flux[:, 0], flux[:, -1] = across[:, 0], -across[:, -1]
    np.subtract(across[:, 1:], across[:, :-1], out=flux[:, 1:-1])
    flux[0] += down[0]
    flux[-1] -= down[-1]
    flux[1:-1] += down[1:]
    flux[1:-1] -= down[:-1]
    return flux


@functools.lru_cache(maxsize=8)
def _inverse_eigenvalues(shape: tuple[int, int], kind: str) -> np.ndarray:
    """1 / λ_kl, and 0 for the mean, which slopes do not determine."""
    rows, columns = (2 * np.cos(np.pi * np.arange(n) / n) - 2 for n in shape)
    values = rows[:, None] + columns[None]
    values[0, 0] = np.inf
    return (1 / values).astype(kind)


def _check(slope_x: np.ndarray, slope_y: np.ndarray) -> None:
    if slope_x.ndim != 2 or slope_x.shape != slope_y.shape or min(slope_x.shape) < 3:
        shapes = f"{list(slope_x.shape)} and {list(slope_y.shape)}"
        raise ValueError(f"slopes have shapes {shapes}: must be one shape [H, W], at least 3 × 3; stack nothing")
