"""Cross-validation over objects: folds, answers of policies and probes, several videos as one, scores."""

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize
from scipy.special import log_softmax, softmax

from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Cell, Table, named_table
from experiments.recordings.descriptions import AuxiliaryData, DescribedVideos
from experiments.recordings.learning import LearnConfig, answer_log_probs, learn
from experiments.recordings.level_probes import GROUPS, READINGS, SCENES, LevelProbeConfig, ProbedVideos
from sensors_io.touches import families
from touchr1_jax.bench.metrics import Scores, accuracy, mean_accuracy, ordinal_mae
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.models.description_policy import COMBINATIONS, LANGUAGE, LEVELS, choose
from touchr1_jax.training.kernel_probe import object_weights, standardise

SHARPNESS = 3.0  # power of a probe's probabilities: ridge regression shrinks them, as `reading_lesson` says

SCORES: Mapping[str, str] = {
    "all right": "videos of which hardness, roughness and bumps are all answered right",
    "mean": "mean of the three shares of videos answered right",
    "OMAE": "mean distance between answer and label, levels",
    **{a.name: f"videos whose {a.name} is answered right" for a in LANGUAGE.attributes},
}
"""Reported scores and their meaning; all but OMAE in per cent."""

FORMATS, UNITS = dict.fromkeys(SCORES, ".1f") | {"OMAE": ".3f"}, dict.fromkeys(SCORES, "%") | {"OMAE": ""}


def require_divisions(seeds: Sequence[int], folds: int, probes: LevelProbeConfig) -> None:
    """Refuse partitions and probes that cannot be fitted, before videos are read and scenes are made.

    Raises:
      ConfigurationError: naming the field, its value and the constraint.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigurationError(f"seeds is {tuple(seeds)}: must be different seeds, at least one; correct it")
    for name, count in (("folds", folds), ("learn.evidence.folds", probes.folds)):
        if count < 2:
            raise ConfigurationError(f"{name} is {count}: must be at least 2, or nothing is left to fit on; raise it")
    for name in ("ridge", "scene_ridge"):
        if not getattr(probes, name) > 0:
            raise ConfigurationError(f"learn.evidence.{name} is {getattr(probes, name)}: must be above 0; raise it")
    known, read = {*families(), *SCENES}, {name for of in probes.by_attribute for name in of}
    if not probes.families or set(probes.families) - known or read - set(probes.families):
        raise ConfigurationError(
            f"learn.evidence.families is {probes.families}: must hold those of by_attribute {probes.by_attribute} and "
            f"some of {', '.join(sorted(known))}; correct it"
        )
    if len(probes.by_attribute) not in (0, len(LANGUAGE.attributes)) or not all(probes.by_attribute):
        raise ConfigurationError(
            f"learn.evidence.by_attribute is {probes.by_attribute}: must be empty, or hold families for each of "
            f"{len(LANGUAGE.attributes)} attributes; correct it"
        )


def deal_folds(objects: np.ndarray, label: Int[np.ndarray, "n A"], count: int, seed: int) -> Int[np.ndarray, "n"]:
    """Fold of each video, all of an object in one, objects of one combination of levels spread over the folds.

    Objects are dealt in turn, combination by combination, in the order of a hash, so that neither the order of the
    videos nor the random generator's version matters; they must be as many as folds.
    """
    names, first = np.unique(objects, return_index=True)
    if len(names) < count:
        raise ConfigurationError(f"folds is {count}: must be ≤ {len(names)}, the number of objects; lower it")
    digest = [hashlib.sha256(f"{seed}/{name}".encode()).hexdigest() for name in names]
    order = sorted(range(len(names)), key=lambda i: (tuple(label[first[i]]), digest[i]))
    fold = {names[i]: place % count for place, i in enumerate(order)}
    return np.array([fold[name] for name in objects])


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
    """A partition of labelled videos into folds by object, on which policies and probes are compared.

    `seed` is that of the partition and of what is trained on it; `context` keeps finished folds, log and times.
    """

    config: LearnConfig
    videos: DescribedVideos
    auxiliary: AuxiliaryData
    fold: np.ndarray
    seed: int
    context: Context

    def policy(self, config: LearnConfig, stage: str, *, together: bool = False) -> Float[np.ndarray, "n 27"]:
        """Log-probabilities of the answers about every video by a policy that never met its object.

        Finished folds are not repeated.  With `together`, each prompt holds all videos of the object.
        """
        found = np.zeros((len(self.videos.names), len(COMBINATIONS)))
        for k in self.context.each(stage, np.unique(self.fold)):
            out, name = self.fold == k, f"{stage}/{self.seed}/{k}"
            if not self.context.done(name):
                trained = learn(config, self.videos.rows(~out), self.auxiliary, self.seed, self.context, name)
                read = self.videos.rows(out)
                asked = [np.flatnonzero(read.objects == owner) for owner in read.objects] if together else None
                self.context.save_stage(name, answer_log_probs(trained, read, asked).tolist())
            found[out] = self.context.load_stage(name)
        return found

    def probes(
        self, config: LearnConfig | None = None, auxiliary: AuxiliaryData | None = None, objects: int | None = None
    ) -> Float[np.ndarray, "n 27"]:
        """As `policy`, by probes alone that learn from so many of the objects of the other folds, all by default."""
        config, auxiliary, videos = config or self.config, auxiliary or self.auxiliary, self.videos
        found = np.zeros((len(videos.names), len(COMBINATIONS)))
        for k in self.context.each("probes", np.unique(self.fold)):
            names = np.unique(videos.objects[self.fold != k])
            kept = np.random.default_rng(0).permutation(names)[:objects]
            training, out = videos.rows(np.isin(videos.objects, kept)), self.fold == k
            read = ProbedVideos(training, auxiliary, videos.rows(out), config.evidence)
            found[out] = joint_log_prob(read.evidence())
        return found

    def policy_variants(self) -> dict[str, np.ndarray]:
        """Log-probabilities of policies of one member with something left out or added; the last pools videos."""
        single = dataclasses.replace(self.config, members=1)
        several = dataclasses.replace(single.shape, contacts=6)
        changes: dict[str, dict[str, Any]] = {
            "one member": {},
            "one member, labels alone as targets": {"evidence": dataclasses.replace(single.evidence, rating_share=0.0)},
        }
        stage = lambda name: "ablation/" + name.replace(" ", "-").replace(",", "")
        found = {name: self.policy(dataclasses.replace(single, **new), stage(name)) for name, new in changes.items()}
        pooled = pool(found["one member"], self.videos.objects)
        name = "one member, all videos of the object in one prompt"
        prompt = self.policy(dataclasses.replace(single, shape=several), stage(name), together=True)
        return found | {"one member, probabilities of all videos pooled": pooled, name: prompt}

    def probe_variants(self) -> dict[str, np.ndarray]:
        """Log-probabilities of the probes alone with something left out or added."""
        config, auxiliary, evidence = self.config, self.auxiliary, self.config.evidence
        change = lambda **new: dataclasses.replace(config, evidence=dataclasses.replace(evidence, **new))
        with_all = lambda families: (change(families=families, by_attribute=()), auxiliary)
        only = lambda part: with_all(tuple(f for f in SCENES if part in f))
        own = tuple(dict.fromkeys(families()))
        one_set = {name: getattr(auxiliary, name)[:1] for name in ("scene_x", "scene_target")}
        few = {name: getattr(auxiliary, name)[:, ::10] for name in ("scene_x", "scene_target")}
        bare = dataclasses.replace(auxiliary, unlabelled=auxiliary.unlabelled[:0])
        variants = {
            "probes of what scenes teach": (config, auxiliary),
            "the same, labels alone as targets": (change(rating_share=0.0), auxiliary),
            "the same, one set of scenes": (config, dataclasses.replace(auxiliary, **one_set)),
            "the same, a tenth of the scenes": (config, dataclasses.replace(auxiliary, **few)),
            "the same, no unlabelled videos": (config, bare),
            "the same, every attribute by every group": only("scenes"),
            **{f"the same, {reading} alone": only(f"scenes, {reading},") for reading in READINGS},
            **{f"the same, {' and '.join(kinds)} alone": only(f", {group}") for group, kinds in GROUPS.items()},
            "probes of the description, no scenes": with_all(own),
        }
        every = self.context.each("variants of the probes", variants.items())
        return {name: self.probes(*variant) for name, variant in every}

    def label_limits(self) -> dict[str, np.ndarray]:
        """Answers that bound the answers of any policy.

        - *the object was touched before*: probes on all other videos, those of the same object among them.  Errors
          remain where trials of one object differ more than objects of different labels do.
        - *nearest other object*: the labels of the object whose mean description lies nearest.  Errors show how often
          objects of similar description were judged differently.
        """
        config, videos = self.config, self.videos
        trial = np.zeros(len(videos.names), int)
        for name in np.unique(videos.objects):
            trial[videos.objects == name] = np.arange((videos.objects == name).sum())
        known = np.zeros_like(videos.label)
        for k in self.context.each("touched before", np.unique(trial)):
            out = trial == k
            read = ProbedVideos(videos.rows(~out), self.auxiliary, videos.rows(out), config.evidence)
            known[out] = choose(joint_log_prob(read.evidence()))
        return {
            "probes": choose(self.probes()),
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


def joint_log_prob(p: Float[np.ndarray, "n A K"], sharpness: float = SHARPNESS) -> Float[np.ndarray, "n 27"]:
    """Log-probabilities of every answer if the attributes were independent, Σ_a ln (p_a^s / Σ p_a^s)."""
    log = sharpness * np.log(np.maximum(p, 1e-6))
    log -= np.log(np.exp(log).sum(-1, keepdims=True))
    return sum(log[:, a][:, COMBINATIONS[:, a]] for a in range(p.shape[1]))


def marginals(log_prob: Float[np.ndarray, "n 27"]) -> Float[np.ndarray, "n A K"]:
    """Probability of each level of each attribute."""
    return np.einsum("nc,cak->nak", np.exp(log_prob), np.eye(LEVELS)[COMBINATIONS])


def pool(log_prob: Float[np.ndarray, "n 27"], objects: np.ndarray) -> Float[np.ndarray, "n 27"]:
    """For every video the answer to all videos of its object: the median of the probability of each level.

    The median, for a press that missed the object says something else with confidence.
    """
    p = marginals(log_prob)
    for name in np.unique(objects):
        middle = np.median(p[objects == name], 0)
        p[objects == name] = middle / middle.sum(-1, keepdims=True)
    return joint_log_prob(p, sharpness=1.0)


def confidence(answer: Int[np.ndarray, "n A"], evidence: Float[np.ndarray, "n 27"]) -> Float[np.ndarray, "n"]:
    """Minus the expected distance of answers from the truth, levels: the surest have the greatest.

    By the evidence without its power: sharpened, it is near 1 for every level that is ahead, and so is a policy that
    read it.
    """
    p = marginals(evidence) ** (1 / SHARPNESS)
    distance = np.abs(np.arange(LEVELS) - answer[..., None])
    return -(p / p.sum(-1, keepdims=True) * distance).sum(-1).mean(-1)


def agreement(answer: Int[np.ndarray, "n A"], objects: np.ndarray) -> float:
    """Per cent of pairs of videos of one object that are answered alike in all attributes."""
    same, pairs = 0.0, 0
    for name in np.unique(objects):
        mine = answer[objects == name]
        alike = (mine[:, None] == mine[None]).all(-1)
        same += (alike.sum() - len(mine)) / 2
        pairs += len(mine) * (len(mine) - 1) // 2
    return 100 * same / max(pairs, 1)


PENALTY = 100.0  # λ of the logistic regression, chosen from 10, 100 and 1000 on other partitions


def constants(
    label: Int[np.ndarray, "n A"], objects: np.ndarray, fold: Int[np.ndarray, "n"]
) -> dict[str, Int[np.ndarray, "n A"]]:
    """Answers without touch: per attribute and joint mode of the training objects of each fold."""
    answers = {name: np.zeros_like(label) for name in ("constant, each attribute's mode", "constant, joint mode")}
    for k in np.unique(fold):
        weight = object_weights(objects, fold != k)
        each = [np.bincount(label[:, a], weight, LEVELS).argmax() for a in range(label.shape[1])]
        joint = np.bincount((label * LEVELS ** np.arange(label.shape[1])[::-1]).sum(1), weight, len(COMBINATIONS))
        for rows, level in zip(answers.values(), (each, COMBINATIONS[joint.argmax()]), strict=True):
            rows[fold == k] = level
    return answers


def logistic(videos: DescribedVideos, fold: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 27"]:
    """Log-probabilities by multinomial logistic regression on the description, one for each attribute and fold.

    The description (`sensors_io.touches`) holds the hand features: texture by octave, edges, contact area, and growth,
    motion and decay over the video.
    """
    found = np.zeros((*videos.label.shape, LEVELS))
    for k in np.unique(fold):
        fit = fold != k
        z, weight = standardise(videos.x.astype(np.float64), fit), object_weights(videos.objects, fit)[fit]
        for a in range(videos.label.shape[1]):
            coefficient = _fit(z[fit], np.eye(LEVELS)[videos.label[fit, a]], weight / weight.mean())
            found[~fit, a] = softmax(z[~fit] @ coefficient[:-1] + coefficient[-1], -1)
    return joint_log_prob(found, sharpness=1.0)


def _fit(z: np.ndarray, target: np.ndarray, weight: np.ndarray) -> Float[np.ndarray, "D+1 K"]:
    """Coefficients and, last, intercepts that minimise Σ w CE + λ/2 ‖coefficients‖²."""
    shape = (z.shape[1] + 1, LEVELS)

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        b = flat.reshape(shape)
        log = log_softmax(z @ b[:-1] + b[-1], -1)
        error = weight[:, None] * (np.exp(log) - target)
        slope = np.concatenate([z.T @ error + PENALTY * b[:-1], error.sum(0, keepdims=True)])
        return -(weight[:, None] * target * log).sum() + PENALTY / 2 * (b[:-1] ** 2).sum(), slope.ravel()

    return minimize(loss, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B").x.reshape(shape)


def people(videos: DescribedVideos) -> dict[int, Int[np.ndarray, "n"]]:
    """Levels of each rated attribute by the ratings, cut at two thresholds that fit all other objects best.

    Keys are positions of attributes; those that nobody rated are missing, and so are all if there are no ratings.
    """
    names, first = np.unique(videos.objects, return_index=True)
    member = np.searchsorted(names, videos.objects)
    found = {}
    for a in range(videos.label.shape[1]):
        rating, level = videos.rating[first, a], videos.label[first, a]
        if not np.isfinite(rating).all():
            continue
        at = np.unique(rating)
        cuts = [(low, high) for i, low in enumerate(at) for high in at[i:]]
        cut = np.array([(rating >= low).astype(int) + (rating >= high) for low, high in cuts])
        right = cut == level
        others = right.sum(1)[:, None] - right
        best = others == others.max(0)
        middle = [int(np.median(cut[best[:, i], i])) for i in range(len(names))]
        found[a] = np.array(middle)[member]
    return found


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
