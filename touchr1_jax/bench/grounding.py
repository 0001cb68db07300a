"""Metrics of the use of touch: the loss without it, and the answers when sight and touch disagree.

Controls of touch: `drop` removes the streams, `shuffle` permutes their frames, `noise` replaces them by noise of the
sensor's statistics, `swapped` by another object's touch.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from touchr1_jax.bench.metrics import BOTTOM, Scores, accuracy, check_same_shape
from touchr1_jax.bench.statistics import TAILS, Interval, draw_clusters, drawn_means

CONTROLS = ("drop", "shuffle", "noise", "swapped")
"""Replacements of the touch."""

SHUFFLE = "shuffle"
"""The control that applies only where the answer depends on the order of the frames."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LeastGain:
    """The control against which touch gains least, the gain in points, and its interval over objects."""

    control: str
    gain: Interval


def tactile_use_gain(real: Scores, control: Scores) -> Scores:
    """TUG_c, score(T) − score(T_c), as paired differences whose mean is the gain.

    Args:
      real: scores of the answers given the touch, higher is better.
      control: those of the same answers given control c.

    Raises:
      ValueError: the two were not scored on the same answers.
    """
    same = np.array_equal(real.items, control.items) and np.array_equal(real.strata, control.strata)
    if not same:
        raise ValueError(
            f"real and control hold {len(real.items)} and {len(control.items)} values: they must be of the same "
            "answers; score both on the same questions"
        )
    return dataclasses.replace(real, values=real.values - control.values)


def least_tactile_use(
    real: Scores,
    controls: Mapping[str, Scores],
    ordered: np.ndarray,
    objects: np.ndarray,
    *,
    resamples: int = 10_000,
) -> LeastGain:
    """The headline, min_c TUG_c over drop, noise and swapped, and shuffle on order-dependent questions only.

    A shuffled press still shows its peak, so `shuffle` counts only where `ordered` says so, and not at all where no
    question does.  The interval takes the minimum anew in each resample of the objects; it is pessimistic where
    several controls gain alike, which suits the claim that no control does better.

    Args:
      real: as for `tactile_use_gain`.
      controls: one of `CONTROLS` → its scores.
      ordered: bool [N], true where the answer depends on the order of the frames.
      objects: [N], the object of each question.

    Raises:
      ValueError: a control that is unknown or missing, or fewer than two objects.
    """
    if set(controls) != set(CONTROLS):
        raise ValueError(f"controls are {sorted(controls)}: must be {', '.join(CONTROLS)}; run each of them once")
    gains = {name: tactile_use_gain(real, controls[name]) for name in CONTROLS}
    gains[SHUFFLE] = _only(gains[SHUFFLE], ordered)
    if not len(gains[SHUFFLE].values):
        del gains[SHUFFLE]
    cluster, weights = draw_clusters(objects, resamples=resamples)
    drawn = np.stack([drawn_means(g.values, cluster[g.items], g.strata, weights) for g in gains.values()])
    low, high = np.nanquantile(np.fmin.reduce(drawn), TAILS)
    least = min(gains, key=lambda name: gains[name].mean())
    return LeastGain(control=least, gain=Interval(mean=gains[least].mean(), low=float(low), high=float(high)))


def conflict_accuracy(answer: np.ndarray, label: np.ndarray, prior: np.ndarray) -> Scores:
    """Conflict-Acc, 100·mean 1[ŷ = y] over the questions whose visual prior names another level than the label.

    Args:
      answer, label: int [N].
      prior: int [N], what the picture alone suggests; ⊥ where it suggests nothing, which is no conflict.
    """
    check_same_shape(answer=answer, label=label, prior=prior)
    conflict = (prior != BOTTOM) & (prior != label)
    return accuracy(answer, np.where(conflict, label, BOTTOM))


def revision_rate(answer: np.ndarray, label: np.ndarray, prior: np.ndarray) -> Scores:
    """100·mean over the same questions of 1[ŷ ≠ prior]: how often touch changes what sight suggests, right or not.

    Conflict-Acc is at most this rate, since the right answer is a revised one.  ⊥ revises nothing.

    Args:
      answer, label, prior: int [N], as for `conflict_accuracy`.
    """
    scored = conflict_accuracy(answer, label, prior)
    revised = (answer != prior) & (answer != BOTTOM)
    return dataclasses.replace(scored, values=100.0 * revised[scored.items])


def _only(scores: Scores, questions: np.ndarray) -> Scores:
    """The values that belong to some of the questions."""
    keep = questions[scores.items]
    return Scores(values=scores.values[keep], items=scores.items[keep], strata=scores.strata[keep])
