"""Cross-validation over objects: folds, baselines, scores, the contribution of each part, and limits of the answers."""

import dataclasses
import hashlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Int

from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Cell, Table, named_table
from experiments.recordings.descriptions import AuxiliaryData, DescribedVideos
from experiments.recordings.learning import LearnConfig, answer_log_probs, learn, probe_answers
from experiments.recordings.level_probes import SCENES
from sensors_io.touches import families
from touchr1_jax.bench.metrics import Scores, accuracy, mean_accuracy, ordinal_mae
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.models.description_policy import COMBINATIONS, LANGUAGE, LEVELS, choose
from touchr1_jax.training.description_tuning import ReinforceConfig
from touchr1_jax.training.kernel_probe import object_weights, standardise

SHARES = (0.25, 0.5, 0.75, 1.0)  # of the training objects, that the probes learn from


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class CrossValidation:
    """A partition of labelled videos into folds, on which policies and probes are compared.

    Attributes:
      config: the policy.
      videos: labelled videos.
      auxiliary: scenes and unlabelled videos.
      fold: of each video, int [n]; all videos of an object are in one.
      context: keeps finished folds, log and times.
    """

    config: LearnConfig
    videos: DescribedVideos
    auxiliary: AuxiliaryData
    fold: np.ndarray
    context: Context

    def policy_answers(self, config: LearnConfig, seed: int, stage: str) -> Int[np.ndarray, "n A"]:
        """Answers about every video by a policy that never met its object; finished folds are not repeated."""
        answers = np.zeros_like(self.videos.label)
        for k in self.context.each(stage, np.unique(self.fold)):
            out, name = self.fold == k, f"{stage}/{k}"
            if not self.context.done(name):
                trained = learn(config, self.videos.rows(~out), self.auxiliary, seed, self.context, name)
                self.context.save_stage(name, choose(answer_log_probs(trained, self.videos.rows(out))).tolist())
            answers[out] = self.context.load_stage(name)
        return answers

    def probe_answers(
        self, config: LearnConfig, auxiliary: AuxiliaryData, share: float = 1.0
    ) -> Int[np.ndarray, "n A"]:
        """Answers of the probes alone, each fold read by probes on a share of the objects of the other folds."""
        videos, answers = self.videos, np.zeros_like(self.videos.label)
        for k in self.context.each("probes", np.unique(self.fold)):
            names = np.unique(videos.objects[self.fold != k])
            kept = np.random.default_rng(0).permutation(names)[: max(1, round(share * len(names)))]
            training, out = videos.rows(np.isin(videos.objects, kept)), self.fold == k
            answers[out] = probe_answers(config, training, auxiliary, videos.rows(out))
        return answers

    def growth(self) -> dict[int, dict[str, Interval]]:
        """Scores of the probes by the number of objects that they learn from."""
        videos = self.videos
        objects = np.mean([len(np.unique(videos.objects[self.fold != k])) for k in np.unique(self.fold)])
        return {
            round(share * objects): intervals(
                self.probe_answers(self.config, self.auxiliary, share), videos.label, videos.objects
            )
            for share in self.context.each("shares of the objects", SHARES)
        }

    def policy_variants(self, seed: int) -> dict[str, np.ndarray]:
        """Answers of policies with something left out or added."""
        single = dataclasses.replace(self.config, members=1)
        tune, untaught = self.config.tune, dataclasses.replace(self.config.reading, steps=0)
        faster = dataclasses.replace(tune.optimizer, lr_scale=300.0)
        from_scratch = dataclasses.replace(tune, steps=100, optimizer=faster)
        changes: dict[str, dict[str, Any]] = {
            "one member": {},
            "one member, not tuned on labels": {"tune": dataclasses.replace(tune, steps=0)},
            "one member, on labels from scratch": {"reading": untaught, "tune": from_scratch},
            "one member, components beside the evidence": {"components": 12},
            "one member, then GRPO": {"reinforce": ReinforceConfig(steps=40)},
        }
        return {
            name: self.policy_answers(
                dataclasses.replace(single, **change), seed, "ablation/" + name.replace(" ", "-").replace(",", "")
            )
            for name, change in changes.items()
        }

    def probe_variants(self) -> dict[str, np.ndarray]:
        """Answers of the probes alone with something left out or added."""
        config, auxiliary, evidence = self.config, self.auxiliary, self.config.evidence
        with_probes = lambda **change: dataclasses.replace(config, evidence=dataclasses.replace(evidence, **change))
        own, bare = (
            tuple(dict.fromkeys(families())),
            dataclasses.replace(auxiliary, unlabelled=auxiliary.unlabelled[:0]),
        )
        fewer = {name: getattr(auxiliary, name)[::10] for name in ("scene_x", "scene_target")}
        variants = {
            "probe of what scenes teach": (config, auxiliary),
            "the same, a tenth of the scenes": (config, dataclasses.replace(auxiliary, **fewer)),
            "the same, no unlabelled videos": (config, bare),
            "the same, scenes' ridge as the others'": (with_probes(scene_ridge=evidence.ridge), auxiliary),
            "probes of the description, no scenes": (with_probes(families=own), auxiliary),
            "probes of the description and of what scenes teach": (with_probes(families=(*own, SCENES)), auxiliary),
            **{f"probe of {name} alone, no scenes": (with_probes(families=(name,)), auxiliary) for name in own},
        }
        every = self.context.each("variants of the probes", variants.items())
        return {name: self.probe_answers(*variant) for name, variant in every}

    def label_limits(self) -> dict[str, np.ndarray]:
        """Answers that bound the answers of any policy.

        - *vote*: the answers of the probes, those of an object's videos pooled.  The remaining errors are not due to
          single trials.
        - *the object was touched before*: probes on all other videos, those of the same object among them.  Errors
          remain where trials of one object differ more than objects of different labels do.
        - *nearest other object*: the labels of the object whose mean description lies nearest.  Errors show how often
          objects of similar description were judged differently.
        """
        config, videos = self.config, self.videos
        known = np.zeros_like(videos.label)
        for i in self.context.each("touched before", range(len(videos.names))):
            this = np.arange(len(videos.names)) == i
            known[this] = probe_answers(config, videos.rows(~this), self.auxiliary, videos.rows(this))
        answers = self.probe_answers(config, self.auxiliary)
        return {
            "probes": answers,
            "probes, vote over all videos of an object": vote(answers, videos.objects),
            "probes, the object was touched before": known,
            "labels of the nearest other object": videos.label[_nearest_other(videos)],
        }


def _nearest_other(videos: DescribedVideos) -> Int[np.ndarray, "n"]:
    """A video of the object nearest to that of each video."""
    z = standardise(videos.x.astype(np.float64), np.ones(len(videos.names), bool))
    names, first, member = np.unique(videos.objects, return_index=True, return_inverse=True)
    centre = np.stack([z[member == i].mean(0) for i in range(len(names))])
    distance = np.linalg.norm(centre[:, None] - centre, axis=-1)
    np.fill_diagonal(distance, np.inf)
    return first[distance.argmin(1)][member]


def objects_for(errors: Mapping[int, float], bound: float) -> float:
    """Number of objects to learn from until the error falls to a bound, by the power law through the measured points.

        ln e(n) = a − b ln n by least squares;   n = exp((a − ln bound) / b)

    The form of learning curves in Hestness et al. 2017, without a floor; if there is one, more objects are needed.

    Args:
      errors: objects learned from → error, at two numbers of objects or more.
      bound: error to reach, > 0.

    Returns:
      Objects: the fewest at which the bound was measured, else extrapolated; infinite where the error does not fall.
    """
    reached = [n for n, error in errors.items() if error <= bound]
    if reached:
        return min(reached)
    slope, start = np.polyfit(np.log(list(errors)), np.log(list(errors.values())), 1)
    return math.exp((math.log(bound) - start) / slope) if slope < 0 else math.inf


def vote(answer: Int[np.ndarray, "n A"], objects: np.ndarray) -> Int[np.ndarray, "n A"]:
    """For every video the most frequent answer to its object's videos, per attribute, the lowest of equals."""
    voted = answer.copy()
    for name in np.unique(objects):
        mine = objects == name
        voted[mine] = [np.bincount(column, minlength=LEVELS).argmax() for column in answer[mine].T]
    return voted


def agreement(answer: Int[np.ndarray, "n A"], objects: np.ndarray) -> float:
    """Per cent of pairs of videos of one object that are answered alike in all attributes."""
    same, pairs = 0.0, 0
    for name in np.unique(objects):
        mine = answer[objects == name]
        alike = (mine[:, None] == mine[None]).all(-1)
        same += (alike.sum() - len(mine)) / 2
        pairs += len(mine) * (len(mine) - 1) // 2
    return 100 * same / max(pairs, 1)


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
