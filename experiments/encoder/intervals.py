"""Intervals over objects for what the encoder studies report."""

import numpy as np

from touchr1_jax.bench.statistics import Interval, clustered_bootstrap

RESAMPLES = 2000
"""Of each interval: its ends are then good to a tenth of its width."""


def points(values: np.ndarray, objects: np.ndarray) -> Interval:
    """Mean in points of values [n] or [n, A] of n contacts, over objects [n]."""
    clusters = np.repeat(objects, values[0].size)
    return clustered_bootstrap(100.0 * values.astype(float).ravel(), clusters, resamples=RESAMPLES)


def skill(error: np.ndarray, reference: np.ndarray, objects: np.ndarray, *, seed: int = 0) -> Interval:
    """1 − Σ error / Σ reference of n contacts, and its interval when whole objects are resampled.

    Args:
      error, reference: [n] of the same contacts, reference > 0 in sum.
      objects: [n].

    Raises:
      ValueError: a reference without error, against which no skill is defined.
    """
    if not reference.sum() > 0:
        raise ValueError(f"reference sums to {reference.sum()}: must be > 0, or no skill is defined; choose another")
    names, group = np.unique(objects, return_inverse=True)
    sums = np.zeros((len(names), 2))
    np.add.at(sums, group, np.stack([error, reference], 1).astype(float))
    weights = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)), RESAMPLES)
    drawn = weights @ sums
    low, high = np.quantile(1 - drawn[:, 0] / drawn[:, 1], (0.025, 0.975))
    return Interval(mean=float(1 - error.sum() / reference.sum()), low=float(low), high=float(high))
