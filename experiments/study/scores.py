"""Scores of a study's answers: every policy and every baseline, with intervals over objects."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from experiments.core.results import Estimate
from experiments.study.baselines import baselines
from experiments.study.estimates import estimate
from experiments.study.stages import Weights
from experiments.study.study import SFT, Study
from experiments.study.training import TrainingConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import Answers, Scores, evaluate
from touchr1_jax.rl.config import preset_name
from touchr1_jax.training.evaluation import Evaluation, rewards_of

PUBLISHED: Weights = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
"""The reward of the paper, by which `reward` is reported for every row, whatever an arm was trained on."""

Table = Mapping[str, list[dict[str, Scores]]]
"""Row → seed → metric; a baseline has one seed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scored:
    """Scores of every policy and baseline, and their estimates: SFT and the arms, and all others.

    `objects` is the object of each question, [N].
    """

    rows: Table
    objects: np.ndarray
    arms: Mapping[str, Mapping[str, Estimate]]
    baselines: Mapping[str, Mapping[str, Estimate]]

    @property
    def estimates(self) -> Mapping[str, Mapping[str, Estimate]]:
        """Row → metric of all rows."""
        return {**self.arms, **self.baselines}


def score_study(study: Study) -> Scored:
    """Every metric of every policy's and every baseline's answers about the test contacts."""
    rows = {name: [score(study, said) for said in seeds] for name, seeds in study.answers.items()}
    rows |= {name: [score(study, said)] for name, said in baselines(study).items()}
    objects = study.data.object_ids[study.data.parts["test"]][study.answers[SFT][0].contact]
    estimates = {
        name: {metric: estimate([s[metric] for s in seeds], objects) for metric in seeds[0]}
        for name, seeds in rows.items()
    }
    arms = (SFT, *study.arms)
    return Scored(
        rows=rows,
        objects=objects,
        arms={name: estimates[name] for name in arms},
        baselines={name: row for name, row in estimates.items() if name not in arms},
    )


def score(study: Study, said: Evaluation) -> dict[str, Scores]:
    """Every metric of one policy's answers."""
    reward = rewards_of(study.policy, said, PUBLISHED, study.prior)
    return evaluate(bench_answers(said, reward), ATTRIBUTES, study.policy.levels)


def study_settings(config: TrainingConfig) -> dict[str, str | float]:
    """The preset of the engine, and the factors on the paper's learning rates."""
    return {
        "preset": preset_name(config.grpo),
        "lr_scale": config.grpo.lr_scale,
        "sft_lr_scale": config.sft.optimizer.lr_scale,
    }


def bench_answers(evaluation: Evaluation, reward: np.ndarray) -> Answers:
    """The input of `bench.metrics.evaluate`: answers with the reward of each."""
    return Answers(
        conclude=np.asarray(evaluation.parsed.conclude),
        label=evaluation.label,
        formatted=np.asarray(evaluation.parsed.formatted),
        reward=reward,
        streams=evaluation.streams,
        perceive=np.asarray(evaluation.parsed.perceive),
        alone=evaluation.alone,
    )
