"""Methods that reconstruct depth: maps from colour to slope, and integrators from slope to depth.

The maps are the package's polynomial, a polynomial of colour alone, a table of colours, random Fourier features (a
kernel) and a small perceptron of colour and position (the size of gs_sdk's).  All train on the same pixels of the same
presses with the same normals.  The integrators are the package's and those that gs_sdk, gsrobotics and GelSlim ship.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy import fft, ndimage

from sensors_io.calibration.circles import find_circles
from sensors_io.calibration.fit import fit_map
from sensors_io.calibration.presses import BallPresses, Touches
from sensors_io.fields.depth import ZeroConfig, zero_level
from sensors_io.fields.poisson import dirichlet, neumann
from sensors_io.fields.slopes import SlopeReader, change, colour_powers, to_slopes
from sensors_io.fields.types import Calibration

SlopeMap = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From a picture, uint8 [H, W, 3], to ∂z/∂x and ∂z/∂y, float32 [H, W]."""

Integrator = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""From ∂z/∂x, ∂z/∂y [H, W] and the pitch in mm/px to depth in mm [H, W]."""

_BINS = 48  # of the colour table along each channel, over changes of ±128 grey levels; 135 leave most cells empty
_FEATURES, _WIDTH = 384, 32  # random Fourier features; units of each of the perceptron's two hidden layers
_RIDGE = 1e-3
_STEPS, _BATCH, _RATE = 1500, 4096, 3e-3  # of the perceptron's training


class TrainingPixels(NamedTuple):
    """Training pixels of a map: changes of colour [n, 3], positions in −1 … 1 [n, 2], in-plane normals [n, 2]."""

    change: np.ndarray
    position: np.ndarray
    normal: np.ndarray


def pixels_of(presses: BallPresses, touches: Touches, seed: int) -> TrainingPixels:
    """Up to 1500 pixels of each contact and 500 of the flat gel far from it."""
    rng = np.random.default_rng(seed)
    place, (y, x) = _places(presses, float), np.mgrid[: presses.shape[0], : presses.shape[1]].astype(float)
    parts = []
    for picture, row in zip(presses.pictures, touches.stacked(), strict=True):
        seen = np.stack(change(picture, presses.background), -1)
        away = np.hypot(x - row[0], y - row[1])
        normal = np.stack([row[0] - x, row[1] - y], -1) * presses.mm_per_px / presses.radius_mm
        normal[away > row[2]] = 0
        ball, flat = np.flatnonzero(away < row[2]), np.flatnonzero(away > 2.5 * row[2])
        index = np.concatenate([rng.permutation(ball)[:1500], rng.permutation(flat)[:500]])
        parts.append([a.reshape(-1, a.shape[-1])[index] for a in (seen, place, normal)])
    return TrainingPixels(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _places(presses: BallPresses, kind: type) -> np.ndarray:
    """Positions of the pixels in −1 … 1, [H, W, 2]."""
    height, width = presses.shape
    y, x = np.mgrid[:height, :width].astype(kind)
    return np.stack([(x + 0.5) / width * 2 - 1, (y + 0.5) / height * 2 - 1], -1)


def package_map(presses: BallPresses, touches: Touches, seed: int) -> SlopeMap:
    """The package's polynomial of colour, whose constants vary over the picture."""
    return SlopeReader(fit_map(presses, touches, seed=seed), presses.background)


def calibrated(presses: BallPresses, seed: int) -> Calibration:
    """The package's calibration, made with all presses, whose circles are found without labels."""
    colours = fit_map(presses, find_circles(presses).touches, seed=seed)
    background, pitch = presses.background, presses.mm_per_px
    return Calibration(sensor="gelsight_mini", background=background, mm_per_px=pitch, colours=colours, made_from={})


def table_map(presses: BallPresses, touches: Touches, seed: int) -> SlopeMap:
    """A table of colours: each cell holds its mean normal, an empty cell that of the nearest full one."""
    pixels = pixels_of(presses, touches, seed)
    cell = _cells(pixels.change)
    count = np.bincount(cell, minlength=_BINS**3)
    mean = np.stack([np.bincount(cell, n, _BINS**3) for n in pixels.normal.T], -1) / np.maximum(count, 1)[:, None]
    empty = (count == 0).reshape(_BINS, _BINS, _BINS)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    filled = mean.reshape(_BINS, _BINS, _BINS, 2)[tuple(nearest)].reshape(-1, 2).astype(np.float32)
    return _reader(lambda seen, place: filled[_cells(seen)], presses)


def colour_map(presses: BallPresses, touches: Touches, seed: int) -> SlopeMap:
    """A cubic polynomial of colour, the same at every pixel."""
    pixels = pixels_of(presses, touches, seed)
    design = colour_powers(pixels.change.T.astype(np.float64), 3).T
    weights = _ridge(design, pixels.normal).astype(np.float32)
    return _reader(lambda seen, place: colour_powers(seen.T, 3).T @ weights, presses)


def kernel_map(presses: BallPresses, touches: Touches, seed: int) -> SlopeMap:
    """Ridge on random Fourier features of a Gaussian kernel over colour and position (Rahimi & Recht 2007)."""
    pixels, rng = pixels_of(presses, touches, seed), np.random.default_rng(seed)
    directions = rng.standard_normal((5, _FEATURES)) * np.array([1.0, 1.0, 1.0, 0.8, 0.8])[:, None]
    phases = rng.uniform(0, 2 * np.pi, _FEATURES)
    spread, offset = directions.astype(np.float32), phases.astype(np.float32)

    def features(seen: np.ndarray, place: np.ndarray) -> np.ndarray:
        return np.cos(np.concatenate([seen, place], -1).astype(np.float32) @ spread + offset)

    weights = _ridge(features(pixels.change, pixels.position).astype(np.float64), pixels.normal).astype(np.float32)
    return _reader(lambda seen, place: features(seen, place) @ weights, presses)


def perceptron_map(presses: BallPresses, touches: Touches, seed: int) -> SlopeMap:
    """A perceptron of colour and position with two hidden layers, trained by Adam on the normal's squared error."""
    pixels = pixels_of(presses, touches, seed)
    inputs = jnp.asarray(np.concatenate([pixels.change, pixels.position], -1), jnp.float32)
    targets = jnp.asarray(pixels.normal, jnp.float32)
    sizes, key = (5, _WIDTH, _WIDTH, 2), jax.random.key(seed)
    params = [
        (jax.random.normal(k, (a, b)) * np.sqrt(2 / a), jnp.zeros(b))
        for k, a, b in zip(jax.random.split(key, 3), sizes, sizes[1:], strict=False)
    ]
    optimizer = optax.adam(optax.cosine_decay_schedule(_RATE, _STEPS))

    def loss(params: list, x: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.mean((_perceptron(params, x) - y) ** 2)

    def step(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        params, state = carry
        chosen = jax.random.randint(key, (_BATCH,), 0, len(inputs))
        updates, state = optimizer.update(jax.grad(loss)(params, inputs[chosen], targets[chosen]), state)
        return (optax.apply_updates(params, updates), state), None

    train = jax.jit(lambda carry, keys: jax.lax.scan(step, carry, keys)[0])
    params, _ = train((params, optimizer.init(params)), jax.random.split(jax.random.key(seed + 1), _STEPS))
    infer = jax.jit(lambda x: _perceptron(params, x))
    return _reader(lambda seen, place: np.asarray(infer(np.concatenate([seen, place], -1))), presses)


MAPS: dict[str, Callable[[BallPresses, Touches, int], SlopeMap]] = {
    "polynomial, varying": package_map,
    "polynomial, colour only": colour_map,
    "colour table": table_map,
    "kernel features": kernel_map,
    "perceptron": perceptron_map,
}


def published_poisson(slope_x: np.ndarray, slope_y: np.ndarray, mm_per_px: float) -> np.ndarray:
    """Cosine-transform integration as gs_sdk and gsrobotics ship it, reimplemented.

    Central differences of the slopes, DCT-II, eigenvalues λ of indices 1 … N instead of 0 … N − 1, mean 0.
    """
    height, width = slope_x.shape
    source = np.gradient(slope_x, axis=1) + np.gradient(slope_y, axis=0)
    rows, columns = (2 * np.cos(np.pi * np.arange(1, n + 1) / n) - 2 for n in (height, width))
    modes = fft.dctn(source, norm="ortho") / (rows[:, None] + columns)
    return fft.idctn(modes, norm="ortho") * mm_per_px


def one_sided_dirichlet(slope_x: np.ndarray, slope_y: np.ndarray, mm_per_px: float) -> np.ndarray:
    """Sine-transform integration of one-sided differences, 0 at the border, as GelSlim ships it, reimplemented."""
    height, width = slope_x.shape
    source = np.zeros_like(slope_x)
    source[:-1, 1:] += slope_x[:-1, 1:] - slope_x[:-1, :-1]
    source[1:, :-1] += slope_y[1:, :-1] - slope_y[:-1, :-1]
    rows, columns = (2 * np.cos(np.pi * np.arange(1, n - 1) / (n - 1)) - 2 for n in (height, width))
    depth = np.zeros_like(slope_x)
    modes = fft.dstn(source[1:-1, 1:-1], type=1, norm="ortho") / (rows[:, None] + columns)
    depth[1:-1, 1:-1] = fft.idstn(modes, type=1, norm="ortho") * mm_per_px
    return depth


INTEGRATORS: dict[str, Integrator] = {
    "this, Neumann": neumann,
    "this, Dirichlet": dirichlet,
    "as gs_sdk and gsrobotics": published_poisson,
    "as GelSlim": one_sided_dirichlet,
}


def depth_by(read: SlopeMap, picture: np.ndarray, mm_per_px: float, integrate: Integrator = neumann) -> np.ndarray:
    """Depth of one picture by a map, an integrator and the package's zero level, mm [H, W]."""
    slope_x, slope_y = read(picture)
    depth = integrate(slope_x, slope_y, mm_per_px)
    return depth - zero_level(depth, np.hypot(slope_x, slope_y), mm_per_px, ZeroConfig())


def _reader(normals: Callable[[np.ndarray, np.ndarray], np.ndarray], presses: BallPresses) -> SlopeMap:
    place = _places(presses, np.float32).reshape(-1, 2)

    def read(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = np.stack(change(picture, presses.background), -1).reshape(-1, 3)
        found = normals(seen, place).astype(np.float32).reshape(*presses.shape, 2)
        return to_slopes(np.ascontiguousarray(found[..., 0]), np.ascontiguousarray(found[..., 1]))

    return read


def _cells(seen: np.ndarray) -> np.ndarray:
    index = np.clip((seen + 2) / 4 * _BINS, 0, _BINS - 1).astype(np.int64)
    return (index[:, 0] * _BINS + index[:, 1]) * _BINS + index[:, 2]


def _ridge(design: np.ndarray, targets: np.ndarray) -> np.ndarray:
    normal = design.T @ design
    ridge = _RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal + ridge, design.T @ targets))


def _perceptron(params: list, x: jax.Array) -> jax.Array:
    for weights, bias in params[:-1]:
        x = jax.nn.relu(x @ weights + bias)
    return x @ params[-1][0] + params[-1][1]
