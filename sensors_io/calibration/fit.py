"""Colour → slope from located presses: regression of the normal with a smoothness prior.

Inside its contact a ball's normal is linear in the position, n = −(x − c) / R, whatever the contact radius, and near
the rim it is what the blur leaves of it (`imprint`).  Far outside, gel that nothing touches has n = 0 and holds the map
down.  The constants w of the map minimise, with pixel weights ω that sum to Ω,

    Σ ω |n − Σ_jk w_jk P_j ψ_k|² + λ Ω Σ_jk exp(deg P_j + deg ψ_k − 1) |w_jk|².

The prior lets the map bend over the picture as far as the presses support it, so that no degree has to be chosen: a
choice among degrees jumped with the order of the files.  Only λ is chosen, by repeated folds.  The normal equations of
every press are kept apart, so that leaving presses out costs a subtraction and a small solve.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence

import numpy as np
from scipy import linalg

from sensors_io.calibration.imprint import BLUR_MM, Imprint
from sensors_io.calibration.presses import BallPresses, Touches
from sensors_io.fields.slopes import (
    ColourMap,
    SlopeReader,
    change,
    colour_powers,
    colour_terms,
    legendre,
    position_terms,
)

DEGREE, POSITION_DEGREE = 2, 6
"""Of the colour and of the position.  Cubes of the colour fit the presses better by 4 % and continue worse beyond the
slopes of the presses: 54 instead of 45 µm at known depth."""

RIDGES = tuple(10 ** (0.5 * k) for k in range(-15, -5))
"""λ that are tried."""

INNER = 0.95
"""Contact radii from the centre, up to which pixels of the ball are taken."""

RIM, RIM_WEIGHT = 0.7, 0.2
"""Contact radii beyond which a pixel of the ball counts less, and its weight: there the normal hangs on the contact's
radius and on the blur.  Rims that count fully make slopes 1 to 5 % too steep."""

FAR = 2.5
"""Contact radii from the centre, beyond which the gel counts as flat: a layer sinks by less than a tenth there."""

FLAT_SHARE = 0.03
"""Weight of the flat pixels of a press against that of its ball: more flattens the ball too."""

TRUSTED = 0.08
"""Error of the normal beyond which a pixel is a speck or a shadow, and counts less."""

BALL_PIXELS, FLAT_PIXELS = 600, 200
"""Taken of each press, on a lattice: more change nothing."""

REPEATS = 4
"""Of the folds that choose λ."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gram:
    """Normal equations of one press or of several: AᵀWA [K, K], AᵀWn [K, 2], nᵀWn and the sum of the weights."""

    normal: np.ndarray
    right: np.ndarray
    square: float
    weight: float

    @classmethod
    def total(cls, grams: list["Gram"]) -> "Gram":
        """The sum."""
        return cls(
            normal=np.sum([g.normal for g in grams], 0),
            right=np.sum([g.right for g in grams], 0),
            square=sum(g.square for g in grams),
            weight=sum(g.weight for g in grams),
        )

    def without(self, part: "Gram") -> "Gram":
        """The sum after a part of it is taken out."""
        return Gram(
            normal=self.normal - part.normal,
            right=self.right - part.right,
            square=self.square - part.square,
            weight=self.weight - part.weight,
        )

    def solutions(self, ridges: Sequence[float]) -> Iterator[np.ndarray]:
        """Constants [K, 2] under a prior of each strength: one eigendecomposition serves them all."""
        scale = 1 / np.sqrt(_penalties())
        values, vectors = linalg.eigh(scale[:, None] * self.normal * scale, check_finite=False, driver="evd")
        basis = scale[:, None] * vectors
        right = basis.T @ self.right
        for ridge in ridges:
            yield basis @ (right / (np.maximum(values, 0) + ridge * self.weight)[:, None])

    def error(self, weights: np.ndarray) -> float:
        """Root mean square error of the normal, √((nᵀWn − 2 wᵀAᵀWn + wᵀAᵀWA w) / Σ W)."""
        total = self.square + float((weights * (self.normal @ weights - 2 * self.right)).sum())
        return float(np.sqrt(max(total, 0.0) / self.weight))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressEquations:
    """Presses in canonical order, their touches with centres as the map sees them, and their normal equations.

    `given` [P] are the places in it of the presses in the order in which they were given.
    """

    presses: BallPresses
    touches: Touches
    grams: list[Gram]
    given: np.ndarray


def fit_map(presses: BallPresses, touches: Touches, *, seed: int = 0) -> ColourMap:
    """Fit the map, move each centre to where the map sees it, fit again; the order of the presses changes no bit.

    Args:
      presses, touches: where each press is.
      seed: of the folds of the cross-validation that chooses the prior.
    """
    return solve_map(prepare(presses, touches, seed=seed).grams, seed=seed)[0]


def prepare(presses: BallPresses, touches: Touches, *, seed: int = 0, folds: int = 5) -> PressEquations:
    """Normal equations of every press, after a first fit has moved the centres and found the specks."""
    order = presses.canonical_order()
    presses, touches = presses.chosen(order), Touches.of(touches.stacked()[order])
    first, _ = solve_map(_grams(presses, touches, None), seed=seed, folds=folds)
    touches = recentre(presses, touches, first)
    grams = _grams(presses, touches, first)
    return PressEquations(presses=presses, touches=touches, grams=grams, given=np.argsort(order))


def solve_map(grams: list[Gram], *, seed: int = 0, folds: int = 5, repeats: int = REPEATS) -> tuple[ColourMap, float]:
    """The map and the λ of its prior, whose held-out error over all folds of all repeats is least on average."""
    total, errors = Gram.total(grams), []
    rng = np.random.default_rng(seed)
    for _ in range(repeats):
        order = rng.permutation(len(grams))
        for k in range(min(folds, len(grams))):
            out = Gram.total([grams[i] for i in order[k::folds]])
            rest = total.without(out)
            errors.append([out.error(weights) for weights in rest.solutions(RIDGES)])
    ridge = RIDGES[int(np.mean(errors, 0).argmin())]
    shape = (len(position_terms(POSITION_DEGREE)), len(colour_terms(DEGREE)), 2)
    (weights,) = total.solutions((ridge,))
    weights = weights.reshape(shape).astype(np.float32)
    return ColourMap(weights=weights, degree=DEGREE, position_degree=POSITION_DEGREE), ridge


def recentre(presses: BallPresses, touches: Touches, colours: ColourMap) -> Touches:
    """Centres as the map sees them, c = median of x + R n over the contact's inner part; radii as they were."""
    reader = SlopeReader(colours, presses.background)
    y, x = np.mgrid[: presses.shape[0], : presses.shape[1]].astype(float)
    ball = presses.radius_mm / presses.mm_per_px
    rows = touches.stacked()
    for row, picture in zip(rows, presses.pictures, strict=True):
        inner = np.hypot(x - row[0], y - row[1]) < 0.7 * row[2]
        if inner.any():
            n_x, n_y = reader.normals(picture)
            row[:2] = np.median(x[inner] + ball * n_x[inner]), np.median(y[inner] + ball * n_y[inner])
    return Touches.of(rows)


def _grams(presses: BallPresses, touches: Touches, before: ColourMap | None) -> list[Gram]:
    """Normal equations of every press; pixels that an earlier map contradicts count less."""
    places = legendre(*presses.shape, POSITION_DEGREE)
    imprint = Imprint(presses.radius_mm, BLUR_MM)
    y, x = np.mgrid[: presses.shape[0], : presses.shape[1]].astype(float)
    found = []
    for row, picture in zip(touches.stacked(), presses.pictures, strict=True):
        away = np.hypot(x - row[0], y - row[1])
        ball, flat = _lattice(away < INNER * row[2], BALL_PIXELS), _lattice(away > FAR * row[2], FLAT_PIXELS)
        index = np.concatenate([ball, flat])
        dx_mm, dy_mm = ((c.ravel()[index] - at) * presses.mm_per_px for c, at in ((x, row[0]), (y, row[1])))
        normal = imprint(dx_mm, dy_mm, row[2] * presses.mm_per_px)[:2].T
        normal[len(ball) :] = 0
        weight = np.full(len(index), FLAT_SHARE * len(ball) / max(len(flat), 1))
        weight[: len(ball)] = np.where(away.ravel()[ball] > RIM * row[2], RIM_WEIGHT, 1)
        seen = np.stack([c.ravel()[index] for c in change(picture, presses.background)]).astype(np.float64)
        design = _design(places.reshape(len(places), -1)[:, index], colour_powers(seen, DEGREE))
        if before is not None:
            left = normal - design @ before.weights.reshape(-1, 2).astype(np.float64)
            weight /= 1 + (left**2).sum(-1) / TRUSTED**2
        found.append(_gram(design, normal, weight))
    return found


def _gram(design: np.ndarray, normal: np.ndarray, weight: np.ndarray) -> Gram:
    weighted = design * weight[:, None]
    return Gram(
        normal=weighted.T @ design,
        right=weighted.T @ normal,
        square=float((weight[:, None] * normal**2).sum()),
        weight=float(weight.sum()),
    )


def _lattice(mask: np.ndarray, count: int) -> np.ndarray:
    """Flat indices of about so many pixels of a mask, on every k-th row and column."""
    k = max(1, round(np.sqrt(np.count_nonzero(mask) / count)))
    grid = np.zeros_like(mask)
    grid[::k, ::k] = mask[::k, ::k]
    return np.flatnonzero(grid)


def _design(position: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Products P_j ψ_k of position [J, n] and colour [K, n], [n, J·K]."""
    return (position[:, None] * colour[None]).reshape(-1, position.shape[-1]).T


@functools.cache
def _penalties() -> np.ndarray:
    """exp(deg P_j + deg ψ_k − 1) of every product, [J·K]."""
    of_position = np.array([sum(term) for term in position_terms(POSITION_DEGREE)])
    of_colour = np.array([len(term) - 1 for term in colour_terms(DEGREE)])
    return np.exp(of_position[:, None] + of_colour).ravel()
