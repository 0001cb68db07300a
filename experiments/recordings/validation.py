"""Cross-validation over objects: folds, constant baselines, what is scored and with which interval."""

import collections
import dataclasses
import hashlib
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.core.errors import ConfigurationError
from experiments.core.results import Cell, Column, Table
from experiments.recordings.policy import COMBINATIONS, LANGUAGE, LEVELS
from touchr1_jax.bench.metrics import Scores, accuracy, mean_accuracy, ordinal_mae
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap

SCORES: Mapping[str, str] = {
    "all right": "videos of which hardness, roughness and bumps are all answered right",
    "mean": "mean of the three shares of videos answered right",
    "OMAE": "mean distance between answer and label, levels",
    **{a.name: f"videos whose {a.name} is answered right" for a in LANGUAGE.attributes},
}
"""What is reported of answers, and what it means; all but OMAE in per cent."""


def deal_folds(objects: np.ndarray, label: Int[np.ndarray, "n A"], count: int, seed: int) -> Int[np.ndarray, "n"]:
    """Fold of each video, all of an object in one, objects of one combination of levels spread over the folds.

    Objects are dealt in turn, combination by combination, in the order of a hash, so that neither the order of the
    videos nor the random generator's version matters.

    Raises:
      ConfigurationError: fewer objects than folds.
    """
    names, first = np.unique(objects, return_index=True)
    if len(names) < count:
        raise ConfigurationError(f"folds is {count}: must be ≤ {len(names)}, the number of objects; lower it")
    digest = [hashlib.sha256(f"{seed}/{name}".encode()).hexdigest() for name in names]
    order = sorted(range(len(names)), key=lambda i: (tuple(label[first[i]]), digest[i]))
    fold = {names[i]: place % count for place, i in enumerate(order)}
    return np.array([fold[name] for name in objects])


def object_weights(objects: np.ndarray, chosen: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """1 over the number of chosen videos of the object, 0 for the others: every object counts the same."""
    size = collections.Counter(objects[chosen].tolist())
    return np.array([1 / size[name] if use else 0.0 for name, use in zip(objects, chosen, strict=True)], np.float32)


def constants(label: np.ndarray, objects: np.ndarray, fold: np.ndarray) -> dict[str, Int[np.ndarray, "n A"]]:
    """Answers that know no touch: per attribute and joint mode of the training objects of each fold."""
    answers = {name: np.zeros_like(label) for name in ("constant, each attribute's mode", "constant, joint mode")}
    for k in np.unique(fold):
        weight = object_weights(objects, fold != k)
        each = [np.bincount(label[:, a], weight, LEVELS).argmax() for a in range(label.shape[1])]
        joint = np.bincount((label * LEVELS ** np.arange(label.shape[1])[::-1]).sum(1), weight, len(COMBINATIONS))
        for rows, level in zip(answers.values(), (each, COMBINATIONS[joint.argmax()]), strict=True):
            rows[fold == k] = level
    return answers


def scores(answer: Int[np.ndarray, "n A"], label: Int[np.ndarray, "n A"]) -> dict[str, Scores]:
    """Those of `SCORES`."""
    whole = (answer == label).all(1).astype(int)
    levels = np.full(label.shape[1], LEVELS)
    return {
        "all right": accuracy(whole, np.ones_like(whole)),
        "mean": mean_accuracy(answer, label),
        "OMAE": ordinal_mae(answer, label, levels),
        **{a.name: accuracy(answer[:, i], label[:, i]) for i, a in enumerate(LANGUAGE.attributes)},
    }


def intervals(answer: np.ndarray, label: np.ndarray, objects: np.ndarray) -> dict[str, Interval]:
    """95 % intervals of `SCORES` over objects."""
    return {
        name: clustered_bootstrap(score.values, objects[score.items], strata=score.strata)
        for name, score in scores(answer, label).items()
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """Answers of one method about some videos."""

    name: str
    answer: Int[np.ndarray, "n A"]


def score_table(title: str, rows: Sequence[Row], label: np.ndarray, objects: np.ndarray, note: str = "") -> Table:
    """One line per method; all right, mean and OMAE with their intervals."""
    columns = [Column(name="answers by")]
    for name, meaning in SCORES.items():
        columns.append(Column(name=name, unit=_unit(name), meaning=meaning, format=_format(name)))
        if name in _HEAD:
            columns.append(Column(name=f"{name}, 95 %", meaning=f"interval of {name} over objects"))
    cells: list[tuple[Cell, ...]] = []
    for row in rows:
        found = intervals(row.answer, label, objects)
        line: list[Cell] = [row.name]
        for name, interval in found.items():
            line.append(interval.mean)
            if name in _HEAD:
                line.append(f"{interval.low:{_format(name)}}–{interval.high:{_format(name)}}")
        cells.append(tuple(line))
    return Table(title=title, columns=tuple(columns), rows=tuple(cells), note=note)


def fold_table(answer: np.ndarray, label: np.ndarray, objects: np.ndarray, fold: np.ndarray) -> Table:
    """Every fold by itself."""
    columns = [Column(name="fold"), Column(name="objects", format="d"), Column(name="videos", format="d")]
    columns += [Column(name=name, format=_format(name), unit=_unit(name)) for name in SCORES]
    rows: list[tuple[Cell, ...]] = []
    for k in np.unique(fold):
        here = fold == k
        found = [score.mean() for score in scores(answer[here], label[here]).values()]
        rows.append((str(k + 1), len(np.unique(objects[here])), int(here.sum()), *found))
    return Table(title="Every fold", columns=tuple(columns), rows=tuple(rows))


_HEAD = ("all right", "mean", "OMAE")


def _unit(name: str) -> str:
    return "" if name == "OMAE" else "%"


def _format(name: str) -> str:
    return ".3f" if name == "OMAE" else ".1f"
