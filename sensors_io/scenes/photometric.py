"""Photometric optics of a marker-less gel, as measured: colour by position, slope and depth, linear in its constants.

With the unit normal n of the deformed surface, its in-plane part (n_x, n_y), the indentation u and the position x, y,

    I_c = F_c(x, y) (1 + grain) + Σ_k S_ck(x, y) φ_k(n) + D_c u,   φ = (n_x, n_y, n_x², n_x n_y, n_y²).

F is the flat field.  S is what lamps close to the gel do: their direction and strength vary over the window.  D is the
gel coming nearer to lamps and camera.  F_c and S_ck are sums of products of Legendre polynomials of x and y, so that
all constants follow from real pictures by linear least squares (`fitting`).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sensors_io.scenes import mini_optics
from sensors_io.scenes.optics import DeformedGel, Light, Rgb, cubic_matrix

FLAT_DEGREE = 8
SLOPE_DEGREE = 2

Rows = tuple[Rgb, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotometricOptics:
    """The constants, one column per colour channel (R, G, B), pictures in 0..1.

    Args:
      half_window_mm: distance from the centre at which the Legendre polynomials' argument is 1.
      flat: of F, one row per term of `terms(FLAT_DEGREE)`.
      slope: of S, for each φ_k in turn one row per term of `terms(SLOPE_DEGREE)`.
      depth: one row, D in 1/mm.
      max_tilt: greatest |(n_x, n_y)| that was fitted; steeper gel is shown as that steep.
    """

    half_window_mm: float
    flat: Rows
    slope: Rows
    depth: Rows
    max_tilt: float

    def __post_init__(self) -> None:
        want = {"flat": len(terms(FLAT_DEGREE)), "slope": 5 * len(terms(SLOPE_DEGREE)), "depth": 1}
        for name, rows in want.items():
            got = np.shape(getattr(self, name))
            if got != (rows, 3):
                raise ValueError(f"{name} has shape {got}: must be {(rows, 3)}; fit it anew")


def terms(degree: int) -> list[tuple[int, int]]:
    """Degrees (i, j) in x and y of the terms with i + j ≤ degree, in the order of the constants."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def basis(x: np.ndarray, y: np.ndarray, degree: int) -> np.ndarray:
    """P_i(x) P_j(y) for every term, float64 [terms, len(y), len(x)]; x and y in units of the half window."""
    along_x, along_y = (np.polynomial.legendre.legvander(c, degree) for c in (x, y))
    return np.stack([np.multiply.outer(along_y[:, j], along_x[:, i]) for i, j in terms(degree)])


def tilt(d_x: Array, d_y: Array, max_tilt: float) -> tuple[Array, Array]:
    """In-plane part of the unit normal for slopes of the indentation, shortened to `max_tilt`."""
    square = d_x**2 + d_y**2
    up = jnp.minimum(jax.lax.rsqrt(1 + square), max_tilt * jax.lax.rsqrt(square + 1e-12))
    return d_x * up, d_y * up


def shade(gel: DeformedGel, light: Light, optics: PhotometricOptics) -> Float[Array, "H W 3"]:
    """Picture of the gel; the three gains of the light act on the three channels.

    `light.texture` is the grain, stretched over the window.  All is computed channel by channel and interleaved last,
    which a CPU does some fifteen times as fast as the other way round.
    """
    flat, slope = fields(optics, gel.depth_mm.shape[0], gel.window_mm)
    d_y, d_x = jnp.gradient(gel.depth_mm, gel.spacing_mm)
    n_x, n_y = tilt(d_x, d_y, optics.max_tilt)
    image = flat * (1 + _stretched(light.texture, gel.depth_mm.shape[0]))
    for share, phi in zip(slope, (n_x, n_y, n_x**2, n_x * n_y, n_y**2), strict=True):
        image = image + share * phi
    image = image + jnp.array(optics.depth[0], jnp.float32)[:, None, None] * gel.depth_mm
    gain = light.exposure * light.led_gain
    return (jnp.maximum(image, 0) * gain[:, None, None]).transpose(1, 2, 0)


def gelsight_mini(gel: DeformedGel, light: Light) -> Float[Array, "H W 3"]:
    """The GelSight Mini whose constants are in `mini_optics`."""
    return shade(gel, light, MINI)


def grain(rng: np.random.Generator, size: int, std: Rgb, shared: float) -> np.ndarray:
    """Relative grain of a gel's coating, float32 [3, size, size]: neighbours correlated by ½, channels by `shared`."""
    common, own = rng.standard_normal((1, size + 1, size + 1)), rng.standard_normal((3, size + 1, size + 1))
    noise = np.sqrt(shared) * common + np.sqrt(1 - shared) * own
    pairs = noise[:, :-1] + noise[:, 1:]
    return (np.array(std)[:, None, None] / 2 * (pairs[..., :-1] + pairs[..., 1:])).astype(np.float32)


@functools.lru_cache(maxsize=8)
def fields(optics: PhotometricOptics, pixels: int, window_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """F [3, H, W] and S [5, 3, H, W] on a picture of `pixels` a side, float32: constants of the compiled renderer."""
    x = ((np.arange(pixels) + 0.5) / pixels - 0.5) * window_mm / optics.half_window_mm
    flat = np.einsum("kc,kyx->cyx", np.array(optics.flat), basis(x, x, FLAT_DEGREE))
    rows = np.array(optics.slope).reshape(5, -1, 3)
    slope = np.einsum("fkc,kyx->fcyx", rows, basis(x, x, SLOPE_DEGREE))
    return flat.astype(np.float32), slope.astype(np.float32)


def _stretched(texture: Array, pixels: int) -> Array:
    """A texture [..., T, T] on the picture, [..., H, W]."""
    if texture.shape[-1] == pixels:
        return texture
    matrix = cubic_matrix(pixels, texture.shape[-1])
    return matrix @ texture @ matrix.T


MINI = PhotometricOptics(
    half_window_mm=mini_optics.HALF_WINDOW_MM,
    flat=mini_optics.FLAT,
    slope=mini_optics.SLOPE,
    depth=mini_optics.DEPTH,
    max_tilt=mini_optics.MAX_TILT,
)
