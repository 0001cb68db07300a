"""Folds and weights of objects, constant baselines, scores with intervals over objects, and their tables."""

import collections
import hashlib
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.core.errors import ConfigurationError
from experiments.core.results import Cell, Table, named_table
from experiments.recordings.description_policy import COMBINATIONS, LANGUAGE, LEVELS
from touchr1_jax.bench.metrics import Scores, accuracy, mean_accuracy, ordinal_mae
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap

SCORES: Mapping[str, str] = {
    "all right": "videos of which hardness, roughness and bumps are all answered right",
    "mean": "mean of the three shares of videos answered right",
    "OMAE": "mean distance between answer and label, levels",
    **{a.name: f"videos whose {a.name} is answered right" for a in LANGUAGE.attributes},
}
"""Reported scores and their meaning; all but OMAE in per cent."""

FORMATS, UNITS = dict.fromkeys(SCORES, ".1f") | {"OMAE": ".3f"}, dict.fromkeys(SCORES, "%") | {"OMAE": ""}


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
    """Answers without touch: per attribute and joint mode of the training objects of each fold."""
    answers = {name: np.zeros_like(label) for name in ("constant, each attribute's mode", "constant, joint mode")}
    for k in np.unique(fold):
        weight = object_weights(objects, fold != k)
        each = [np.bincount(label[:, a], weight, LEVELS).argmax() for a in range(label.shape[1])]
        joint = np.bincount((label * LEVELS ** np.arange(label.shape[1])[::-1]).sum(1), weight, len(COMBINATIONS))
        for rows, level in zip(answers.values(), (each, COMBINATIONS[joint.argmax()]), strict=True):
            rows[fold == k] = level
    return answers


def scores(answer: Int[np.ndarray, "n A"], label: Int[np.ndarray, "n A"]) -> dict[str, Scores]:
    """The scores of `SCORES`."""
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


def score_table(
    title: str, answers: Mapping[str, np.ndarray], label: np.ndarray, objects: np.ndarray, note: str = ""
) -> Table:
    """One line per method; all right, mean and OMAE with their intervals."""
    with_interval = ("all right", "mean", "OMAE")
    rows = []
    for method, answer in answers.items():
        row: dict[str, Cell] = {"answers by": method}
        for name, found in intervals(answer, label, objects).items():
            row[name] = found.mean
            if name in with_interval:
                row[f"{name}, 95 %"] = f"{found.low:{FORMATS[name]}}–{found.high:{FORMATS[name]}}"
        rows.append(row)
    meanings = dict(SCORES) | {f"{name}, 95 %": f"interval of {name} over objects" for name in with_interval}
    return named_table(title, rows, formats=FORMATS, units=UNITS, meanings=meanings, note=note)


def fold_table(answer: np.ndarray, label: np.ndarray, objects: np.ndarray, fold: np.ndarray) -> Table:
    """Scores of every fold."""
    rows = []
    for k in np.unique(fold):
        here = fold == k
        row = {"fold": str(k + 1), "objects": len(np.unique(objects[here])), "videos": int(here.sum())}
        rows.append(row | {name: score.mean() for name, score in scores(answer[here], label[here]).items()})
    return named_table("Every fold", rows, formats=FORMATS | {"objects": "d", "videos": "d"}, units=UNITS)
