"""The metrics of every table, and the functions that compute them.

Dimensions: N questions (contacts), A attributes, S sensors, M scored values.  An answer of −1 is ⊥, unparsable.  A
label of −1 means *not scored*: the attribute was not asked, or nobody annotated it; such entries count nowhere.

Every function returns `Scores`: the single values whose mean is the metric and the question each value comes from, so
that an interval can resample whole objects.  Shares are percentages, 0–100.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Literal

import numpy as np

BOTTOM = -1
"""⊥ among answers; among labels: not scored."""

PREFIX: Mapping[str, str] = {"hardness": "h", "roughness": "r", "protrusion": "p", "material": "mat"}
"""Beginning of an attribute's metric names."""

ORDINAL = ("hardness", "roughness", "protrusion")
"""The attributes of `acc`, `omae` and `middle_rate`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metric:
    """Title, unit and meaning of a metric; `format` is a format specification such as ".1f".

    `secondary` marks metrics that only explain others; they are printed in a second table.
    """

    title: str
    unit: str
    better: Literal["higher", "lower", "none"]
    format: str
    meaning: str
    secondary: bool = False


def share_metric(
    title: str, meaning: str, better: Literal["higher", "none"] = "higher", *, secondary: bool = False
) -> Metric:
    """A metric in percent with one decimal."""
    return Metric(title=title, unit="%", better=better, format=".1f", meaning=meaning, secondary=secondary)


_RIGHT = "{} answers that are right; unparsable is wrong"
_BALANCED = "balanced {} accuracy: mean over the levels of the accuracy on each"

METRICS: Mapping[str, Metric] = {
    "acc": share_metric("Acc", "mean of H-, R- and P-Acc"),
    **{f"{PREFIX[a]}_acc": share_metric(f"{PREFIX[a].upper()}-Acc", _RIGHT.format(a)) for a in ORDINAL},
    "mat_acc": share_metric("Mat-Acc", "material answers that are right, of nine; unparsable is wrong"),
    **{
        f"{PREFIX[a]}_bacc": share_metric(f"{PREFIX[a].upper()}-bAcc", _BALANCED.format(a), secondary=True)
        for a in ORDINAL
    },
    "mat_bacc": share_metric("Mat-bAcc", "balanced material accuracy: mean over the materials", secondary=True),
    "omae": Metric(
        title="OMAE",
        unit="levels",
        better="lower",
        format=".3f",
        meaning="mean distance in levels over hardness, roughness and protrusion answers; unparsable counts K−1",
    ),
    "csc": share_metric("CSC", "pairs of sensors whose conclusions, each given one sensor alone, are both right"),
    "csc_agree": share_metric(
        "CSC-agree",
        "pairs of sensors whose conclusions agree, right or not; a constant gets 100",
        "none",
        secondary=True,
    ),
    "csc_slot": share_metric(
        "CSC-slot", "pairs of perceive slots of one answer that name the same level", "none", secondary=True
    ),
    "parse_rate": share_metric("Parsed", "answers that are formatted and whose asked conclusions parse"),
    "middle_rate": share_metric("Middle", "ordinal answers that name the middle level", "none", secondary=True),
    "reward": Metric(
        title="Reward", unit="", better="higher", format=".3f", meaning="mean total reward of the greedy answers"
    ),
    "reward_trained": Metric(
        title="Reward (own)",
        unit="",
        better="higher",
        format=".4f",
        meaning="mean total reward of the greedy answers to ordinal questions, by the weights of the arm",
    ),
}
"""Every metric name that a results file may hold."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scores:
    """The values behind one metric: the metric is the mean over strata of the mean value inside each stratum.

    Args:
      values: float [M].
      items: int [M], the question (0..N−1) that each value belongs to.
      strata: int [M], zeros for a plain mean; the class for balanced accuracy, the attribute for `acc`.
    """

    values: np.ndarray
    items: np.ndarray
    strata: np.ndarray

    def mean(self) -> float:
        """The metric.

        Raises:
          ValueError: nothing was scored.
        """
        if not len(self.values):
            raise ValueError("values is empty: a metric needs one scored answer at least; give labels that are not −1")
        return float(np.mean([self.values[self.strata == s].mean() for s in np.unique(self.strata)]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Answers:
    """The answers of a policy to N questions, as arrays.

    Args:
      conclude: int [N, A], the answers given all sensors.
      label: int [N, A], −1 where not scored.
      formatted: bool [N].
      reward: float [N], total reward of each answer.
      streams: bool [N, S], the sensors that were there.
      perceive: int [N, S, A], the level that the answer reports for each sensor.
      alone: int [N, S, A], the answers given sensor s alone, or `None` where that was not run.
    """

    conclude: np.ndarray
    label: np.ndarray
    formatted: np.ndarray
    reward: np.ndarray
    streams: np.ndarray
    perceive: np.ndarray
    alone: np.ndarray | None = None


def accuracy(answer: np.ndarray, label: np.ndarray) -> Scores:
    """Exact match: 100·mean 1[ŷ = y], ⊥ wrong.

    Args:
      answer, label: int [N].
    """
    check_same_shape(answer=answer, label=label)
    scored = label != BOTTOM
    return keep_scored(100.0 * (answer == label), scored)


def balanced_accuracy(answer: np.ndarray, label: np.ndarray) -> Scores:
    """Mean over the levels that occur among the labels of the accuracy on each; a constant gets 100 over their number.

    Args:
      answer, label: int [N].
    """
    plain = accuracy(answer, label)
    return dataclasses.replace(plain, strata=label[plain.items])


def mean_accuracy(answer: np.ndarray, label: np.ndarray) -> Scores:
    """Mean over attributes of their accuracies, each attribute weighing the same.

    Args:
      answer, label: int [N, A].
    """
    check_same_shape(answer=answer, label=label)
    attribute = np.broadcast_to(np.arange(label.shape[1]), label.shape)
    return keep_scored(100.0 * (answer == label), label != BOTTOM, attribute)


def exact_match(answer: np.ndarray, label: np.ndarray) -> Scores:
    """L2-EM, 100·mean 1[all asked attributes right]; on the same answers no more than the least of their accuracies.

    Args:
      answer, label: int [N, A]; a question counts where a label is scored.
    """
    check_same_shape(answer=answer, label=label)
    scored = label != BOTTOM
    return keep_scored(100.0 * ((answer == label) | ~scored).all(axis=1), scored.any(axis=1))


def ordinal_mae(answer: np.ndarray, label: np.ndarray, levels: np.ndarray) -> Scores:
    """OMAE, mean |ŷ − y| in levels with ⊥ counting K − 1; on the same answers OMAE ≥ 1 − Acc/100.

    Args:
      answer, label: int [N, A].
      levels: int [A], the K of each attribute.
    """
    check_same_shape(answer=answer, label=label)
    distance = np.where(answer == BOTTOM, levels - 1, np.abs(answer - label))
    return keep_scored(distance.astype(float), label != BOTTOM)


def cross_sensor_consistency(alone: np.ndarray, label: np.ndarray, streams: np.ndarray) -> Scores:
    """CSC, 100·mean over question, attribute and sensor pair (a, b) of 1[ŷ_a = ŷ_b = y].

    Args:
      alone: int [N, S, A], the conclusion given sensor s alone.
      label: int [N, A].
      streams: bool [N, S]; pairs with an absent sensor do not count.
    """
    return _over_pairs(alone == label[:, None], alone, label, streams)


def cross_sensor_agreement(alone: np.ndarray, label: np.ndarray, streams: np.ndarray) -> Scores:
    """Plain agreement, 100·mean of 1[ŷ_a = ŷ_b ≠ ⊥] over the pairs of CSC; on `perceive` slots this is CSC-slot.

    It bounds CSC from above and a constant answer gets 100, so it is no goal by itself.

    Args:
      alone: int [N, S, A]; label: int [N, A]; streams: bool [N, S], as for CSC.
    """
    return _over_pairs(alone != BOTTOM, alone, label, streams)


def parse_rate(formatted: np.ndarray, answer: np.ndarray, label: np.ndarray) -> Scores:
    """100·mean 1[formatted and no scored conclusion is ⊥].

    Args:
      formatted: bool [N].
      answer, label: int [N, A].
    """
    check_same_shape(answer=answer, label=label)
    parsed = formatted & ((answer != BOTTOM) | (label == BOTTOM)).all(axis=1)
    return keep_scored(100.0 * parsed, np.ones(len(parsed), bool))


def middle_rate(answer: np.ndarray, label: np.ndarray, levels: np.ndarray) -> Scores:
    """100·mean 1[ŷ = (K − 1)/2] over the scored ordinal questions; ⊥ counts as not the middle.

    Args:
      answer, label: int [N, A].
      levels: int [A], odd: only then there is a middle level.
    """
    check_same_shape(answer=answer, label=label)
    if np.any(levels % 2 == 0):
        raise ValueError(
            f"levels is {levels.tolist()}: an even number of levels has no middle; leave such attributes out"
        )
    return keep_scored(100.0 * (answer == (levels - 1) // 2), label != BOTTOM)


def evaluate(answers: Answers, attributes: tuple[str, ...], levels: tuple[int, ...]) -> dict[str, Scores]:
    """All metrics that the answers define, keyed as `METRICS`.

    A metric without a single value is left out: an attribute that nobody asked, CSC with fewer than two sensors or
    without single-sensor answers.

    Args:
      attributes: the names of the A axis, all in `PREFIX`.
      levels: the number of levels of each.
    """
    unknown = [a for a in attributes if a not in PREFIX]
    if unknown:
        raise ValueError(f"attributes holds {unknown}: metrics exist for {', '.join(PREFIX)}; add them to PREFIX")
    check_same_shape(formatted=answers.formatted, reward=answers.reward, questions=answers.label[:, 0])
    ordinal = [i for i, a in enumerate(attributes) if a in ORDINAL]
    concluded, label, levels_a = answers.conclude[:, ordinal], answers.label[:, ordinal], np.asarray(levels)[ordinal]
    table = {
        "acc": mean_accuracy(concluded, label),
        "omae": ordinal_mae(concluded, label, levels_a),
        "middle_rate": middle_rate(concluded, label, levels_a),
        "parse_rate": parse_rate(answers.formatted, answers.conclude, answers.label),
        "reward": keep_scored(np.asarray(answers.reward, float), np.ones(len(answers.reward), bool)),
        "csc_slot": cross_sensor_agreement(answers.perceive, answers.label, answers.streams),
    }
    for i, attribute in enumerate(attributes):
        table[f"{PREFIX[attribute]}_acc"] = accuracy(answers.conclude[:, i], answers.label[:, i])
        table[f"{PREFIX[attribute]}_bacc"] = balanced_accuracy(answers.conclude[:, i], answers.label[:, i])
    if answers.alone is not None:
        table["csc"] = cross_sensor_consistency(answers.alone, answers.label, answers.streams)
        table["csc_agree"] = cross_sensor_agreement(answers.alone, answers.label, answers.streams)
    return {name: table[name] for name in METRICS if name in table and len(table[name].values)}


def _over_pairs(good: np.ndarray, alone: np.ndarray, label: np.ndarray, streams: np.ndarray) -> Scores:
    """Score every (question, attribute, pair) by 1[good_a and good_b and ŷ_a = ŷ_b]."""
    n, sensors, attributes = alone.shape
    if label.shape != (n, attributes) or streams.shape != (n, sensors):
        raise ValueError(
            f"alone is {list(alone.shape)}, label {list(label.shape)}, streams {list(streams.shape)}: "
            "they must be [N, S, A], [N, A] and [N, S]; align the arrays"
        )
    pairs = np.array(list(itertools.combinations(range(sensors), 2)), int).reshape(-1, 2)
    a, b = pairs[:, 0], pairs[:, 1]
    same = good[:, a] & good[:, b] & (alone[:, a] == alone[:, b])
    counts = (streams[:, a] & streams[:, b])[:, :, None] & (label != BOTTOM)[:, None, :]
    return keep_scored(100.0 * same, counts)


def keep_scored(values: np.ndarray, scored: np.ndarray, strata: np.ndarray | None = None) -> Scores:
    """Keep the scored entries of an array [N, ...] and remember the question each comes from."""
    strata = np.zeros(values.shape, int) if strata is None else strata
    return Scores(values=values[scored], items=np.nonzero(scored)[0], strata=strata[scored])


def check_same_shape(**arrays: np.ndarray) -> None:
    """Raise a `ValueError` that names the shapes unless all arrays have the same."""
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"shapes are {shapes}: they must be equal; align the arrays")
