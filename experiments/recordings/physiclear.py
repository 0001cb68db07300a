"""How well does the policy answer about real objects that it never touched, from one touch and from several?

    python -m experiments physiclear --data-dir DIR [--scale smoke]
    python -m experiments physiclear --predict VIDEO [VIDEO ...] --out PRED.json [--policy RUN/policy.npz]

PhysiCLeAR (Yu et al., Octopi, RSS 2024): GelSight Mini videos of objects pressed and turned by hand.  People labelled
hardness, roughness and bumps of 67 objects on three levels.  Ten-fold cross-validation by object on eight partitions;
intervals over objects.  Settings were chosen on partitions 101 to 108 of the same objects; ablations and curves use
partition 101.  If the folder contains ratings.json, a target is the mean of the label and of the probability of each
level given people's ratings of the object (training objects only).  The saved policy learns from all labelled objects.
With `--predict`, this policy answers for each video of a folder, or for each named video and for all of them together
as touches of one object, in words with probabilities.

Cost: 5 minutes of one core to generate scenes, once, and 6 for the rest; `--scale smoke` half a minute.

Expected: from one video, all three levels right for 45 % of the videos, 73 % of the levels right, OMAE .31; from all
videos of an object 51 %, 77 % and .26.  People's ratings agree with 75 to 79 % of the labels.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from experiments.core.artifacts import write_json
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Requirement, Results, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.core.text import interval
from experiments.recordings import findings
from experiments.recordings.cross_validation import (
    CrossValidation,
    agreement,
    constants,
    deal_folds,
    intervals,
    logistic,
    marginals,
    people,
    pool,
    require_divisions,
    score_table,
)
from experiments.recordings.descriptions import (
    AuxiliaryData,
    DescribedVideos,
    auxiliary_data,
    describe_files,
    describe_source,
    videos_of,
)
from experiments.recordings.learning import LearnConfig, TrainedEnsemble, answer_log_probs, identity, learn, load, save
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.bench.statistics import Interval
from touchr1_jax.models.description_policy import LANGUAGE, choose, description_policy

POLICY = "policy.npz"  # file of the policy of all objects in a run
ONE, ALL, SUREST = "", "all videos: ", "surest half: "
GOALS: Mapping[str, Mapping[str, float]] = {
    ONE: {"all right": 44.0, "mean": 72.5, "OMAE": 0.315},
    ALL: {"all right": 49.0, "mean": 76.5, "OMAE": 0.26},
    SUREST: {"all right": 55.0, "mean": 80.0},
}
"""Answers to one video, to all of an object, and the half that it is surest of → score → its bound."""

MINUTES = 15.0  # bound of the time for scenes and one partition, all folds together
DEVELOPMENT = 101  # seed of the partition that ablations and curves are measured on
UNSURE = 0.3  # probability that all three are right, below which an answer says that it is unsure
CACHED = {"descriptions": "descriptions of videos", "scenes": "descriptions of scenes"}
"""Stages that cost time only where the cache lacks their output, and that output."""

_ELSEWHERE = "On the partition that settings were chosen on, not one of those of the first table."
_LIMITS = "Probes alone, on that partition too.  To have touched the object before is not allowed above."


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysiclearStudy:
    """Training, validation, and objects left out."""

    data_dir: Path | None = None  # folder with labels.json and videos/; needed to train
    predict: tuple[Path, ...] = ()
    """A folder of videos to answer for one by one, or videos of one object, instead of validating."""
    out: Path | None = None  # where the answers go, as JSON
    policy: Path | None = None
    """The trained policy; by default that of data_dir, which is trained first, or without data_dir the cache's last."""
    objects: int | None = None  # labelled objects to use; all by default
    frames: int = 8  # frames in contact that are described of each video
    folds: int = 10
    seeds: tuple[int, ...] = tuple(range(1001, 1009))  # of the partitions into folds, and of the training on each
    ablations: bool = True  # whether variants of the policy are trained too
    scenes: SceneConfig = SceneConfig(objects=800, sites=1)
    """Scenes that are generated for training, in addition to the videos."""
    scene_sets: int = 3  # sets of them, of consecutive seeds, whose probes are averaged
    learn: LearnConfig = LearnConfig()

    def __post_init__(self) -> None:
        require_divisions(self.seeds, self.folds, self.learn.evidence)


def run(config: PhysiclearStudy, context: Context) -> Results:
    """Validate and train, or predict; `ConfigurationError` without data_dir, or with a part of a prediction."""
    if config.policy is not None and (not config.predict or config.data_dir is not None):
        raise ConfigurationError(
            f"policy is {config.policy}: is read by --predict alone, in the place of data_dir ({config.data_dir}), on "
            "which another is trained; leave one of them out, or name videos"
        )
    if bool(config.predict) != (config.out is not None):
        named = " ".join(map(str, config.predict)) or None
        raise ConfigurationError(f"predict is {named}, out {config.out}: give both to predict, or neither")
    if config.out is not None:
        return predict(config, config.out, context)
    if config.data_dir is None:
        raise ConfigurationError("data_dir is None: must be the folder of labels.json and videos/; give --data-dir")
    return validate(config, config.data_dir, context)


def predict(config: PhysiclearStudy, out: Path, context: Context) -> Results:
    """Answer for videos with a trained policy; several that are named one by one are also answered together."""
    if config.data_dir is None:
        own = cached_policy(config, context)
        trained = load(config.policy, config.learn) if config.policy else load(own, config.learn, of=own.stem)
    else:
        trained = policy_of(config, config.data_dir, context)
    videos = describe_files(videos_of(config.predict), config.frames, context)
    found = answer_log_probs(trained, videos)
    answers = {str(name): in_words(row) for name, row in zip(videos.names, found, strict=True)}
    if len(config.predict) > 1:
        answers["together"] = in_words(pool(found, np.zeros(len(found), int))[0])
    write_json(out, answers)
    left_out = "".join(f" Left out: {skip.name}, {skip.reason}." for skip in videos.skipped)
    rows = [{"video": name, "answer": answer["words"]} for name, answer in answers.items()]
    return Results(
        verdict=(f"{len(videos.names)} videos answered in {out}.{left_out}",),
        tables=(named_table("Answers", rows),),
        settings={"objects learned from": len(np.unique(trained.training.objects))},
    )


def policy_of(config: PhysiclearStudy, data_dir: Path, context: Context) -> TrainedEnsemble:
    """The policy of the cache if it was trained on these videos and scenes, else one that is trained now."""
    every = describe_source(data_dir, config.frames, context, config.objects)
    videos, auxiliary = every.labelled(), auxiliary_data(config.scenes, config.scene_sets, every, context)
    path = cached_policy(config, context)
    if path.exists():
        kept = load(path, config.learn, of=path.stem)
        pairs = [(getattr(kept.training, name), getattr(videos, name)) for name in ("objects", "label", "x")]
        pairs += [(getattr(kept.auxiliary, name), value) for name, value in vars(auxiliary).items()]
        pairs.append((np.nan_to_num(kept.training.rating, nan=-1), np.nan_to_num(videos.rating, nan=-1)))
        if all(np.array_equal(a, b) for a, b in pairs):
            return kept
        context.print(f"{path} was trained on other videos or scenes: another policy is trained")
    return train_policy(config, videos, auxiliary, context)


def in_words(log_prob: np.ndarray) -> dict[str, object]:
    """One answer: levels, the probabilities of all levels and of the whole answer [27], and a sentence."""
    level, p = choose(log_prob[None])[0], marginals(log_prob[None])[0]
    whole = float(np.exp(log_prob).reshape(*p.shape[1:] * len(p))[tuple(level)])
    words = [
        f"{a.levels[k][0]} ({p[i, k]:.0%})" for i, (a, k) in enumerate(zip(LANGUAGE.attributes, level, strict=True))
    ]
    sentence = f"{', '.join(words)}; all three {whole:.0%}" + (": unsure, touch it again" if whole < UNSURE else "")
    levels = dict(zip(findings.NAMES, level.tolist(), strict=True))
    return levels | {
        "words": sentence,
        "probabilities": dict(zip(findings.NAMES, p.tolist(), strict=True)),
        "all right": whole,
    }


def validate(config: PhysiclearStudy, data_dir: Path, context: Context) -> Results:
    """Cross-validate, measure contributions and limits, train and keep a policy of all objects."""
    everything = describe_source(data_dir, config.frames, context, config.objects)
    videos = everything.labelled()
    auxiliary = auxiliary_data(config.scenes, config.scene_sets, everything, context)
    fold = lambda seed: deal_folds(videos.objects, videos.label, config.folds, seed)
    split = lambda seed: CrossValidation(
        config=config.learn, videos=videos, auxiliary=auxiliary, fold=fold(seed), seed=seed, context=context
    )
    blind, elsewhere = [split(seed) for seed in config.seeds], split(DEVELOPMENT)
    evidence = np.array([one.probes() for one in blind])
    gather = lambda rows: findings.JudgedAnswers(
        log_prob=np.array(rows), evidence=evidence, label=videos.label, objects=videos.objects
    )
    policy = gather([one.policy(config.learn, "fold") for one in blind])
    pooled = gather([pool(rows, videos.objects) for rows in policy.log_prob])
    spent = training_time(context.timing(), config.seeds[0])
    train_policy(config, videos, auxiliary, context)
    regression = gather([logistic(videos, one.fold) for one in blind])
    together = gather([pool(rows, videos.objects) for rows in regression.log_prob])
    blank = [constants(videos.label, videos.objects, one.fold) for one in blind]
    methods = {
        "policy, one video": policy.levels,
        "policy, all videos of the object": pooled.levels,
        "probes alone, one video": gather(evidence).levels,
        "logistic regression on hand features, one video": regression.levels,
        "logistic regression, all videos of the object": together.levels,
        **{name: np.concatenate([one[name] for one in blank]) for name in blank[0]},
    }
    parts = elsewhere.probe_variants() | (elsewhere.policy_variants() if config.ablations else {})
    score = lambda title, rows, note: score_table(title, rows, videos.label, videos.objects, note)
    measured = {
        ONE: intervals(policy.levels, policy.truth, policy.owner),
        ALL: intervals(pooled.levels, policy.truth, policy.owner),
        SUREST: policy.of_surest(0.5),
    }
    curve, curve_table = findings.sim_to_real(elsewhere)
    gain = findings.gains(policy, regression)
    return Results(
        verdict=verdict(measured, gain["mean"], videos, len(config.seeds)),
        requirements=requirements(measured, gain, spent),
        tables=(
            score_table("Unseen objects", methods, policy.truth, policy.owner, "Mean over the partitions."),
            findings.partition_table(policy, pooled, config.seeds),
            findings.people_table(people(videos), videos),
            curve_table,
            score("What contributes", {name: choose(rows) for name, rows in parts.items()}, _ELSEWHERE),
            score("What limits", elsewhere.label_limits(), _LIMITS),
            findings.object_table(videos, policy, pooled),
        ),
        pictures=(findings.abstention(policy), curve, findings.confusions(policy)),
        settings=settings(config, policy, videos),
        data={
            "objects": len(np.unique(videos.objects)),
            "videos": len(videos.names),
            "objects rated": len(np.unique(videos.objects[np.isfinite(videos.rating).any(1)])),
            "unlabelled videos": len(everything.names) - len(videos.names),
            "unreadable": [f"{skip.name}: {skip.reason}" for skip in everything.skipped],
        },
    )


def settings(config: PhysiclearStudy, policy: findings.JudgedAnswers, videos: DescribedVideos) -> dict[str, object]:
    """Settings that the report names."""
    model = description_policy(config.learn.shape)
    params = jax.eval_shape(lambda key: model.fresh(key, config.learn.inputs), jax.random.key(0))
    size = sum(int(np.prod(x.shape)) for x in jax.tree.leaves(params))
    alike = np.mean([agreement(choose(rows), videos.objects) for rows in policy.log_prob])
    return {
        "folds": config.folds,
        "partitions": len(config.seeds),
        "answers alike, pairs of videos of one object": f"{alike:.0f} %",
        "policy": f"{config.learn.members} members, {size:,} parameters each",
    }


def training_time(timing: Mapping[str, float], seed: int) -> dict[str, float]:
    """Seconds of what one partition needs: scenes, descriptions, training on made-up evidence and all folds."""
    return {stage: s for stage, s in timing.items() if stage.startswith((*CACHED, "reading/", f"fold/{seed}/"))}


def train_policy(
    config: PhysiclearStudy, videos: DescribedVideos, auxiliary: AuxiliaryData, context: Context
) -> TrainedEnsemble:
    """Train on all objects; the policy is kept in the run and, for predictions, in the cache."""
    trained = learn(config.learn, videos, auxiliary, config.seeds[0], context, "policy")
    save(context.directory / POLICY, trained)
    if config.objects is None:
        path = cached_policy(config, context)
        save(path, trained, of=path.stem)
    return trained


def cached_policy(config: PhysiclearStudy, context: Context) -> Path:
    """Where the cache keeps the policy of all objects."""
    return context.cache_dir / f"physiclear-policy-{identity(config.learn)}-{config.seeds[0]}.npz"


def requirements(
    measured: Mapping[str, Mapping[str, Interval]], gain: Mapping[str, Interval], spent: Mapping[str, float]
) -> tuple[Requirement, ...]:
    """Bounds on scores, on the gain over logistic regression and on time; `spent` are the seconds of counted stages."""
    bounds = []
    for what, goals in GOALS.items():
        for name, goal in goals.items():
            one, bound = measured[what][name], at_most if name == "OMAE" else at_least
            note = f"95 % over objects {one.low:.3g} to {one.high:.3g}"
            bounds.append(bound(what + name, one.mean, goal, "levels" if name == "OMAE" else "%", note))
    for name in ("all right", "mean"):
        note = f"gain {gain[name].mean:.1f} points, low end of its 95 % interval over objects"
        bounds.append(at_least(f"gain over logistic regression: {name}", gain[name].low, 0.0, "points", note))
    found = [output for stage, output in CACHED.items() if stage not in spent]
    note = f"found in the cache and not counted: {', '.join(found)}" if found else "nothing was found in the cache"
    return (*bounds, at_most("data and training, one partition", sum(spent.values()) / 60, MINUTES, "min", note))


def verdict(
    measured: Mapping[str, Mapping[str, Interval]], gain: Interval, videos: DescribedVideos, partitions: int
) -> tuple[str, ...]:
    """The scores on unseen objects from one video and from all, and the gain over logistic regression."""
    right = lambda found: (
        f"all three levels are right in {interval(found['all right'], '.1f')} %, single levels in "
        f"{interval(found['mean'], '.1f')} %; OMAE {found['OMAE'].mean:.2f}"
    )
    return (
        f"From one of {len(videos.names)} videos of {len(np.unique(videos.objects))} unseen objects (mean of "
        f"{partitions} partitions): {right(measured[ONE])}.",
        f"From all videos of an object: {right(measured[ALL])}.",
        f"Compared with logistic regression on hand-made features: {interval(gain, '+.1f')} points of single levels.",
    )


DEFAULT = PhysiclearStudy()

SMOKE = dataclasses.replace(
    DEFAULT,
    objects=12,
    frames=2,
    folds=2,
    seeds=(1001, 1002),
    scene_sets=1,
    ablations=False,
    scenes=SceneConfig(objects=6, sites=1, image_px=28, contact_grid=24),
    learn=dataclasses.replace(
        DEFAULT.learn,
        members=1,
        reading=dataclasses.replace(DEFAULT.learn.reading, steps=0),
        tune=dataclasses.replace(DEFAULT.learn.tune, steps=4),
        evidence=dataclasses.replace(DEFAULT.learn.evidence, folds=2),
    ),
)

EXPERIMENT = Experiment(name="physiclear", config=DEFAULT, run=run, scales={"smoke": SMOKE})
