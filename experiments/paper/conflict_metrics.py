"""Whom a policy believes when sight and touch differ, and what its answers lose without touch.

A question is *deceptive* where the object was made to look like another and what pictures suggest is not the answer.
What they suggest to one seed is what most of the policies without touch of the *other* seeds say: so the policy without
touch that stands in the table did not decide by its own mistakes what is deceptive.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int

from experiments.paper.deltas import pooled
from experiments.study.answers import Evaluated
from touchr1_jax.bench.grounding import CONTROLS, LeastGain, least_tactile_use, revision_rate, tactile_use_gain
from touchr1_jax.bench.metrics import BOTTOM, ORDINAL, Scores, accuracy, keep_scored
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap, student_interval

RESAMPLES = 2_000
"""Of each interval over objects: its ends are then good to a tenth of its width."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asked:
    """N questions about single touches: attribute, right level, object, whether it looks like what it is not."""

    attribute: Int[np.ndarray, "N"]
    label: Int[np.ndarray, "N"]
    objects: np.ndarray
    lies: Bool[np.ndarray, "N"]
    names: tuple[str, ...]

    @property
    def ordinal(self) -> Bool[np.ndarray, "N"]:
        """Questions for hardness, roughness or protrusion."""
        return np.isin(np.array(self.names)[self.attribute], ORDINAL)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contrast:
    """Accuracy of one policy over another on some questions, percent.

    `questions` is their mean number over seeds.
    """

    questions: float
    ours: float
    theirs: float
    seeds: Interval
    objects: Interval


def asked_of(said: Evaluated, object_ids: np.ndarray, lies: np.ndarray, names: tuple[str, ...]) -> Asked:
    """The questions that a policy was asked.

    Args:
      said: its answers.
      object_ids, lies: of the contacts that `said.contact` counts.
      names: the attributes.
    """
    n = np.arange(len(said.contact))
    return Asked(
        attribute=said.attribute,
        label=said.label[n, said.attribute],
        objects=object_ids[said.contact],
        lies=lies[said.contact],
        names=names,
    )


def spoken(said: Evaluated) -> Int[np.ndarray, "N"]:
    """The level that each answer concludes for what was asked, −1 for ⊥."""
    return np.asarray(said.parsed.conclude)[np.arange(len(said.contact)), said.attribute]


def suggested(blind: Sequence[np.ndarray]) -> list[Int[np.ndarray, "N"]]:
    """For every seed what most policies without touch of the other seeds say, the lower level of equal ones.

    Args:
      blind: int [N] of every seed.

    Raises:
      ValueError: fewer than two seeds.
    """
    if len(blind) < 2:
        raise ValueError(f"blind holds {len(blind)} seeds: what pictures suggest needs two; train more")
    levels = max(1, *(int(said.max()) + 1 for said in blind))
    votes = np.stack([(said[:, None] == np.arange(levels)).astype(int) for said in blind])
    others = votes.sum(0) - votes
    return [np.where(v.sum(1) > 0, v.argmax(1), BOTTOM) for v in others]


def deceptive(asked: Asked, prior: np.ndarray) -> Bool[np.ndarray, "N"]:
    """Questions about objects that look like others where sight suggests another level than the label."""
    return asked.lies & (prior != BOTTOM) & (prior != asked.label)


def contrast(
    asked: Asked, ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], where: Sequence[np.ndarray]
) -> Contrast:
    """One policy against another, paired by question and seed, on the questions of each seed's mask.

    Args:
      asked: the questions.
      ours, theirs: int [N] of every seed.
      where: bool [N] of every seed.

    Raises:
      ValueError: a mask without a question, or fewer than two seeds or objects.
    """
    for seed, mask in enumerate(where):
        if not mask.any():
            raise ValueError(f"where[{seed}] holds no question: a contrast needs one; ask about more objects")
    a, b = ([_right(asked, said, mask) for said, mask in zip(side, where, strict=True)] for side in (ours, theirs))
    gaps = [x.values - y.values for x, y in zip(a, b, strict=True)]
    return Contrast(
        questions=float(np.mean([mask.sum() for mask in where])),
        ours=float(np.mean([x.mean() for x in a])),
        theirs=float(np.mean([y.mean() for y in b])),
        seeds=student_interval(np.array([gap.mean() for gap in gaps])),
        objects=clustered_bootstrap(
            np.concatenate(gaps), np.concatenate([asked.objects[x.items] for x in a]), resamples=RESAMPLES
        ),
    )


def revised(asked: Asked, said: Sequence[np.ndarray], prior: Sequence[np.ndarray]) -> float:
    """Mean over seeds of the share of answers to deceptive questions that are not what sight suggests, percent."""
    rates = []
    for levels, seen in zip(said, prior, strict=True):
        label = np.where(deceptive(asked, seen), asked.label, BOTTOM)
        rates.append(revision_rate(levels, label, seen).mean())
    return float(np.mean(rates))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Use:
    """What touch is worth on some questions: the gain over each control with its interval, and the least of them."""

    gains: Mapping[str, Interval]
    least: LeastGain


def touch_use(
    asked: Asked,
    real: Sequence[Evaluated],
    controls: Mapping[str, Sequence[Evaluated]],
    ordered: np.ndarray,
    where: np.ndarray,
) -> Use:
    """TUG of the accuracy over hardness, roughness and protrusion, each weighing the same; seeds pooled by question.

    Args:
      asked: the questions.
      real: the answers of every seed given the touch.
      controls: each of `CONTROLS` → the answers of every seed.
      ordered: bool [N], whether the answer lies in the order of the frames.
      where: bool [N], the questions to judge by.
    """
    score = lambda seeds: pooled([_by_attribute(asked, spoken(said), where) for said in seeds])
    own, others = score(real), {name: score(controls[name]) for name in CONTROLS}
    gains = {}
    for name, other in others.items():
        gain = tactile_use_gain(own, other)
        gains[name] = clustered_bootstrap(
            gain.values, asked.objects[gain.items], strata=gain.strata, resamples=RESAMPLES
        )
    return Use(gains=gains, least=least_tactile_use(own, others, ordered, asked.objects, resamples=RESAMPLES))


def _right(asked: Asked, said: np.ndarray, where: np.ndarray) -> Scores:
    return accuracy(said, np.where(where, asked.label, BOTTOM))


def _by_attribute(asked: Asked, said: np.ndarray, where: np.ndarray) -> Scores:
    scored = where & asked.ordinal & (asked.label != BOTTOM)
    return keep_scored(100.0 * (said == asked.label), scored, asked.attribute)
