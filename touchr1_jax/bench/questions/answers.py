"""Score anybody's answers to the bench: from texts to metrics with intervals over objects."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from touchr1_jax.bench.averages import AVERAGED, touch_average
from touchr1_jax.bench.items import Item
from touchr1_jax.bench.json_lines import LinesError
from touchr1_jax.bench.metrics import Metric
from touchr1_jax.bench.questions.wording import read_answer
from touchr1_jax.bench.scoring import BENCH_METRICS, clusters, score
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap

RESAMPLES = 2_000
"""Resamples of each interval: the error of its ends is about a tenth of its width."""

AnswerLevels = Mapping[str, tuple[int, ...]]
"""Id of an item → the levels that its answer concludes, −1 where none could be parsed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MetricRow:
    """One metric with its interval over objects and the number of values that it is the mean of."""

    name: str
    metric: Metric
    interval: Interval
    values: int


def ask_all(items: Iterable[Item], answer: Callable[[Item], str]) -> dict[str, tuple[int, ...]]:
    """The levels that a model answers to every question; it may read an item's question, touches and sensors alone."""
    return {item.ask.id: read_answer(item.ask, answer(item))[1] for item in items}


def read_answers(
    rows: Iterable[tuple[int, Mapping[str, Any]]], items: Sequence[Item], where: str = "answers"
) -> dict[str, tuple[int, ...]]:
    """The levels of the answers {"id", "text"} in rows of `read_lines`; a question without an answer is unparsable.

    Raises:
      LinesError: other fields, an unknown id, one that occurs twice, or a text that is not a string.
    """
    by_id, texts = {item.ask.id: item for item in items}, dict[str, str]()
    for number, row in rows:
        if set(row) != {"id", "text"} or not all(isinstance(value, str) for value in row.values()):
            raise LinesError(f"{where}, line {number} is {dict(row)!r}: must have id and text, strings; correct it")
        if row["id"] not in by_id or row["id"] in texts:
            fix = "answer each once" if row["id"] in texts else "take the ids of the items"
            raise LinesError(f"{where}, line {number}: id is {row['id']!r}: must be that of an open question; {fix}")
        texts[row["id"]] = row["text"]
    return ask_all(items, lambda item: texts.get(item.ask.id, ""))


def metric_rows(items: Sequence[Item], answers: AnswerLevels, by_sight: AnswerLevels | None = None) -> list[MetricRow]:
    """Every metric that the items define, but for those about a single object, which have no interval.

    Answers given the picture alone, `by_sight`, define which questions are a conflict.
    """
    rows, asks = [], [item.ask for item in items]
    for name, scores in score(asks, answers, by_sight).items():
        objects = clusters(asks, scores)
        if len(set(objects)) > 1:
            span = clustered_bootstrap(scores.values, objects, strata=scores.strata, resamples=RESAMPLES)
            rows.append(MetricRow(name=name, metric=BENCH_METRICS[name], interval=span, values=len(scores.values)))
    return rows


def parsed_share(answers: AnswerLevels) -> float:
    """Share of the answers all of whose parts could be parsed."""
    return sum(-1 not in levels for levels in answers.values()) / len(answers)


def average_line(items: Sequence[Item], answers: AnswerLevels) -> str:
    """The average in words, or the metrics that are missing for one."""
    means = {name: scores.mean() for name, scores in score([item.ask for item in items], answers).items()}
    missing = [name for name in AVERAGED if name not in means]
    return f"no average without {', '.join(missing)}" if missing else f"average {touch_average(means):.1f}"
