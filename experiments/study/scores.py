"""Scores of a study's answers: every policy and every baseline, with intervals over objects."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.core.results import Estimate, Results
from experiments.study.baselines import baselines
from experiments.study.estimates import estimate_rows
from experiments.study.stages import Weights
from experiments.study.study import SFT, Study
from experiments.study.training import TrainingConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import Answers, Scores, evaluate
from touchr1_jax.rl.config import preset_name
from touchr1_jax.training.evaluation import Evaluation, rewards_of

PUBLISHED: Weights = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
"""The reward of the paper, by which `reward` is reported for every row, whatever an arm was trained on."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scored:
    """Scores of every policy and baseline, and their estimates: SFT and the arms, and all others.

    `rows` maps a row to the scores of its seeds, of which a baseline has one; `objects` is the object of each question.
    """

    rows: Mapping[str, list[dict[str, Scores]]]
    objects: np.ndarray
    arms: Mapping[str, Mapping[str, Estimate]]
    baselines: Mapping[str, Mapping[str, Estimate]]

    @property
    def estimates(self) -> Mapping[str, Mapping[str, Estimate]]:
        """Row → metric of all rows."""
        return {**self.arms, **self.baselines}


def score_study(study: Study) -> Scored:
    """Every metric of every policy's and every baseline's answers about the test contacts."""
    answers = {**study.answers, **{name: [answers] for name, answers in baselines(study).items()}}
    rows = {name: [score(study, one) for one in seeds] for name, seeds in answers.items()}
    objects = study.data.object_ids[study.data.parts["test"]][study.answers[SFT][0].contact]
    estimates = estimate_rows(rows, objects)
    arms = {name: estimates.pop(name) for name in study.policies}
    return Scored(rows=rows, objects=objects, arms=arms, baselines=estimates)


def score(study: Study, answers: Evaluation) -> dict[str, Scores]:
    """Every metric of one policy's answers."""
    read = Answers(
        conclude=np.asarray(answers.parsed.conclude),
        label=answers.label,
        formatted=np.asarray(answers.parsed.formatted),
        reward=rewards_of(study.policy, answers, PUBLISHED, study.prior),
        streams=answers.streams,
        perceive=np.asarray(answers.parsed.perceive),
        alone=answers.alone,
    )
    return evaluate(read, ATTRIBUTES, study.policy.levels)


def study_results(study: Study, scored: Scored, **further: Any) -> Results:
    """Results of a study: its rows, settings and data; `further` fields are added or take the place of these."""
    made = {
        "arms": scored.arms,
        "baselines": scored.baselines,
        "settings": study_settings(study.config),
        "data": study.data.summary(),
    }
    return Results(**(made | further))


def study_settings(config: TrainingConfig) -> dict[str, str | float]:
    """The preset of the engine, and the factors on the paper's learning rates."""
    return {
        "preset": preset_name(config.grpo),
        "lr_scale": config.grpo.lr_scale,
        "sft_lr_scale": config.sft.optimizer.lr_scale,
    }
