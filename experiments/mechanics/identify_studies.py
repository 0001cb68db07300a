"""The three studies of `identifiability`: over noise, from tier to tier, and by motion; each a dict of answers."""

import dataclasses
import itertools
from collections.abc import Callable
from collections.abc import Sequence as Seq

import numpy as np

from experiments.mechanics.identify_motions import MotionData
from experiments.mechanics.identify_presses import PressData
from experiments.mechanics.identify_probes import ProbePredictions, fuse, transfer
from experiments.mechanics.identify_threads import in_threads
from experiments.mechanics.identify_touch import ContactTier
from sensors_io.schema import SENSORS
from touchr1_jax.training.evidence import ProbeConfig

STATIC = ("hardness", "roughness", "protrusion")
"""What a press may tell."""

DYNAMIC = ("elasticity", "friction")
"""What takes unloading or sliding."""

FUSED, SHAPE, FORCE = "all four", "shape alone", "force alone"
SOURCES = (*SENSORS, FUSED)

Advance = Callable[[], object]


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
      moved: what was touched.
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
