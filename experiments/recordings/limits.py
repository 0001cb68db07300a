"""Limits of the answers: growth with the number of objects, and agreement of the labels themselves."""

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Int

from experiments.core.context import Context
from experiments.recordings.descriptions import Described
from experiments.recordings.evidence import standardise
from experiments.recordings.learning import Background, LearnConfig, evidence_alone
from experiments.recordings.policy import LEVELS
from experiments.recordings.validation import Row, intervals
from touchr1_jax.bench.statistics import Interval

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the training objects, that the probes learn from."""


def cross_answers(
    config: LearnConfig,
    videos: Described,
    background: Background,
    fold: np.ndarray,
    context: Context,
    share: float = 1.0,
) -> Int[np.ndarray, "n A"]:
    """Answers of the probes alone, each fold read by probes on a share of the objects of the other folds."""
    answer = np.zeros_like(videos.label)
    for k in context.each("probes", np.unique(fold)):
        names = np.unique(videos.objects[fold != k])
        kept = np.random.default_rng(0).permutation(names)[: max(1, round(share * len(names)))]
        training = videos.rows(np.flatnonzero(np.isin(videos.objects, kept)))
        answer[fold == k] = evidence_alone(config, training, background, videos.rows(np.flatnonzero(fold == k)))
    return answer


def growth(
    config: LearnConfig, videos: Described, background: Background, fold: np.ndarray, context: Context
) -> dict[int, dict[str, Interval]]:
    """Scores of the probes by the number of objects that they learn from."""
    objects = np.mean([len(np.unique(videos.objects[fold != k])) for k in np.unique(fold)])
    return {
        round(share * objects): intervals(
            cross_answers(config, videos, background, fold, context, share), videos.label, videos.objects
        )
        for share in context.each("shares of the objects", SHARES)
    }


def objects_for(errors: Mapping[int, float], bound: float) -> float:
    """Objects to learn from for which the error falls to a bound, by the power law through what was measured.

        ln e(n) = a − b ln n by least squares;   n = exp((a − ln bound) / b)

    The form of learning curves in Hestness et al. 2017, taken without a floor; one that exists makes this too few.

    Args:
      errors: objects learned from → error, at two numbers of objects or more.
      bound: error to reach, > 0.

    Returns:
      Objects: the fewest at which the bound was measured, else extrapolated; infinite where the error does not fall.
    """
    reached = [n for n, error in errors.items() if error <= bound]
    if reached:
        return min(reached)
    slope, start = np.polyfit(np.log(list(errors)), np.log(list(errors.values())), 1)
    return math.exp((math.log(bound) - start) / slope) if slope < 0 else math.inf


def vote(answer: Int[np.ndarray, "n A"], objects: np.ndarray) -> Int[np.ndarray, "n A"]:
    """For every video the level that its object's videos are answered most often, the lowest of equals."""
    voted = answer.copy()
    for name in np.unique(objects):
        mine = objects == name
        voted[mine] = [np.bincount(column, minlength=LEVELS).argmax() for column in answer[mine].T]
    return voted


def label_limits(
    config: LearnConfig, videos: Described, background: Background, fold: np.ndarray, context: Context
) -> list[Row]:
    """Answers that bound what can be told.

    - *vote*: the answers of the probes, those of an object's videos pooled.  What is wrong then is no matter of trials.

    - *the object was touched before*: probes on all other videos, those of the same object among them.  What is wrong
      then is wrong because trials of one object differ more than objects of different labels do.
    - *nearest other object*: the labels of the object whose mean description lies nearest.  What is wrong then is how
      often objects that feel alike, by this description, were judged differently.
    """
    known = np.zeros_like(videos.label)
    for i in context.each("touched before", range(len(videos.names))):
        rest = videos.rows(np.flatnonzero(np.arange(len(videos.names)) != i))
        known[i] = evidence_alone(config, rest, background, videos.rows(np.array([i])))
    answer = cross_answers(config, videos, background, fold, context)
    return [
        Row(name="probes", answer=answer),
        Row(name="probes, vote over all videos of an object", answer=vote(answer, videos.objects)),
        Row(name="probes, the object was touched before", answer=known),
        Row(
            name="labels of the nearest other object", answer=videos.label[_nearest_other(videos, config.evidence.clip)]
        ),
    ]


def _nearest_other(videos: Described, clip: float) -> Int[np.ndarray, "n"]:
    """A video of the object nearest to that of each video."""
    z = standardise(videos.x.astype(np.float64), np.ones(len(videos.names), bool), clip)
    names, first, member = np.unique(videos.objects, return_index=True, return_inverse=True)
    centre = np.stack([z[member == i].mean(0) for i in range(len(names))])
    distance = np.linalg.norm(centre[:, None] - centre, axis=-1)
    np.fill_diagonal(distance, np.inf)
    return first[distance.argmin(1)][member]


def agreement(answer: Int[np.ndarray, "n A"], objects: np.ndarray) -> float:
    """Per cent of pairs of videos of one object that are answered alike in all attributes."""
    same, pairs = 0.0, 0
    for name in np.unique(objects):
        mine = answer[objects == name]
        alike = (mine[:, None] == mine[None]).all(-1)
        same += (alike.sum() - len(mine)) / 2
        pairs += len(mine) * (len(mine) - 1) // 2
    return 100 * same / max(pairs, 1)
