"""Probes that are asked about objects they never felt, also by another tier than they were trained on."""

import dataclasses
from collections.abc import Sequence as Seq

import numpy as np
from jaxtyping import Float, Int

from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.training.evidence import ProbeConfig, group_folds, probe_log_probs

LEVELS = 3

RESAMPLES = 2000
"""Of each interval: its ends are then good to a tenth of its width."""


@dataclasses.dataclass(frozen=True)
class ProbePredictions:
    """What a probe says of n held-out contacts: log-probabilities [n, K], and the true levels [n]."""

    log_probs: np.ndarray
    labels: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """1 where the likeliest level is the true one, float [n]."""
        return (self._said == self.labels).astype(float)

    @property
    def far_off(self) -> float:
        """Share of contacts in % that are placed two levels away."""
        return 100 * float(np.mean(np.abs(self._said - self.labels) > 1))

    @property
    def _said(self) -> np.ndarray:
        said: np.ndarray = self.log_probs.argmax(-1)
        return said


def fuse(answers: Seq[ProbePredictions]) -> ProbePredictions:
    """All sensors together as if they erred independently: the product of their probabilities."""
    return ProbePredictions(np.sum([a.log_probs for a in answers], axis=0), answers[0].labels)


def transfer(
    train: Float[np.ndarray, "n D"],
    tests: Seq[Float[np.ndarray, "n D"]],
    labels: Int[np.ndarray, "n"],
    objects: np.ndarray,
    config: ProbeConfig,
) -> list[ProbePredictions]:
    """Answers about the training records themselves, held out by object, and about the same contacts in other records.

    Contact i is read by the probe that no contact of its object trained, from `train` and from each of `tests`.  The
    folds are those of `evidence.cross_fit`.

    Args:
      train: features of n contacts.
      tests: features of the same contacts by other means, such as another tier.
      labels: 0 … 2.
      objects: what was touched, [n].
      config: folds and fit.

    Raises:
      ValueError: fewer objects than folds.
    """
    fold = group_folds(objects, config, "objects")
    copies = 1 + len(tests)
    trained = fold != np.arange(config.folds)[:, None]
    weights = np.concatenate([trained, np.zeros((config.folds, len(fold) * (copies - 1)), bool)], 1)
    found = probe_log_probs(np.concatenate([train, *tests]), np.tile(labels, copies), weights, LEVELS, config)
    blocks = found.reshape(config.folds, copies, len(fold), LEVELS)
    return [ProbePredictions(blocks[fold, copy, np.arange(len(fold))], labels) for copy in range(copies)]


def accuracy(answers: ProbePredictions, objects: np.ndarray) -> Interval:
    """Share of right answers in %, with the interval over objects."""
    return points(answers.right, objects)


def points(values: np.ndarray, objects: np.ndarray) -> Interval:
    """Mean of values [n] or [n, S] in points, with the interval over objects [n]."""
    clusters = np.repeat(objects, values[0].size)
    return clustered_bootstrap(100 * values.ravel(), clusters, resamples=RESAMPLES)
