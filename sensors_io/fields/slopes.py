"""Colour to slope: a polynomial of the change of colour whose constants vary over the picture, for lamps are near.

With the change d = (I − I_0) / 64 of a pixel against the gel at rest, its monomials ψ_k(d) of degree 1 … p and Legendre
products P_j(x, y) of degree ≤ q, the in-plane part of the unit normal is

    n(x, y) = Σ_jk w_jk P_j(x, y) ψ_k(d),   ∇z = n / √(1 − |n|²).

No change is no slope: there is no constant term.  The normal and not the slope, since the light that a matte surface
returns is linear in the normal; so steeper slopes than those calibrated on are continued in the right direction.
"""

import dataclasses
import itertools
import math

import cv2
import numpy as np

COLOUR_SCALE = 64.0
"""Grey levels; changes of this size are common, so that no power of d vanishes compared with another."""

SMOOTHING_PX = 0.7
"""Standard deviation of the Gaussian that the change is smoothed with: camera noise, less than the blur of the lens."""

STEEPEST = 0.93
"""Greatest |n|, a slope of 2.5: beyond it a surface shows the camera its side."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ColourMap:
    """The constants w of the map.

    Args:
      weights: float32 [J, K, 2]: position terms, colour terms, (x, y).
      degree: p of the colour, 1 to 3.
      position_degree: q.
    """

    weights: np.ndarray
    degree: int
    position_degree: int

    def __post_init__(self) -> None:
        # numbers of terms, which are not listed: a file states the degrees
        places, colours = math.comb(self.position_degree + 2, 2), math.comb(self.degree + 3, 3) - 1
        want = (places, colours, 2)
        if self.weights.shape != want or self.weights.dtype != np.float32:
            got = f"{self.weights.dtype}{list(self.weights.shape)}"
            raise ValueError(f"weights is {got}: must be float32{list(want)}; fit it anew")
        if not np.isfinite(self.weights).all():
            raise ValueError("weights holds numbers that are not finite: must be finite; fit it anew")


class SlopeReader:
    """Reads the slopes of pictures of one sensor, whose map is spread over the pixels once.

    Args:
      colours: the map.
      background: uint8 [H, W, 3], the gel at rest, RGB.
    """

    def __init__(self, colours: ColourMap, background: np.ndarray):
        self.background = background
        height, width = background.shape[:2]
        places = legendre(height, width, colours.position_degree)
        self._terms = colour_terms(colours.degree)
        self._maps = np.einsum("jyx,jkc->ckyx", places, colours.weights, optimize=True).astype(np.float32)

    def __call__(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """∂z/∂x and ∂z/∂y, float32 [H, W] each, of one picture, uint8 [H, W, 3] RGB."""
        return to_slopes(*self.normals(picture))

    def normals(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """n_x and n_y, float32 [H, W] each, of one picture, not limited."""
        n_x, n_y = np.zeros((2, *self.background.shape[:2]), np.float32)
        powers: dict[tuple[int, ...], np.ndarray] = {
            (channel,): seen for channel, seen in enumerate(change(picture, self.background))
        }
        for term, along_x, along_y in zip(self._terms, *self._maps, strict=True):
            if term not in powers:
                powers[term] = cv2.multiply(powers[term[:-1]], powers[term[-1:]])
            cv2.accumulateProduct(powers[term], along_x, n_x)
            cv2.accumulateProduct(powers[term], along_y, n_y)
        return n_x, n_y


def change(picture: np.ndarray, background: np.ndarray) -> tuple[np.ndarray, ...]:
    """d of the three channels, float32 [H, W] each, smoothed.

    Args:
      picture, background: uint8 [H, W, 3].

    Raises:
      ValueError: pictures of two sizes.
    """
    if picture.shape != background.shape:
        sizes = f"{picture.shape} and {background.shape}"
        raise ValueError(f"picture and background have shapes {sizes}: must be equal; use the camera's calibration")
    difference = cv2.subtract(picture, background, dtype=cv2.CV_32F)
    smooth = cv2.GaussianBlur(difference, (5, 5), SMOOTHING_PX, borderType=cv2.BORDER_REPLICATE)
    return tuple(cv2.split(smooth * np.float32(1 / COLOUR_SCALE)))


def to_slopes(n_x: np.ndarray, n_y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes n / √(1 − |n|²) of a surface whose unit normal has the in-plane part n, |n| limited to `STEEPEST`."""
    square = cv2.accumulateProduct(n_y, n_y, cv2.multiply(n_x, n_x))
    if square.max() > STEEPEST**2:
        scale = np.minimum(STEEPEST / np.sqrt(np.maximum(square, 1e-12)), 1).astype(np.float32)
        n_x, n_y, square = n_x * scale, n_y * scale, square * scale**2
    up = cv2.pow(1 - square, -0.5)
    return cv2.multiply(n_x, up), cv2.multiply(n_y, up)


def colour_terms(degree: int) -> list[tuple[int, ...]]:
    """Monomials of degree 1 … `degree`, each as its sorted channels: (0, 0, 2) is r²b; lower degrees come first."""
    return [t for d in range(1, degree + 1) for t in itertools.combinations_with_replacement(range(3), d)]


def colour_powers(values: np.ndarray, degree: int) -> np.ndarray:
    """Every monomial of changes d [3, n], in the order of `colour_terms`, [K, n]."""
    return np.stack([np.prod(values[list(term)], axis=0) for term in colour_terms(degree)])


def position_terms(degree: int) -> list[tuple[int, int]]:
    """Degrees (i, j) in x and y with i + j ≤ degree; lower sums come first, so that a lower degree is a beginning."""
    return [(total - j, j) for total in range(degree + 1) for j in range(total + 1)]


def legendre(height: int, width: int, degree: int) -> np.ndarray:
    """P_i(x) P_j(y) on the pixels, x and y from −1 to 1 over the picture, float64 [J, H, W]."""
    along_y, along_x = (
        np.polynomial.legendre.legvander((np.arange(n) + 0.5) / n * 2 - 1, degree) for n in (height, width)
    )
    return np.stack([np.multiply.outer(along_y[:, j], along_x[:, i]) for i, j in position_terms(degree)])
