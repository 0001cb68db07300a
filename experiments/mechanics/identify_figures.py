"""The figures of `identifiability`, made from the answers of all probes: accuracies and losses with their intervals."""

import dataclasses

import numpy as np

from experiments.mechanics.identify_motions import MotionData
from experiments.mechanics.identify_presses import PressData
from experiments.mechanics.identify_probes import ProbePredictions, accuracy, points
from experiments.mechanics.identify_studies import FUSED, SOURCES, STATIC, TransferPredictions
from sensors_io.schema import SENSORS
from touchr1_jax.bench.statistics import Interval


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyPredictions:
    """Answers of all probes, keyed as in `identify_studies`; `motion` and `still` by motion first, the press too.

    `solved`, `springs` and `exact` name the tiers, `noise` the multiples of the sensors' noise.
    """

    noise: tuple[float, ...]
    exact: str
    solved: tuple[str, ...]
    springs: str
    touch: dict[tuple[str, str, int], ProbePredictions]
    blind: dict[tuple[str, str], ProbePredictions]
    tiers: dict[tuple[str, str, str], TransferPredictions]
    motion: dict[str, dict[tuple[str, str], ProbePredictions]]
    still: dict[str, dict[tuple[str, str], ProbePredictions]]
    pressed: PressData
    moved: dict[str, MotionData]

    @property
    def own(self) -> int:
        """Level of the sensors' own noise."""
        return self.noise.index(1.0)

    def objects(self, motion: str) -> np.ndarray:
        """What was touched by each contact of a motion, [n]."""
        return self.pressed.objects if motion == "press" else self.moved[motion].objects

    def losses(self, tier: str, name: str, sources: tuple[str, ...]) -> np.ndarray:
        """Right answers about exact records less those by training at a tier instead, paired, [n, sources]."""
        exact = [self.touch[name, source, self.own].right for source in sources]
        cheap = [self.tiers[tier, name, source].exact.right for source in sources]
        return np.stack(exact, 1) - np.stack(cheap, 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProbeFigures:
    """Accuracies in % and losses in points, with intervals over objects.

    `told` by property, source and level of noise; `blind` by property and source; `lost` by tier and property, mean
    over sensors; `lost_by` by tier, property and source, without interval; `moved` by property and motion, of all
    sensors without force.
    """

    told: dict[tuple[str, str, int], Interval]
    blind: dict[tuple[str, str], Interval]
    lost: dict[tuple[str, str], Interval]
    lost_by: dict[tuple[str, str, str], float]
    moved: dict[tuple[str, str], Interval]


def figures(studied: StudyPredictions) -> ProbeFigures:
    """Every figure that tables, pictures and sentences share."""
    objects = studied.pressed.objects
    keys = [(tier, name) for tier in (*studied.solved, studied.springs) for name in STATIC]
    return ProbeFigures(
        told={key: accuracy(answers, objects) for key, answers in studied.touch.items()},
        blind={key: accuracy(answers, objects) for key, answers in studied.blind.items()},
        lost={key: points(studied.losses(*key, SENSORS), objects) for key in keys},
        lost_by={(*key, s): 100 * float(studied.losses(*key, (s,)).mean()) for key in keys for s in SOURCES},
        moved={
            (name, motion): accuracy(found, studied.objects(motion))
            for motion, answers in studied.motion.items()
            for (name, source), found in answers.items()
            if source == FUSED
        },
    )
