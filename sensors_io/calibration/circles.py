"""The contact circles of ball presses, found by how well a ball explains the colours.

A press is three numbers, the *touch*: centre and contact radius.  Given touches, normals and depth follow (`imprint`)
and the change of channel c at the position (x, y) is linear in unknown constants,

    ΔI_c = Σ_k S_ck(x, y) φ_k + D_c(x, y) u,   φ = (n_x, n_y, n_x², n_x n_y, n_y²),

with the in-plane part (n_x, n_y) of the unit normal, the indentation u, and polynomials S, D of the position, for lamps
are near.  Constants by robust linear least squares and touches by robust non-linear least squares alternate, while the
degree of S rises.  No pixel is labelled and no brightness is thresholded: the circle is where the residual is least.
"""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
from scipy import fft

from sensors_io.calibration.imprint import BLUR_MM, CONTACTS, Imprint
from sensors_io.calibration.presses import BallPresses, Touches, shrink
from sensors_io.fields.slopes import legendre

SCHEDULE = (1, 1, 2, 2, 3, 3)
"""Degree of S in each round; a low one first, since a high one explains wrong circles too."""

DEPTH_DEGREE = 1

STARTS = (0.5, 0.8)
"""Contact radii, in ball radii, from which the rounds begin; the better end is kept."""

REACH = 1.6
"""Contact radii from the centre, up to which a press is fitted; farther out a layer sinks less than the half-space."""

RIDGE = 1e-5
"""Of the mean diagonal of the normal equations: decides only what no press constrains."""

SOFT = 6.0
"""Grey levels; a greater residual is a speck or a shadow and counts in proportion, not by its square."""

STEPS, HALVES, NUDGE, SETTLED = 8, (1.0, 0.5, 0.25, 0.125), 0.02, 0.01
"""Of the search for a touch: most steps, their lengths tried, the difference of a derivative and the last step, px."""

FINE = 18
"""Pixels per ball radius that are enough: pictures are shrunk to at least as many."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Circles:
    """Touches [P] and how badly a ball explains each press: rms of the residual over that of the change, [P]."""

    touches: Touches
    misfit: np.ndarray
    optics: "Optics"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Optics:
    """Constants of the forward model, float64 [terms, 3], and the degree of S."""

    weights: np.ndarray
    degree: int


def find_circles(presses: BallPresses, schedule: tuple[int, ...] = SCHEDULE) -> Circles:
    """Touches of all presses, and the optics that explain them; the order of the presses changes no bit of either.

    Args:
      presses: the pictures.
      schedule: degree of S in each round; more rounds bring contact radii nearer to where they settle.
    """
    order = presses.canonical_order()
    small = _Small(presses.chosen(order))
    begun = small.located()
    ends = [_alternate(small, begun * (1, 1, start), schedule[:4]) for start in STARTS]
    rows, _ = min(ends, key=lambda end: float(np.median(end[1])))
    rows, misfit = _alternate(small, rows, schedule[4:])
    optics = _fit(small, rows, schedule[-1])
    back = np.argsort(order)
    return Circles(touches=small.full(rows[back]), misfit=misfit[back], optics=optics)


def first_touch(picture: np.ndarray, background: np.ndarray, radius_mm: float, mm_per_px: float) -> np.ndarray:
    """First guess of one touch, without optics: (x, y, contact radius) in px, float64 [3].

    The change is greatest where the slope is: the radius is that of the ring in which it is greatest on average.
    """
    one = BallPresses(pictures=picture[None], background=background, radius_mm=radius_mm, mm_per_px=mm_per_px)
    small = _Small(one)
    row = small.located()[0]
    away = np.hypot(small.x - row[0], small.y - row[1])
    ring = np.minimum(away, CONTACTS[1] * small.ball_px).round().astype(np.int64)
    size = np.sqrt((small.changes[0] ** 2).sum(-1))
    mean = np.bincount(ring.ravel(), size.ravel()) / np.maximum(np.bincount(ring.ravel()), 1)
    row[2] = max(float(mean[:-1].argmax()), 1.0)
    found: np.ndarray = small.full(row[None]).stacked()[0]
    return found


def align_circles(presses: BallPresses, optics: Optics) -> Circles:
    """Touches of presses that the optics have not seen."""
    small = _Small(presses)
    begun = small.located()
    ends = [_align(small, begun * (1, 1, start), optics) for start in STARTS]
    better = np.argmin([misfit for _, misfit in ends], axis=0)
    rows = np.where(better[:, None] == 0, ends[0][0], ends[1][0])
    rows, misfit = _align(small, rows, optics)
    return Circles(touches=small.full(rows), misfit=misfit, optics=optics)


class _Small:
    """Presses on fewer pixels: their changes less the median over the picture, which is drift of the lamps."""

    def __init__(self, presses: BallPresses):
        self.factor = max(1, int(presses.radius_mm / presses.mm_per_px / FINE))
        self.mm_per_px = presses.mm_per_px * self.factor
        self.radius_mm = presses.radius_mm
        background = shrink(presses.background, self.factor)
        changes = np.stack([shrink(p, self.factor) - background for p in presses.pictures])
        self.changes = changes - np.median(changes, axis=(1, 2), keepdims=True)
        self.shape = (background.shape[0], background.shape[1])
        self.y, self.x = np.mgrid[: self.shape[0], : self.shape[1]].astype(float)
        self.places = legendre(*self.shape, max(SCHEDULE))
        self.imprint = Imprint(presses.radius_mm, BLUR_MM)

    @property
    def ball_px(self) -> float:
        """Radius of the ball."""
        return self.radius_mm / self.mm_per_px

    def located(self) -> np.ndarray:
        """First guess of the centres, with the ball's radius, [P, 3]."""
        return np.array([(*_odd_centre(change, self.ball_px), self.ball_px) for change in self.changes])

    def near(self, row: np.ndarray, radius: float) -> np.ndarray:
        """Pixels within a radius of the centre, bool [h, w]."""
        mask: np.ndarray = np.hypot(self.x - row[0], self.y - row[1]) < radius
        return mask

    def features(self, row: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """φ_1..φ_5 and u of a touch at pixels, [6, n]."""
        pitch = self.mm_per_px
        n_x, n_y, depth = self.imprint((x - row[0]) * pitch, (y - row[1]) * pitch, row[2] * pitch)
        return np.stack([n_x, n_y, n_x**2, n_x * n_y, n_y**2, depth])

    def full(self, rows: np.ndarray) -> Touches:
        """On the pixels of the pictures themselves."""
        centre = (rows[:, :2] + 0.5) * self.factor - 0.5
        return Touches.of(np.column_stack([centre, rows[:, 2] * self.factor]))


def _odd_centre(change: np.ndarray, ball_px: float) -> tuple[float, float]:
    """Point about which the change is most nearly odd, as the slopes of a ball are, near where it is strongest.

        argmax_c  −g(c) Σ_d f(c + d) · f(c − d),   f the change less its mean over 1.5 ball radii

    g is a Gaussian about the strongest place; the sum for all c at once is the square of f's Fourier transform.
    """
    f = change - cv2.GaussianBlur(change, (0, 0), 1.5 * ball_px)
    energy = cv2.GaussianBlur((f**2).sum(-1), (0, 0), 0.5 * ball_px)
    y, x = np.unravel_index(int(energy.argmax()), energy.shape)
    size = [fft.next_fast_len(2 * n, real=True) for n in energy.shape]
    spectrum = fft.rfft2(f, size, axes=(0, 1))
    sums = fft.irfft2((spectrum**2).sum(-1), size)
    down, across = np.ogrid[: size[0], : size[1]]
    close = np.exp(-((across / 2 - x) ** 2 + (down / 2 - y) ** 2) / (2 * (0.8 * ball_px) ** 2))
    row, column = np.unravel_index(int((-sums * close).argmax()), sums.shape)
    return column / 2, row / 2


def _alternate(small: _Small, rows: np.ndarray, degrees: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    misfit = np.ones(len(rows))
    for degree in degrees:
        rows, misfit = _align(small, rows, _fit(small, rows, degree))
    return rows, misfit


def _fit(small: _Small, rows: np.ndarray, degree: int) -> Optics:
    """Constants by least squares, then once more with the residuals beyond `SOFT` weighted down."""
    slope, depth = _terms(degree), _terms(DEPTH_DEGREE)
    designs, seen = [], []
    for row, change in zip(rows, small.changes, strict=True):
        mask = small.near(row, REACH * row[2] + 1.5)
        features, places = small.features(row, small.x[mask], small.y[mask]), small.places[:, mask]
        by_slope = (features[:5, None] * places[:slope]).reshape(5 * slope, -1)
        designs.append(np.concatenate([by_slope, features[5] * places[:depth]]).T)
        seen.append(change[mask])
    design, change = np.concatenate(designs), np.concatenate(seen)
    weights = _ridge(design, change, np.ones(len(design)))
    trust = 1 / np.sqrt(1 + ((change - design @ weights) ** 2).mean(-1) / SOFT**2)
    return Optics(weights=_ridge(design, change, trust), degree=degree)


def _ridge(design: np.ndarray, change: np.ndarray, trust: np.ndarray) -> np.ndarray:
    weighted = design * trust[:, None]
    normal = weighted.T @ design
    ridge = RIDGE * np.trace(normal) / len(normal)
    solved: np.ndarray = np.linalg.solve(normal + ridge * np.eye(len(normal)), weighted.T @ change)
    return solved


def _align(small: _Small, rows: np.ndarray, optics: Optics) -> tuple[np.ndarray, np.ndarray]:
    """Touches that explain each press best, given the optics, and their misfits."""
    slope, depth = _terms(optics.degree), _terms(DEPTH_DEGREE)
    shares = np.einsum("fjc,jyx->fcyx", optics.weights[: 5 * slope].reshape(5, slope, 3), small.places[:slope])
    nearer = np.einsum("jc,jyx->cyx", optics.weights[5 * slope :], small.places[:depth])
    model = np.concatenate([shares, nearer[None]])
    found = [_align_one(small, row, change, model) for row, change in zip(rows, small.changes, strict=True)]
    return np.array([row for row, _ in found]), np.array([misfit for _, misfit in found])


def _align_one(small: _Small, row: np.ndarray, change: np.ndarray, model: np.ndarray) -> tuple[np.ndarray, float]:
    """One touch by damped Gauss-Newton steps; `model` is what each feature adds to each channel, [6, 3, h, w]."""
    ball = small.ball_px
    mask = small.near(row, max(REACH * row[2], 0.6 * ball) + 2)
    if not mask.any():
        return row, 1.0  # it has left the picture, and nothing of its change is explained
    x, y, seen, model = small.x[mask], small.y[mask], change[mask].T, model[..., mask].copy()

    def residual(candidate: np.ndarray) -> np.ndarray:
        return ((small.features(candidate, x, y)[:, None] * model).sum(0) - seen).ravel()

    low = np.array([row[0] - 0.7 * ball, row[1] - 0.7 * ball, CONTACTS[0] * ball])
    high = np.array([row[0] + 0.7 * ball, row[1] + 0.7 * ball, CONTACTS[1] * ball])
    end = minimise(residual, np.clip(row, low, high), low, high, SOFT)
    share = np.sqrt(np.mean(residual(end) ** 2) / max(np.mean(seen**2), 1e-9))
    return end, float(share)


def minimise(
    residual: Callable[[np.ndarray], np.ndarray], start: np.ndarray, low: np.ndarray, high: np.ndarray, soft: float
) -> np.ndarray:
    """Parameters within bounds that minimise Σ √(1 + r²/s²), by Gauss-Newton steps that are halved until they help.

    Args:
      residual: r [n] of parameters [k].
      start, low, high: parameters [k].
      soft: s, beyond which a residual counts in proportion.
    """
    at, left = start, residual(start)
    loss = np.sqrt(1 + (left / soft) ** 2).sum()
    for _ in range(STEPS):
        trust = 1 / np.sqrt(1 + (left / soft) ** 2)
        slopes = np.stack([(residual(at + d) - left) / NUDGE for d in NUDGE * np.eye(len(at))])
        weighted = slopes * trust
        normal = weighted @ slopes.T
        step = np.linalg.solve(normal + 1e-6 * np.trace(normal) * np.eye(len(at)), -(weighted @ left))
        for share in HALVES:
            trial = np.clip(at + share * step, low, high)
            then = residual(trial)
            if (loss_then := np.sqrt(1 + (then / soft) ** 2).sum()) < loss:
                break
        else:
            return at
        settled = np.abs(trial - at).max() < SETTLED
        at, left, loss = trial, then, loss_then
        if settled:
            break
    return at


def _terms(degree: int) -> int:
    """Number of Legendre products up to a degree."""
    return (degree + 1) * (degree + 2) // 2
