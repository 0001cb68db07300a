"""Probes that are tested on unseen objects: over noise, from tier to tier, by motion and without touch."""

import dataclasses
import itertools
from collections.abc import Callable, Iterable
from collections.abc import Sequence as Seq
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from experiments.mechanics.identify_features import ContactData, in_threads
from experiments.mechanics.identify_presses import ContactTier, PressData
from sensors_io.schema import SENSORS
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.training.linear_probe import ProbeConfig, group_folds, probe_log_probs

LEVELS = 3

RESAMPLES = 2000
"""Bootstrap resamples of each interval: its ends are then good to a tenth of its width."""

STATIC = ("hardness", "roughness", "protrusion")
"""Properties that a press determines."""

DYNAMIC = ("elasticity", "friction")
"""Properties that require unloading or sliding."""

FUSED, SHAPE, FORCE = "all four", "shape alone", "force alone"
SOURCES = (*SENSORS, FUSED)

Advance = Callable[[], object]
Answer = TypeVar("Answer")


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

    The probe that predicts contact i, from `train` and from each of `tests`, was trained on no contact of its object.
    The folds are those of `linear_probe.cross_fit`.

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

    def work(job: tuple[str, str, int]) -> ProbePredictions:
        name, sensor, level = job
        return held_out(pressed.features(exact, SENSORS.index(sensor), level), name, pressed, config)

    found = _by_job(work, itertools.product(STATIC, SENSORS, range(levels)), advance)
    keys = itertools.product(STATIC, range(levels))
    return found | {(n, FUSED, level): fuse([found[n, sensor, level] for sensor in SENSORS]) for n, level in keys}


def from_tiers(
    pressed: PressData,
    tiers: Seq[ContactTier],
    exact: ContactTier,
    noise_level: int,
    config: ProbeConfig,
    advance: Advance,
) -> dict[tuple[str, str, str], TransferPredictions]:
    """Answers by tier, property and source; the exact records are taken at `noise_level`, the tiers' at their only."""
    by_name = {tier.name: tier for tier in tiers}

    def work(job: tuple[str, str, str]) -> TransferPredictions:
        tier, name, sensor = job
        order = SENSORS.index(sensor)
        train, test = pressed.features(by_name[tier], order), pressed.features(exact, order, noise_level)
        return TransferPredictions(*transfer(train, [test], pressed.levels[name], pressed.objects, config))

    found = _by_job(work, itertools.product(by_name, STATIC, SENSORS), advance)
    for tier, name in itertools.product(by_name, STATIC):
        each = [found[tier, name, sensor] for sensor in SENSORS]
        found[tier, name, FUSED] = TransferPredictions(fuse([t.own for t in each]), fuse([t.exact for t in each]))
    return found


def without_touch(
    data: ContactData, names: Seq[str], config: ProbeConfig, advance: Advance
) -> dict[tuple[str, str], ProbePredictions]:
    """Answers by property from the true shape alone and from the measured forces alone."""
    blind = {SHAPE: data.shape, FORCE: data.force.reshape(len(data.force), -1)}
    return _by_job(lambda job: held_out(blind[job[1]], job[0], data, config), itertools.product(names, blind), advance)


def by_motion(
    touch: Seq[np.ndarray], moved: ContactData, config: ProbeConfig, advance: Advance
) -> dict[tuple[str, str], ProbePredictions]:
    """Answers about the dynamic properties by property and source, of touch without force.

    Args:
      touch: features of each sensor, [n, D].
      moved: the contacts.
    """
    work = lambda job: held_out(touch[SENSORS.index(job[1])], job[0], moved, config)
    found = _by_job(work, itertools.product(DYNAMIC, SENSORS), advance)
    return found | {(name, FUSED): fuse([found[name, sensor] for sensor in SENSORS]) for name in DYNAMIC}


def held_out(features: np.ndarray, name: str, data: ContactData, config: ProbeConfig) -> ProbePredictions:
    """Answers about one property of objects that no probe was trained on."""
    (answers,) = transfer(features, [], data.levels[name], data.objects, config)
    return answers


def _by_job(work: Callable[[Any], Answer], jobs: Iterable[Any], advance: Advance) -> dict[Any, Answer]:
    listed = list(jobs)
    return dict(zip(listed, in_threads(work, listed, advance), strict=True))
