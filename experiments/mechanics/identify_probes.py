"""Probes that are tested on unseen objects, on the records that they were trained on and on others."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Seq

import numpy as np
from jaxtyping import Float, Int

from experiments.core.concurrency import in_threads
from experiments.mechanics.identify_features import ContactData
from sensors_io.schema import SENSORS
from touchr1_jax.training.linear_probe import ProbeConfig, group_folds, probe_log_probs

LEVELS = 3

STATIC = ("hardness", "roughness", "protrusion")
"""Properties that a press determines."""

DYNAMIC = ("elasticity", "friction")
"""Properties that require unloading or sliding."""

FUSED, SHAPE, FORCE = "all four", "shape alone", "force alone"
SOURCES = (*SENSORS, FUSED)

Advance = Callable[[], object]


@dataclasses.dataclass(frozen=True)
class ProbePredictions:
    """Log-probabilities [n, K] of a probe for n held-out contacts, and the true levels [n]."""

    log_probs: np.ndarray
    labels: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """1 where the likeliest level is the true one, float [n]."""
        return (self.log_probs.argmax(-1) == self.labels).astype(float)

    @property
    def far_off(self) -> float:
        """Share of contacts in % that are placed two levels away."""
        return 100 * float(np.mean(np.abs(self.log_probs.argmax(-1) - self.labels) > 1))


Answers = Mapping[tuple[str, str], ProbePredictions]
"""Property and source → predictions."""


def fuse(answers: Seq[ProbePredictions]) -> ProbePredictions:
    """All sensors together as if their errors were independent: the product of their probabilities."""
    return ProbePredictions(np.sum([a.log_probs for a in answers], axis=0), answers[0].labels)


def transfer(
    train: Float[np.ndarray, "n D"],
    tests: Seq[Float[np.ndarray, "n D"]],
    labels: Int[np.ndarray, "n"],
    objects: np.ndarray,
    config: ProbeConfig,
) -> list[ProbePredictions]:
    """Predictions for the training records themselves, held out by object, and for the same contacts in other records.

    The probe that predicts contact i, from `train` and from each of `tests`, features of the same contacts by other
    means, was trained on no contact of its object, [n].  The folds are those of `linear_probe.cross_fit`.

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


def answers(
    records: Seq[Mapping[str, np.ndarray]], names: Seq[str], data: ContactData, config: ProbeConfig, advance: Advance
) -> Seq[Answers]:
    """Answers to the properties `names` from each of the records, by probes that are trained on the first of them.

    Records are features [n, D] of the same contacts by source; of `SENSORS` all four together are a source too.
    `advance` is called after each probe.
    """
    jobs = list(itertools.product(names, records[0]))

    def work(job: tuple[str, str]) -> list[ProbePredictions]:
        name, source = job
        train, *tests = (features[source] for features in records)
        return transfer(train, tests, data.levels[name], data.objects, config)

    every = zip(*in_threads(work, jobs, advance), strict=True)
    found = [dict(zip(jobs, about, strict=True)) for about in every]
    if set(SENSORS) <= records[0].keys():
        for one in found:
            one |= {(name, FUSED): fuse([one[name, sensor] for sensor in SENSORS]) for name in names}
    return found
