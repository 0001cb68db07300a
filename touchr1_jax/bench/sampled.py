"""Metrics of several sampled answers to each question: pass@k, majority votes, calibration, decision rules."""

from typing import Literal, NamedTuple

import numpy as np

from touchr1_jax.bench.metrics import BOTTOM

DecisionRule = Literal["argmax", "median", "expected"]
"""Level that is answered from a distribution over levels: the likeliest, the median, or the rounded mean.

They are best for accuracy, for the absolute error and for the squared error.
"""


def decide(share: np.ndarray, rule: DecisionRule) -> np.ndarray:
    """Level, int [N], by a decision rule; `BOTTOM` where the distribution is zero throughout.

    Args:
      share: float [N, K], probability of each level, up to a factor.
      rule: see `DecisionRule`; between two equally good levels the lower one.
    """
    total = share.sum(-1)
    p = share / np.where(total > 0, total, 1.0)[:, None]
    if rule == "argmax":
        level = p.argmax(-1)
    elif rule == "median":
        level = (np.cumsum(p, -1) >= 0.5 - 1e-6).argmax(-1)
    else:
        level = np.ceil(p @ np.arange(p.shape[1]) - 0.5 - 1e-6).astype(int)
    return np.where(total > 0, level, BOTTOM)


class Votes(NamedTuple):
    """The most frequent answer to each of N questions among its samples.

    `right` [N] is true where it answers every asked attribute right, `confidence` [N] is the share of the samples that
    give it; 0, and wrong, where no sample could be parsed.
    """

    right: np.ndarray
    confidence: np.ndarray


class Bin(NamedTuple):
    """Answers of similar confidence: its mean, the share of right answers, and their number."""

    confidence: float
    right: float
    number: int


def samples_right(sampled: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Samples, bool [N, n], that answer every asked attribute right.

    Args:
      sampled: int [N, n, A], conclusions of n samples, `BOTTOM` where unparsed.
      label: int [N, A], `BOTTOM` where not asked.
    """
    asked = (label != BOTTOM)[:, None]
    return np.all((sampled == label[:, None]) | ~asked, -1) & asked.any(-1)


def pass_at_k(right: np.ndarray, k: int) -> np.ndarray:
    """Probability [N] that one of k samples is right, 1 − C(n − c, k)/C(n, k) of c right ones among n, unbiased.

    Args:
      right: bool [N, n].
      k: 1 … n.

    Raises:
      ValueError: k is no such number.

    Source: Chen et al., arXiv 2107.03374, eq. 1.
    """
    n = right.shape[1]
    if not 1 <= k <= n:
        raise ValueError(f"k is {k}: must be 1 … {n}, the number of samples; draw more")
    wrong = n - right.sum(1)
    return 1 - np.prod([np.maximum(wrong - i, 0) / (n - i) for i in range(k)], axis=0)


def majority(sampled: np.ndarray, label: np.ndarray) -> Votes:
    """Votes of the samples (maj@n, arXiv 2203.11171); among equals the answer that was sampled first wins.

    Args:
      sampled, label: as in `samples_right`.
    """
    asked = (label != BOTTOM)[:, None]
    parsed = np.all((sampled != BOTTOM) | ~asked, -1)
    same = np.all((sampled[:, :, None] == sampled[:, None]) | ~asked[:, :, None], -1)
    votes = (same & parsed[:, None]).sum(-1) * parsed
    best = votes.argmax(1)[:, None]
    right = np.take_along_axis(samples_right(sampled, label), best, 1)[:, 0]
    confidence = np.take_along_axis(votes, best, 1)[:, 0] / sampled.shape[1]
    return Votes(right=right & (confidence > 0), confidence=confidence)


def reliability(votes: Votes, bins: int = 10) -> tuple[Bin, ...]:
    """Bins of equal width in confidence, without the empty ones; a calibrated policy has `confidence` = `right`.

    A bin holds its lower end, the last one both; in the source of `calibration_error` a bin holds its upper end.
    """
    place = np.minimum((votes.confidence * bins + 1e-9).astype(int), bins - 1)  # 100 · 29/50 rounds to below 58
    found = [place == b for b in np.unique(place)]
    return tuple(Bin(float(votes.confidence[at].mean()), float(votes.right[at].mean()), int(at.sum())) for at in found)


def calibration_error(votes: Votes, bins: int = 10) -> float:
    """ECE = Σ_b n_b/N |right_b − confidence_b| over `reliability` (Guo et al., arXiv 1706.04599, eq. 3)."""
    return sum(b.number * abs(b.right - b.confidence) for b in reliability(votes, bins)) / len(votes.right)
