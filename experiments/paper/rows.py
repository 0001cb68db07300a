"""From answers to the bench's questions to the rows of its table: every metric with an interval over objects."""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.results import Estimate
from experiments.study.estimates import estimate
from touchr1_jax.bench.averages import AVERAGED, touch_average
from touchr1_jax.bench.items import Ask
from touchr1_jax.bench.metrics import Scores
from touchr1_jax.bench.scoring import ItemAnswers, score
from touchr1_jax.bench.statistics import draw_clusters, drawn_means

RESAMPLES = 2_000
"""Of each interval: its ends are then good to a tenth of its width."""


def bench_row(
    asks: Sequence[Ask], answers: Sequence[ItemAnswers], by_sight: Sequence[ItemAnswers] | None = None
) -> dict[str, Estimate]:
    """Every metric of the bench that the questions define, and their average where all of it is there.

    One about a single object has no interval and is left out, and one that some seed lacks.

    Args:
      asks: the questions.
      answers: those of every seed.
      by_sight: what pictures alone suggest, for every seed.
    """
    seen: Sequence[ItemAnswers | None] = [None] * len(answers) if by_sight is None else by_sight
    tables = [score(asks, said, prior) for said, prior in zip(answers, seen, strict=True)]
    objects = np.array([ask.cluster for ask in asks])
    several = lambda scores: len(np.unique(objects[scores.items])) > 1
    shared = [name for name in tables[0] if all(name in table and several(table[name]) for table in tables)]
    row = {name: estimate([table[name] for table in tables], objects, resamples=RESAMPLES) for name in shared}
    return row | ({"avg": average(tables, objects)} if set(AVERAGED) <= set(shared) else {})


def average(tables: Sequence[Mapping[str, Scores]], objects: np.ndarray) -> Estimate:
    """`touch_average` of every seed, and its interval: one resample of the objects serves all metrics and seeds.

    Args:
      tables: metric → scores of every seed, `AVERAGED` among them.
      objects: [N], the object of each question.
    """
    cluster, weights = draw_clusters(objects, resamples=RESAMPLES, seed=0)

    def drawn(table: Mapping[str, Scores]) -> np.ndarray:
        means = {
            n: drawn_means(s.values, cluster[s.items], s.strata, weights) for n, s in table.items() if n in AVERAGED
        }
        whole = np.all([np.isfinite(m) for m in means.values()], axis=0)
        return np.array([touch_average({n: m[i] for n, m in means.items()}) for i in np.flatnonzero(whole)])

    each = tuple(touch_average({name: table[name].mean() for name in AVERAGED}) for table in tables)
    low, high = np.quantile(np.mean([drawn(table) for table in tables], axis=0), (0.025, 0.975))
    return Estimate(mean=float(np.mean(each)), ci95=(float(low), float(high)), per_seed=each)
