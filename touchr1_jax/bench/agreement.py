"""Agreement between two people, and the share of things that passed, each with what chance and number allow."""

import math
from typing import Literal

import numpy as np
from scipy import special

from touchr1_jax.bench.statistics import Interval


def cohens_kappa(a: np.ndarray, b: np.ndarray, levels: int, *, weights: Literal["none", "quadratic"] = "none") -> float:
    """κ = 1 − Σ w_ij o_ij / Σ w_ij e_ij over the K × K table o of two raters, e the product of its margins.

    w_ij = 1[i ≠ j] without weights, (i − j)² with quadratic ones, which forgive the neighbouring level.

    Args:
      a, b: int [n], levels 0..K−1 of the same things.
      levels: K.

    Raises:
      ValueError: lengths differ or are 0, a level outside 0..K−1, or both raters gave everything the same one level,
        where κ is 0/0.

    Source: Cohen, Educ. Psychol. Meas. 20 (1960); the weights, Psychol. Bull. 70 (1968).
    """
    if not len(a) == len(b) or not len(a):
        raise ValueError(
            f"a and b have lengths {len(a)} and {len(b)}: they must be equal and ≥ 1; rate the same things"
        )
    both = np.concatenate([a, b])
    if both.min() < 0 or both.max() >= levels:
        raise ValueError(f"levels range from {both.min()} to {both.max()}: must lie in 0..{levels - 1}; correct them")
    table = np.zeros((levels, levels))
    np.add.at(table, (a, b), 1 / len(a))
    i = np.arange(levels)
    weight = (i[:, None] != i).astype(float) if weights == "none" else (i[:, None] - i) ** 2.0
    expected = float((weight * np.outer(table.sum(1), table.sum(0))).sum())
    if expected == 0:
        raise ValueError(f"both raters gave level {both[0]} throughout: κ is undefined; rate things that differ")
    return 1 - float((weight * table).sum()) / expected


def wilson_interval(passed: int, of: int, *, level: float = 0.95) -> Interval:
    """A share and its score interval, (p̂ + z²/2n ± z √(p̂(1 − p̂)/n + z²/4n²)) / (1 + z²/n); never empty at 0 or 1.

    Args:
      passed: number that passed, 0..n.
      of: n ≥ 1.

    Raises:
      ValueError: such numbers are impossible.

    Source: Wilson, J. Am. Stat. Assoc. 22 (1927).
    """
    if not 0 <= passed <= of or of < 1:
        raise ValueError(f"passed is {passed} of {of}: must lie in 0..n with n ≥ 1; count again")
    z, p = float(special.ndtri((1 + level) / 2)), passed / of
    middle = (p + z * z / (2 * of)) / (1 + z * z / of)
    half = z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of)) / (1 + z * z / of)
    return Interval(mean=p, low=middle - half, high=middle + half)
