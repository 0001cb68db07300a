"""From the scores of every seed to the estimates and comparisons of the results."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from experiments.core.errors import require
from experiments.core.results import Comparison, Estimate
from experiments.core.text import bounds, interval, number
from touchr1_jax.bench import statistics
from touchr1_jax.bench.metrics import Scores
from touchr1_jax.bench.scoring import REPORTED

SeedScores = Sequence[Mapping[str, Scores]]  # metric → scores, of every seed
RESAMPLES = 2_000  # of each interval over objects: its ends are then good to a tenth of its width


def object_interval(values: np.ndarray, objects: np.ndarray, spec: str = ".1f") -> str | None:
    """A table's cell: mean of values [n] and its interval over their objects [n]; nothing with fewer than two objects.

    A thousand resamples give the ends to a tenth of the interval's width.
    """
    if len(np.unique(objects)) < 2:
        return None
    return interval(statistics.clustered_bootstrap(values.astype(float), objects, resamples=RESAMPLES // 2), spec)


def points(values: np.ndarray, objects: np.ndarray) -> statistics.Interval:
    """Mean in points of values [n] or [n, A] of n contacts, with an interval over objects [n]."""
    clusters = np.repeat(objects, values[0].size)
    return statistics.clustered_bootstrap(100.0 * values.astype(float).ravel(), clusters, resamples=RESAMPLES)


def change(c: Comparison) -> str:
    """The difference in a metric, by its title and with its interval: `CSC −0.8 points [−1.2, −0.4]`."""
    metric = REPORTED[c.metric]
    unit = f" {'points' if metric.unit == '%' else metric.unit}" if metric.unit else ""
    spec = f"+{metric.format}"
    return f"{metric.title} {number(c.difference, spec)}{unit} {bounds(c.low, c.high, spec)}"


def changes(found: Sequence[Comparison]) -> str:
    """The differences whose intervals exclude 0, then the metrics whose differences are not significant."""
    sure = [change(c) for c in found if c.low > 0 or c.high < 0]
    unsure = [REPORTED[c.metric].title for c in found if c.low <= 0 <= c.high]
    return "; ".join(filter(None, (", ".join(sure), f"not significant: {', '.join(unsure)}" if unsure else "")))


def pooled(seeds: Sequence[Scores]) -> Scores:
    """The mean over seeds of each value; all seeds were scored on the same questions."""
    return dataclasses.replace(seeds[0], values=np.mean([s.values for s in seeds], axis=0))


def estimate(per_seed: Sequence[Scores], objects: np.ndarray) -> Estimate:
    """Mean over seeds, and its object-clustered bootstrap interval: seeds pooled, whole objects [N] resampled."""
    means = tuple(scores.mean() for scores in per_seed)
    interval = statistics.clustered_bootstrap(
        np.concatenate([s.values for s in per_seed]),
        np.concatenate([objects[s.items] for s in per_seed]),
        strata=np.concatenate([s.strata for s in per_seed]),
        resamples=RESAMPLES,
    )
    return Estimate(mean=float(np.mean(means)), ci95=(interval.low, interval.high), per_seed=means)


def estimate_rows(scored: Mapping[str, SeedScores], objects: np.ndarray) -> dict[str, dict[str, Estimate]]:
    """Estimates of every metric of every row."""
    return {
        name: {metric: estimate([scores[metric] for scores in seeds], objects) for metric in seeds[0]}
        for name, seeds in scored.items()
    }


def compare_rows(
    a: str,
    b: str,
    metrics: Iterable[str],
    scored: Mapping[str, SeedScores],
    objects: np.ndarray,
) -> list[Comparison]:
    """One row against another in the metrics that both have, over objects and, where there are several, over seeds.

    A baseline of one seed is compared with every seed.
    """
    found = []
    for metric in metrics:
        if metric in scored[a][0] and metric in scored[b][0]:
            ours, theirs = ([scores[metric] for scores in scored[name]] for name in (a, b))
            theirs = theirs * len(ours) if len(theirs) == 1 else theirs
            found.append(compare_over_objects(metric, a, b, ours, theirs, objects))
            if len(ours) > 1:
                found.append(compare_over_seeds(metric, a, b, *([s.mean() for s in row] for row in (ours, theirs))))
    return found


def compare_over_seeds(metric: str, arm: str, against: str, a: Sequence[float], b: Sequence[float]) -> Comparison:
    """`arm` minus `against`, paired by seed: Student t interval, sign-flip p-value, probability of improvement.

    The last is `None` for a metric that has no better direction; a and b are the value of every seed.
    """
    _require_same_seeds(arm, against, a, b)
    difference = np.subtract(a, b)
    interval = statistics.student_interval(difference)
    better = REPORTED[metric].better
    columns = [np.asarray(side)[:, None] * (-1.0 if better == "lower" else 1.0) for side in (a, b)]
    return Comparison(
        metric=metric,
        arm=arm,
        against=against,
        difference=interval.mean,
        ci95=(interval.low, interval.high),
        over="seeds",
        n=len(difference),
        p_value=statistics.sign_flip_test(difference),
        improvement=None if better == "none" else statistics.probability_of_improvement(*columns),
    )


def compare_over_objects(
    metric: str, arm: str, against: str, a: Sequence[Scores], b: Sequence[Scores], objects: np.ndarray
) -> Comparison:
    """`arm` minus `against`, paired by question and seed: object-clustered bootstrap interval.

    A baseline without seeds is repeated by the caller.
    """
    _require_same_seeds(arm, against, a, b)
    for x, y in zip(a, b, strict=True):
        same = np.array_equal(x.items, y.items) and np.array_equal(x.strata, y.strata)
        require(same, metric, f"{arm} and {against}", "must be scored on the same answers", "align the questions")
    paired = [dataclasses.replace(x, values=x.values - y.values) for x, y in zip(a, b, strict=True)]
    difference = estimate(paired, objects)
    return Comparison(
        metric=metric,
        arm=arm,
        against=against,
        difference=difference.mean,
        ci95=difference.ci95,
        over="objects",
        n=len(np.unique(objects[a[0].items])),
    )


def _require_same_seeds(arm: str, against: str, a: Sequence[object], b: Sequence[object]) -> None:
    counts = len(a), len(b)
    require(counts[0] == counts[1], f"{arm} and {against}", counts, "must have the same seeds", "run the missing ones")
