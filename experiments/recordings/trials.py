"""Cross-validation of policies, and what their parts contribute."""

import dataclasses

import numpy as np

from experiments.core.context import Context
from experiments.recordings.descriptions import Described
from experiments.recordings.descriptors import families
from experiments.recordings.learning import Background, LearnConfig, learn, say
from experiments.recordings.limits import cross_answers
from experiments.recordings.scenes import Scenes
from experiments.recordings.training import ReinforceConfig, TuneConfig
from experiments.recordings.validation import Row


def cross_validate(
    config: LearnConfig,
    videos: Described,
    background: Background,
    fold: np.ndarray,
    seed: int,
    context: Context,
    stage: str,
) -> np.ndarray:
    """Answers about every video by a policy that never met its object, int [n, A]; finished folds are not repeated."""
    answer = np.zeros_like(videos.label)
    with context.progress(stage, int(fold.max()) + 1) as advance:
        for k in np.unique(fold):
            held, name = np.flatnonzero(fold == k), f"{stage}/{k}"
            if not context.done(name):
                with context.timed(name):
                    learned, course = learn(config, videos.rows(np.flatnonzero(fold != k)), background, seed, context)
                for step, loss in enumerate(course["loss"].mean(0)):
                    context.log(name, step, loss=float(loss))
                context.save_stage(name, say(learned, videos.rows(held)).conclude.tolist())
            answer[held] = context.load_stage(name)
            advance()
    return answer


def ablate(
    config: LearnConfig,
    videos: Described,
    background: Background,
    fold: np.ndarray,
    seed: int,
    context: Context,
) -> list[Row]:
    """Answers of the policy and of variants of it."""
    rows = []
    for name, learning in policies(config).items():
        stage = "ablation/" + name.replace(" ", "-").replace(",", "")
        rows.append(Row(name=name, answer=cross_validate(learning, videos, background, fold, seed, context, stage)))
    return rows


def ablate_probes(
    config: LearnConfig, videos: Described, background: Background, fold: np.ndarray, context: Context
) -> list[Row]:
    """Answers of the probes alone and of variants of them."""
    return [
        Row(name=name, answer=cross_answers(learning, videos, known, fold, context))
        for name, (learning, known) in context.each("variants of the probes", probes(config, background).items())
    ]


def policies(config: LearnConfig) -> dict[str, LearnConfig]:
    """Name → policy with something left out or added."""
    single = dataclasses.replace(config, members=1)
    untaught = untuned(config.reading)
    from_scratch = dataclasses.replace(
        config.tune, steps=100, optimizer=dataclasses.replace(config.tune.optimizer, lr_scale=300.0)
    )
    return {
        "one member": single,
        "one member, not tuned on labels": dataclasses.replace(single, tune=untuned(config.tune)),
        "one member, on labels from scratch": dataclasses.replace(single, reading=untaught, tune=from_scratch),
        "one member, components beside the evidence": dataclasses.replace(single, components=12),
        "one member, then GRPO": dataclasses.replace(single, reinforce=ReinforceConfig(steps=40)),
    }


def untuned(config: TuneConfig) -> TuneConfig:
    """The same without a step."""
    return dataclasses.replace(config, steps=0)


def probes(config: LearnConfig, background: Background) -> dict[str, tuple[LearnConfig, Background]]:
    """Name → probes alone, with something left out or added."""
    bare = dataclasses.replace(background, unlabelled=background.unlabelled[:0])
    reading = lambda *names: dataclasses.replace(config, evidence=dataclasses.replace(config.evidence, families=names))
    own = tuple(dict.fromkeys(families()))
    harder = dataclasses.replace(
        config, evidence=dataclasses.replace(config.evidence, scene_ridge=config.evidence.ridge)
    )
    tenth = dataclasses.replace(
        background, scenes=Scenes(x=background.scenes.x[::10], target=background.scenes.target[::10])
    )
    return {
        "probe of what scenes teach": (config, background),
        "the same, a tenth of the scenes": (config, tenth),
        "the same, no unlabelled videos": (config, bare),
        "the same, scenes' ridge as the others'": (harder, background),
        "probes of the description, no scenes": (reading(*own), background),
        "probes of the description and of what scenes teach": (reading(*own, "scenes"), background),
        **{f"probe of {name} alone, no scenes": (reading(name), background) for name in own},
    }
