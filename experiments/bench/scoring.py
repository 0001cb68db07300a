"""Anybody's answers to the bench, scored: texts in, metrics with intervals over objects out."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from experiments.bench.wording import understand
from touchr1_jax.bench.averages import AVERAGED, touch_average
from touchr1_jax.bench.items import Item
from touchr1_jax.bench.json_lines import LinesError
from touchr1_jax.bench.metrics import Metric
from touchr1_jax.bench.scoring import BENCH_METRICS, clusters, score
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap

RESAMPLES = 2_000
"""Of each interval: its ends are then good to a tenth of its width."""

AnswerLevels = Mapping[str, tuple[int, ...]]
"""Id of an item → the levels that were read in its answer, −1 for ⊥."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MetricRow:
    """One metric: what it means, its interval over objects, how many values it is the mean of."""

    name: str
    metric: Metric
    interval: Interval
    values: int


def ask_all(items: Iterable[Item], answer: Callable[[Item], str]) -> dict[str, tuple[int, ...]]:
    """Ask a model every question.

    Args:
      items: the bench.
      answer: gives the model's text; it must look at nothing of the item but the question, touches and sensors.
    """
    return {item.ask.id: understand(item.ask, answer(item))[1] for item in items}


def understood(
    rows: Iterable[tuple[int, Mapping[str, Any]]], items: Sequence[Item], where: str = "answers"
) -> dict[str, tuple[int, ...]]:
    """Answers from a file; a question without one is unparsable.

    Args:
      rows: line numbers and objects {"id", "text"}, as `read_lines` gives them.
      items: the bench.
      where: the file's name, for errors.

    Raises:
      LinesError: other fields, an unknown id, one that occurs twice, or a text that is none.
    """
    by_id, texts = {item.ask.id: item for item in items}, dict[str, str]()
    for number, tree in rows:
        if set(tree) != {"id", "text"} or not all(isinstance(value, str) for value in tree.values()):
            raise LinesError(f"{where}, line {number} is {dict(tree)!r}: must have id and text, strings; correct it")
        if tree["id"] not in by_id or tree["id"] in texts:
            fix = "answer each once" if tree["id"] in texts else "take the ids of the items"
            raise LinesError(f"{where}, line {number}: id is {tree['id']!r}: must be that of an open question; {fix}")
        texts[tree["id"]] = tree["text"]
    return ask_all(items, lambda item: texts.get(item.ask.id, ""))


def table(items: Sequence[Item], said: AnswerLevels, by_sight: AnswerLevels | None = None) -> list[MetricRow]:
    """Every metric that the items define; one about a single object has no interval and is left out.

    Args:
      items: the bench.
      said: the answers to all of them.
      by_sight: those given the picture alone, where they are known: they tell what is a conflict.
    """
    rows, asks = [], [item.ask for item in items]
    for name, scores in score(asks, said, by_sight).items():
        objects = clusters(asks, scores)
        if len(set(objects)) > 1:
            span = clustered_bootstrap(scores.values, objects, strata=scores.strata, resamples=RESAMPLES)
            rows.append(MetricRow(name=name, metric=BENCH_METRICS[name], interval=span, values=len(scores.values)))
    return rows


def parsed(said: AnswerLevels) -> float:
    """Share of the answers all of whose parts were understood."""
    return sum(-1 not in levels for levels in said.values()) / len(said)


def average_line(items: Sequence[Item], said: AnswerLevels) -> str:
    """The average in words, or what is missing for one."""
    means = {name: scores.mean() for name, scores in score([item.ask for item in items], said).items()}
    missing = [name for name in AVERAGED if name not in means]
    return f"no average without {', '.join(missing)}" if missing else f"average {touch_average(means):.1f}"
