"""Metrics of the touch bench from answers to its items."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from touchr1_jax.bench import metrics
from touchr1_jax.bench.comparison import order_correlation, swap_consistency, which_has_more
from touchr1_jax.bench.grounding import conflict_accuracy, revision_rate
from touchr1_jax.bench.items import Ask
from touchr1_jax.bench.metrics import BOTTOM, METRICS, ORDINAL, PREFIX, Metric, Scores, share_metric

LEVELS = 3
"""K of every ordinal attribute."""


BENCH_METRICS: Mapping[str, Metric] = {
    **{f"{p}_acc": METRICS[f"{p}_acc"] for p in PREFIX.values()},
    **{f"{p}_bacc": METRICS[f"{p}_bacc"] for p in PREFIX.values()},
    "omae": METRICS["omae"],
    "l2_em": share_metric("L2-EM", "questions for several properties all of which are right"),
    "sfd": share_metric("SFD", "pairs of which the one that has more is named; chance 50"),
    "sfd_swap": share_metric(
        "SFD-swap", "pairs of which the same one is named in both orders, right or not", secondary=True
    ),
    "soi_rho": Metric(
        title="SOI-ρ",
        unit="",
        better="higher",
        format=".3f",
        meaning="Spearman's ρ of three objects in order; unparsable counts 0",
    ),
    "csc": METRICS["csc"],
    "csc_agree": METRICS["csc_agree"],
    "deceptive_acc": share_metric("Deceptive", "questions about objects that look like others which are right"),
    "conflict_acc": share_metric("Conflict", "of those, the ones that sight alone gets wrong which are right"),
    "avg": Metric(
        title="Avg",
        unit="",
        better="higher",
        format=".1f",
        meaning="mean of H, R, P, Mat, 100(1 − OMAE/2), L2-EM, SFD, 100·max(ρ, 0) and CSC; not the paper's, which no "
        "formula gives; a constant has about 29",
    ),
    "revision_rate": share_metric(
        "Revised",
        "of the latter, those whose answer differs from that by sight alone, right or not",
        "none",
        secondary=True,
    ),
}
"""Every metric of the bench, in the order of its table."""

REPORTED: Mapping[str, Metric] = {**METRICS, **BENCH_METRICS}
"""Every metric that a report may show: of answers about single touches, and of the bench."""

ItemAnswers = Mapping[str, Sequence[int]]
"""Id of an item → the levels that were read in its answer, −1 for ⊥."""


def score(asks: Sequence[Ask], answers: ItemAnswers, by_sight: ItemAnswers | None = None) -> dict[str, Scores]:
    """The metrics that the items define, keyed as `BENCH_METRICS`; one without an item is left out.

    Accuracies are of the kind "identify"; OMAE of all answers about one touch by all its sensors but those of
    "conflict"; CSC of "one_sensor".  `Scores.items` counts the questions given, `clusters` gives their objects.

    Args:
      asks: the bench's questions.
      answers: to all of them.
      by_sight: to those of "conflict", given the picture alone; they are the visual prior.

    Raises:
      ValueError: an item without an answer, or with too few or too many levels; a group of "one_sensor" that holds
        several touches or properties.
    """
    _check(asks, answers)
    if by_sight is not None:
        _check([ask for ask in asks if ask.kind == "conflict"], by_sight)
    kinds = {kind: [i for i, ask in enumerate(asks) if ask.kind == kind] for kind in _SCORED}
    table = {name: part for kind, rows in kinds.items() if rows for name, part in _SCORED[kind](asks, rows, answers)}
    single = [*kinds["identify"], *kinds["scale"], *kinds["compose"]]
    distance = _distance(asks, single, answers)
    if len(distance.values):
        table["omae"] = distance
    if by_sight is not None and kinds["conflict"]:
        table |= _against_sight(asks, kinds["conflict"], answers, by_sight)
    return {name: table[name] for name in BENCH_METRICS if name in table and len(table[name].values)}


def clusters(asks: Sequence[Ask], scores: Scores) -> np.ndarray:
    """The object of each value, for intervals that resample objects, [M]."""
    return np.array([asks[i].cluster for i in scores.items])


_Parts = list[tuple[str, Scores]]


def _identify(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> _Parts:
    parts: _Parts = []
    for attribute, prefix in PREFIX.items():
        of = [i for i in rows if asks[i].attributes == (attribute,)]
        if of:
            answer, label = _first(asks, of, answers)
            parts.append((f"{prefix}_acc", _at(of, metrics.accuracy(answer, label))))
            parts.append((f"{prefix}_bacc", _at(of, metrics.balanced_accuracy(answer, label))))
    return parts


def _compose(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> _Parts:
    width = max(len(asks[i].attributes) for i in rows)
    answer, label = np.full((2, len(rows), width), BOTTOM)
    for n, i in enumerate(rows):
        count = len(asks[i].answer)
        answer[n, :count], label[n, :count] = answers[asks[i].id], asks[i].answer
    return [("l2_em", _at(rows, metrics.exact_match(answer, label)))]


def _compare(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> _Parts:
    answer, label = _first(asks, rows, answers)
    pair = np.array([asks[i].group for i in rows])
    swapped = np.array([asks[i].position == 1 for i in rows])
    return [
        ("sfd", _at(rows, which_has_more(answer, label))),
        ("sfd_swap", _at(rows, swap_consistency(answer, pair, swapped))),
    ]


def _order(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> _Parts:
    return [("soi_rho", _at(rows, order_correlation(*_first(asks, rows, answers))))]


def _one_sensor(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> _Parts:
    groups: dict[str, list[int]] = {}
    for i in rows:
        members = groups.setdefault(asks[i].group, [])
        members.append(i)
        first = asks[members[0]]
        if (asks[i].touches, asks[i].attributes, asks[i].answer) != (first.touches, first.attributes, first.answer):
            raise ValueError(
                f"group {asks[i].group!r} holds {first.id!r} and {asks[i].id!r}: must be of one touch and property, "
                "each item with another sensor; give each touch a group of its own"
            )
    width = max(map(len, groups.values()))
    alone = np.full((len(groups), width, 1), BOTTOM)
    streams = np.zeros((len(groups), width), bool)
    for g, members in enumerate(groups.values()):
        alone[g, : len(members), 0] = [answers[asks[i].id][0] for i in members]
        streams[g, : len(members)] = True
    firsts = [members[0] for members in groups.values()]
    label = np.array([asks[i].answer for i in firsts])
    return [
        ("csc", _at(firsts, metrics.cross_sensor_consistency(alone, label, streams))),
        ("csc_agree", _at(firsts, metrics.cross_sensor_agreement(alone, label, streams))),
    ]


def _conflict(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> _Parts:
    return [("deceptive_acc", _at(rows, metrics.accuracy(*_first(asks, rows, answers))))]


def _against_sight(
    asks: Sequence[Ask], rows: list[int], answers: ItemAnswers, by_sight: ItemAnswers
) -> dict[str, Scores]:
    answer, label = _first(asks, rows, answers)
    prior, _ = _first(asks, rows, by_sight)
    return {
        "conflict_acc": _at(rows, conflict_accuracy(answer, label, prior)),
        "revision_rate": _at(rows, revision_rate(answer, label, prior)),
    }


_SCORED: Mapping[str, Callable[[Sequence[Ask], list[int], ItemAnswers], _Parts]] = {
    "identify": _identify,
    "scale": lambda asks, rows, answers: [],  # its answers count in OMAE
    "compose": _compose,
    "compare": _compare,
    "order": _order,
    "one_sensor": _one_sensor,
    "conflict": _conflict,
}


def _distance(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> Scores:
    triples = [
        (i, answer, label)
        for i in rows
        for name, answer, label in zip(asks[i].attributes, answers[asks[i].id], asks[i].answer, strict=True)
        if name in ORDINAL
    ]
    at, answer, label = (
        (np.array(column, int) for column in zip(*triples, strict=True)) if triples else [np.zeros(0, int)] * 3
    )
    return _at(at.tolist(), metrics.ordinal_mae(answer[:, None], label[:, None], np.array([LEVELS])))


def _first(asks: Sequence[Ask], rows: list[int], answers: ItemAnswers) -> tuple[np.ndarray, np.ndarray]:
    """Answer and label of items with one answer, int [rows] each."""
    answer = np.array([answers[asks[i].id][0] for i in rows])
    return answer, np.array([asks[i].answer[0] for i in rows])


def _at(rows: Sequence[int], scores: Scores) -> Scores:
    """The scores with indices among all items."""
    return Scores(values=scores.values, items=np.asarray(rows, int)[scores.items], strata=scores.strata)


def _check(asks: Sequence[Ask], answers: ItemAnswers) -> None:
    for ask in asks:
        if ask.id not in answers:
            raise ValueError(f"answers lacks {ask.id!r}: every item needs one; give −1 where nothing was answered")
        got, want = len(answers[ask.id]), len(ask.answer)
        if got != want:
            raise ValueError(f"answers[{ask.id!r}] has {got} levels: must have {want}; give −1 for what is missing")
