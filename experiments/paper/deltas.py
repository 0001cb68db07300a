"""What each component changes: differences of rungs with intervals and corrected p-values, beside the paper's."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from experiments.study.answers import Evaluated
from touchr1_jax.bench.metrics import Scores, mean_accuracy
from touchr1_jax.bench.statistics import (
    Interval,
    clustered_bootstrap,
    clustered_sign_flip_test,
    holm,
    sign_flip_test,
    student_interval,
)

RESAMPLES = 2_000
"""Of each interval over objects: its ends are then good to a tenth of its width."""

FOUR = "four_acc"
"""Mean accuracy over hardness, roughness, protrusion and material: what the paper's ladder prints as Avg."""

Sign = Literal["reproduced", "opposite", "undecided", "not in the paper"]

SeedScores = Sequence[Mapping[str, Scores]]
"""Metric → scores, of every seed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measure:
    """A column of the paper's ladder: our metric, the column's name and place, its format."""

    metric: str
    title: str
    column: int
    format: str


MEASURES: tuple[Measure, ...] = (
    Measure(metric="omae", title="OMAE", column=0, format="+.3f"),
    Measure(metric="csc", title="CSC", column=1, format="+.1f"),
    Measure(metric=FOUR, title="Avg", column=2, format="+.1f"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Step:
    """One arm against another: what the first has more, and what the paper prints for it in the columns of `MEASURES`.

    `published` is `None` where the paper has no such row.  `watched` is the arm whose run is searched for failures
    whatever comes out; `None` for the first one, where the paper's sign does not come out.
    """

    arm: str
    against: str
    adds: str
    published: tuple[float, ...] | None
    watched: str | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Delta:
    """A step in one measure: the difference with intervals over training seeds and over objects, and their p-values.

    The p-values are of sign-flip tests, corrected over all steps and measures of a table by Holm's method.
    """

    step: Step
    measure: Measure
    seeds: Interval
    objects: Interval
    p_seeds: float
    p_objects: float

    @property
    def published(self) -> float | None:
        """The paper's difference."""
        return None if self.step.published is None else self.step.published[self.measure.column]

    @property
    def sign(self) -> Sign:
        """Whether the paper's sign comes out: beyond chance over seeds, or against it, or neither."""
        if self.published is None or self.published == 0:
            return "not in the paper"
        if not self.seeds.excludes_zero:
            return "undecided"
        return "reproduced" if np.sign(self.seeds.mean) == np.sign(self.published) else "opposite"


def with_four(scores: Mapping[str, Scores], said: Evaluated) -> dict[str, Scores]:
    """The scores of one seed, and the mean accuracy over all four attributes."""
    return {**scores, FOUR: mean_accuracy(np.asarray(said.parsed.conclude), said.label)}


def deltas(
    steps: Sequence[Step],
    rows: Mapping[str, SeedScores],
    objects: np.ndarray,
    measures: Sequence[Measure] = MEASURES,
) -> tuple[Delta, ...]:
    """Every step in every measure that both of its arms have.

    Args:
      steps: what to compare.
      rows: arm → seeds; an arm of one seed, a baseline, stands against every seed of the other.
      objects: [N], the object of each question.
      measures: in the order of the paper's columns.

    Raises:
      ValueError: two arms of different numbers of seeds, or fewer than two seeds.
    """
    found = [
        _delta(step, measure, *_paired(step, measure.metric, rows), objects)
        for step in steps
        for measure in measures
        if all(measure.metric in rows[name][0] for name in (step.arm, step.against))
    ]
    over_seeds, over_objects = (holm(np.array([getattr(d, p) for d in found])) for p in ("p_seeds", "p_objects"))
    return tuple(
        dataclasses.replace(d, p_seeds=float(a), p_objects=float(b))
        for d, a, b in zip(found, over_seeds, over_objects, strict=True)
    )


def pooled(seeds: Sequence[Scores]) -> Scores:
    """The mean over seeds of each value; all seeds were scored on the same questions."""
    return dataclasses.replace(seeds[0], values=np.mean([s.values for s in seeds], axis=0))


def _paired(step: Step, metric: str, rows: Mapping[str, SeedScores]) -> tuple[list[Scores], list[Scores]]:
    a, b = ([seed[metric] for seed in rows[name]] for name in (step.arm, step.against))
    count = max(len(a), len(b))
    if count < 2 or {len(a), len(b)} - {1, count}:
        raise ValueError(
            f"{step.arm} and {step.against} have {len(a)} and {len(b)} seeds: must have the same number, two at least, "
            "or one of a baseline; train the missing ones"
        )
    a, b = (side * count if len(side) == 1 else side for side in (a, b))
    return a, b


def _delta(step: Step, measure: Measure, a: list[Scores], b: list[Scores], objects: np.ndarray) -> Delta:
    per_seed = np.array([x.mean() - y.mean() for x, y in zip(a, b, strict=True)])
    difference = pooled(a).values - pooled(b).values
    where = {"clusters": objects[a[0].items], "strata": a[0].strata}
    return Delta(
        step=step,
        measure=measure,
        seeds=student_interval(per_seed),
        objects=clustered_bootstrap(difference, **where, resamples=RESAMPLES),
        p_seeds=sign_flip_test(per_seed),
        p_objects=clustered_sign_flip_test(difference, **where),
    )
