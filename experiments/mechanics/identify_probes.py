"""Probes that are tested on unseen objects: over noise, from tier to tier, by motion and without touch."""

import dataclasses
import itertools
from collections.abc import Callable
from collections.abc import Sequence as Seq

import numpy as np
from jaxtyping import Float, Int

from experiments.mechanics.identify_features import in_threads
from experiments.mechanics.identify_motions import MotionData
from experiments.mechanics.identify_presses import ContactTier, PressData
from sensors_io.schema import SENSORS
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.training.linear_probe import ProbeConfig, group_folds, probe_log_probs

LEVELS = 3

RESAMPLES = 2000
"""Of each interval: its ends are then good to a tenth of its width."""


STATIC = ("hardness", "roughness", "protrusion")
"""Properties that a press can tell."""

DYNAMIC = ("elasticity", "friction")
"""Properties that take unloading or sliding."""

FUSED, SHAPE, FORCE = "all four", "shape alone", "force alone"
SOURCES = (*SENSORS, FUSED)

Advance = Callable[[], object]


@dataclasses.dataclass(frozen=True)
class ProbePredictions:
    """Log-probabilities [n, K] that a probe gives n held-out contacts, and the true levels [n]."""

    log_probs: np.ndarray
    labels: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """1 where the likeliest level is the true one, float [n]."""
        return (self._predicted == self.labels).astype(float)

    @property
    def far_off(self) -> float:
        """Share of contacts in % that are placed two levels away."""
        return 100 * float(np.mean(np.abs(self._predicted - self.labels) > 1))

    @property
    def _predicted(self) -> np.ndarray:
        level: np.ndarray = self.log_probs.argmax(-1)
        return level


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
    """Predictions for the training records themselves, held out by object, and for the same contacts in other records.

    Contact i is read by the probe that no contact of its object trained, from `train` and from each of `tests`.  The
    folds are those of `evidence.cross_fit`.

    Args:
      train: features of n contacts.
      tests: features of the same contacts by other means, such as another tier.
      labels: 0 … 2.
      objects: object of each contact, [n].
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


@dataclasses.dataclass(frozen=True)
class TransferPredictions:
    """Answers of probes trained at one tier: about that tier's own records, and about the exact ones."""

    own: ProbePredictions
    exact: ProbePredictions


def over_noise(
    pressed: PressData, exact: ContactTier, levels: int, config: ProbeConfig, advance: Advance
) -> dict[tuple[str, str, int], ProbePredictions]:
    """Answers by property, source and level of noise, each from probes that were trained at that level."""
    jobs = list(itertools.product(STATIC, range(levels), range(len(SENSORS))))

    def work(job: tuple[str, int, int]) -> ProbePredictions:
        name, level, order = job
        return _held_out(pressed.features(exact, order, level), pressed.levels[name], pressed.objects, config)

    found = dict(zip(jobs, in_threads(work, jobs, advance), strict=True))
    answers = {(name, SENSORS[order], level): answer for (name, level, order), answer in found.items()}
    for name, level in itertools.product(STATIC, range(levels)):
        answers[name, FUSED, level] = fuse([found[name, level, order] for order in range(len(SENSORS))])
    return answers


def from_tiers(
    pressed: PressData,
    tiers: Seq[ContactTier],
    exact: ContactTier,
    noise_level: int,
    config: ProbeConfig,
    advance: Advance,
) -> dict[tuple[str, str, str], TransferPredictions]:
    """Answers by tier, property and source; the exact records are taken at `noise_level`, the tiers' at their only."""
    jobs = list(itertools.product(tiers, STATIC, range(len(SENSORS))))

    def work(job: tuple[ContactTier, str, int]) -> TransferPredictions:
        tier, name, order = job
        train, test = pressed.features(tier, order), pressed.features(exact, order, noise_level)
        return TransferPredictions(*transfer(train, [test], pressed.levels[name], pressed.objects, config))

    found = dict(zip(jobs, in_threads(work, jobs, advance), strict=True))
    answers = {(tier.name, name, SENSORS[order]): answer for (tier, name, order), answer in found.items()}
    for tier, name in itertools.product(tiers, STATIC):
        each = [found[tier, name, order] for order in range(len(SENSORS))]
        answers[tier.name, name, FUSED] = TransferPredictions(
            fuse([t.own for t in each]), fuse([t.exact for t in each])
        )
    return answers


def without_touch(
    pressed: PressData | MotionData, names: Seq[str], config: ProbeConfig, advance: Advance
) -> dict[tuple[str, str], ProbePredictions]:
    """Answers by property from the true shape alone and from the measured forces alone."""
    blind = {SHAPE: pressed.shape, FORCE: pressed.force.reshape(len(pressed.force), -1)}
    jobs = list(itertools.product(names, blind))
    work = lambda job: _held_out(blind[job[1]], pressed.levels[job[0]], pressed.objects, config)
    return dict(zip(jobs, in_threads(work, jobs, advance), strict=True))


def by_motion(
    touch: Seq[np.ndarray], moved: PressData | MotionData, config: ProbeConfig, advance: Advance
) -> dict[tuple[str, str], ProbePredictions]:
    """Answers about the dynamic properties by property and source, of touch without force.

    Args:
      touch: features of each sensor, [n, D].
      moved: the contacts.
    """
    jobs = list(itertools.product(DYNAMIC, range(len(SENSORS))))
    work = lambda job: _held_out(touch[job[1]], moved.levels[job[0]], moved.objects, config)
    found = dict(zip(jobs, in_threads(work, jobs, advance), strict=True))
    answers = {(name, SENSORS[order]): answer for (name, order), answer in found.items()}
    for name in DYNAMIC:
        answers[name, FUSED] = fuse([found[name, order] for order in range(len(SENSORS))])
    return answers


def _held_out(features: np.ndarray, labels: np.ndarray, objects: np.ndarray, config: ProbeConfig) -> ProbePredictions:
    (answers,) = transfer(features, [], labels, objects, config)
    return answers
