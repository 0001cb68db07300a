"""Colour → slope from located presses: regression of the normal, degrees chosen by cross-validation over presses.

Inside its contact a ball's normal is linear in the position, n = −(x − c) / R, whatever the contact radius.  Outside,
gel that nothing touches has n = 0 and holds the map down.  The normal equations of every press are kept apart, so that
leaving presses out, or terms out, costs one small solve.
"""

import dataclasses

import numpy as np

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

DEGREES = ((2, 1), (2, 2), (2, 3), (2, 4), (3, 1), (3, 2), (3, 3), (3, 4))
"""(colour, position) degrees that are tried."""

RIDGES = (1e-6, 1e-5, 1e-4, 1e-3)
"""Ridges that are tried, of the mean diagonal of the normal equations."""

INNER = 1.0
"""Contact radii from the centre, up to which the gel lies on the ball."""

FAR = 2.5
"""Contact radii from the centre, beyond which the gel counts as flat: a half-space sinks by a tenth there."""

FLAT_WEIGHT = 0.03
"""Of flat pixels against pixels of the ball, of which about as many are taken: more flattens the ball too."""

TRUSTED = 0.08
"""Error of the normal beyond which a pixel is a speck or a shadow, and counts less."""

PIXELS = 2000
"""Taken of each press: more change nothing."""


Gram = tuple[np.ndarray, np.ndarray, float, float]
"""Normal equations of one press: AᵀWA, AᵀWn, nᵀWn and the sum of the weights."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Samples:
    """Pixels of one press: monomials of colour [K, n] and position [J, n], normals [n, 2], weights [n]."""

    colour: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class ColourMapSettings:
    """Degrees and ridge, and the held-out rms error of the normal that they were chosen by."""

    degree: int
    position_degree: int
    ridge: float
    error: float


def fit_map(
    presses: BallPresses, touches: Touches, *, seed: int = 0, folds: int = 5
) -> tuple[ColourMap, Touches, ColourMapSettings]:
    """Fit the map, move each centre to where the map sees it, fit again.

    Args:
      presses, touches: where each press is.
      seed: of the pixels drawn and of the folds.
      folds: of the cross-validation that chooses the degrees.

    Returns:
      The map, the moved touches, and what was chosen.
    """
    rng = np.random.default_rng(seed)
    chosen, colours = _fit_once(presses, touches, None, rng, folds)
    touches = recentre(presses, touches, colours)
    chosen, colours = _fit_once(presses, touches, colours, rng, folds)
    return colours, touches, chosen


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


def _fit_once(
    presses: BallPresses, touches: Touches, before: ColourMap | None, rng: np.random.Generator, folds: int
) -> tuple[ColourMapSettings, ColourMap]:
    """Gather pixels, choose degrees and ridge over folds, solve with all presses."""
    top = tuple(max(d) for d in zip(*DEGREES, strict=True))
    places = legendre(*presses.shape, top[1])
    rows = touches.stacked()
    samples = [_sample(presses, i, row, places, top[0], rng) for i, row in enumerate(rows)]
    if before is not None:
        samples = [_trust(s, before) for s in samples]
    grams = [_gram(s) for s in samples]
    chosen = _choose(grams, rng.permutation(len(grams)), folds)
    weights = _solve(grams, chosen)
    shape = (len(position_terms(chosen.position_degree)), len(colour_terms(chosen.degree)), 2)
    return chosen, ColourMap(
        weights=weights.reshape(shape).astype(np.float32), degree=chosen.degree, position_degree=chosen.position_degree
    )


def _sample(
    presses: BallPresses, i: int, row: np.ndarray, places: np.ndarray, degree: int, rng: np.random.Generator
) -> Samples:
    """Pixels of the ball, and about as many of the flat."""
    y, x = np.mgrid[: presses.shape[0], : presses.shape[1]].astype(float)
    away = np.hypot(x - row[0], y - row[1])
    ball, flat = (np.flatnonzero(mask) for mask in (away < INNER * row[2], away > FAR * row[2]))
    ball, flat = (rng.permutation(index)[:PIXELS] for index in (ball, flat))
    index = np.concatenate([ball, flat])
    seen = np.stack([c.ravel()[index] for c in change(presses.pictures[i], presses.background)]).astype(np.float64)
    normal = np.stack([row[0] - x.ravel()[index], row[1] - y.ravel()[index]], -1) * presses.mm_per_px
    normal = normal / presses.radius_mm
    normal[len(ball) :] = 0
    weight = np.concatenate([np.ones(len(ball)), np.full(len(flat), FLAT_WEIGHT)])
    return Samples(
        colour=colour_powers(seen, degree),
        position=places.reshape(len(places), -1)[:, index],
        normal=normal,
        weight=weight,
    )


def _trust(samples: Samples, colours: ColourMap) -> Samples:
    """Pixels that a map gets wrong count less: weight / (1 + (error / TRUSTED)²)."""
    terms = _kept(colours.degree, colours.position_degree)
    error = ((_design(samples)[:, terms] @ colours.weights.reshape(-1, 2) - samples.normal) ** 2).sum(-1)
    return dataclasses.replace(samples, weight=samples.weight / (1 + error / TRUSTED**2))


def _design(samples: Samples) -> np.ndarray:
    """Products of position and colour terms, [n, J·K]."""
    product = samples.position[:, None] * samples.colour[None]
    return product.reshape(-1, product.shape[-1]).T


def _gram(samples: Samples) -> Gram:
    """AᵀWA, AᵀWn, nᵀWn and the sum of the weights."""
    design = _design(samples)
    weighted = design * samples.weight[:, None]
    square = float((samples.weight * (samples.normal**2).sum(-1)).sum())
    return weighted.T @ design, weighted.T @ samples.normal, square, float(samples.weight.sum())


def _kept(degree: int, position_degree: int) -> np.ndarray:
    """Positions of the products of these degrees among those of the highest degree, int [J·K]."""
    top_colour, top_place = (max(d) for d in zip(*DEGREES, strict=True))
    all_terms = np.arange(len(position_terms(top_place)) * len(colour_terms(top_colour)))
    grid = all_terms.reshape(len(position_terms(top_place)), -1)
    return grid[: len(position_terms(position_degree)), : len(colour_terms(degree))].ravel()


def _choose(grams: list[Gram], order: np.ndarray, folds: int) -> ColourMapSettings:
    """Fewest constants whose held-out error is within a standard error over the folds of the least (Breiman's rule)."""
    tried = []
    for degree, position_degree in DEGREES:
        for ridge in RIDGES:
            trial = ColourMapSettings(degree=degree, position_degree=position_degree, ridge=ridge, error=0.0)
            by_fold = np.array([_fold_error(grams, order, k, folds, trial) for k in range(folds)])
            tried.append((dataclasses.replace(trial, error=float(by_fold.mean())), by_fold))
    best, by_fold = min(tried, key=lambda pair: pair[0].error)
    margin = float(by_fold.std(ddof=1)) / np.sqrt(folds)
    close = [choice for choice, _ in tried if choice.error <= best.error + margin]
    return min(close, key=lambda c: (len(_kept(c.degree, c.position_degree)), c.error))


def _fold_error(grams: list[Gram], order: np.ndarray, fold: int, folds: int, trial: ColourMapSettings) -> float:
    """Root mean square of the normal's error on left-out presses, √(Σ nᵀWn − 2 wᵀAᵀWn + wᵀAᵀWA w over Σ W)."""
    out = set(order[fold::folds].tolist())
    terms = _kept(trial.degree, trial.position_degree)
    weights = _solve([gram for i, gram in enumerate(grams) if i not in out], trial)
    total = count = 0.0
    for i in out:
        normal, right, square, n = grams[i]
        total += square - 2 * float((weights * right[terms]).sum())
        total += float((weights * (normal[np.ix_(terms, terms)] @ weights)).sum())
        count += n
    return float(np.sqrt(max(total, 0.0) / count))


def _solve(grams: list[Gram], choice: ColourMapSettings) -> np.ndarray:
    terms = _kept(choice.degree, choice.position_degree)
    left = sum((gram[0] for gram in grams), start=np.zeros_like(grams[0][0]))
    right = sum((gram[1] for gram in grams), start=np.zeros_like(grams[0][1]))
    normal = left[np.ix_(terms, terms)]
    ridge = choice.ridge * np.trace(normal) / len(normal)
    solved: np.ndarray = np.linalg.solve(normal + ridge * np.eye(len(normal)), right[terms])
    return solved
