"""Scores of a study's answers: every policy and every baseline, with intervals over objects."""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.core.results import Estimate, Results
from experiments.study.dataset import Dataset
from experiments.study.estimates import estimate_rows
from experiments.study.stages import ProbeFeatures, Weights
from experiments.study.study import SFT, Study
from experiments.study.training import TrainingConfig, preset_name
from sensors_io.schema import ATTRIBUTES, LEVELS
from touchr1_jax.bench.metrics import ORDINAL, Answers, Scores, evaluate
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rl.config import AnyAlgorithm
from touchr1_jax.training.evaluation import Evaluation, rewards_of
from touchr1_jax.training.linear_probe import ProbeConfig, probe_log_probs
from touchr1_jax.types import Parsed

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


def baselines(study: Study) -> dict[str, Evaluation]:
    """Answers of every baseline to the questions that the policies were asked."""
    train = study.data.label[study.data.training]
    n = len(study.data.parts["test"])
    constants = {
        "constant": study.prior.argmax(-1),
        "constant_joint": joint_mode(train),
        "constant_middle": np.array([(LEVELS[a] - 1) // 2 for a in ATTRIBUTES]),
    }
    answers = {name: constant_answers(study, np.tile(level, (n, 1))) for name, level in constants.items()}
    if study.data.has_force:
        levels = force_only(study.data, study.probed, study.data.parts["test"], study.config.probe)
        answers["force_only"] = constant_answers(study, levels)
    return answers


def joint_mode(label: np.ndarray) -> np.ndarray:
    """The most frequent combination of ordinal levels in training, with its most frequent material, int [A]."""
    ordinal = [ATTRIBUTES.index(a) for a in ORDINAL]
    known = label[(label[:, ordinal] >= 0).all(1)]
    combinations = itertools.product(*(range(LEVELS[a]) for a in ORDINAL))
    mode = max(combinations, key=lambda c: int((known[:, ordinal] == c).all(1).sum()))
    same = known[(known[:, ordinal] == mode).all(1)]
    material = ATTRIBUTES.index("material")
    out = np.zeros(len(ATTRIBUTES), int)
    out[ordinal] = mode
    out[material] = np.bincount(same[:, material] + 1, minlength=2)[1:].argmax()  # unknown, −1, does not vote
    return out


def constant_answers(study: Study, level: np.ndarray) -> Evaluation:
    """Well-formatted answers that give contact i the levels `level[i]` [contact, A] in every slot."""
    return level_answers(study.policy, study.answers[SFT][0], level)


def level_answers(
    policy: TouchPolicy, asked: Evaluation, level: np.ndarray, alone: np.ndarray | None = None
) -> Evaluation:
    """Well-formatted answers with given levels to the questions that a policy was asked.

    Args:
      policy: of the study.
      asked: answers of any policy; its questions and labels are taken.
      level: int [contact, A], the levels in `compare` and `conclude`.
      alone: int [contact, S, A], those in `perceive` and by each sensor alone; `level` where it is `None`.
    """
    wanted = policy.layout.asked[asked.attribute]
    concluded = np.where(wanted, level[asked.contact], -1).astype(np.int32)
    n, sensors = asked.streams.shape
    single = np.repeat(level[:, None], sensors, 1) if alone is None else alone
    single = np.where(wanted[:, None], single[asked.contact], -1).astype(np.int32)
    perceive = np.where(asked.streams[:, :, None], single, -1)
    return Evaluation(
        contact=asked.contact,
        attribute=asked.attribute,
        streams=asked.streams,
        tokens=np.zeros((n, 0), np.int32),
        parsed=Parsed(
            perceive=jnp.asarray(perceive),
            compare=jnp.asarray(concluded),
            conclude=jnp.asarray(concluded),
            formatted=jnp.ones(n, bool),
            truncated=jnp.zeros(n, bool),
            length=jnp.zeros(n, jnp.int32),
        ),
        label=asked.label,
        alone=single if sensors > 1 else None,
        truth=asked.truth,
    )


def force_only(data: Dataset, probed: ProbeFeatures, rows: np.ndarray, config: ProbeConfig) -> np.ndarray:
    """Levels of contacts by a probe on the measured forces alone, int [len(rows), A]: what the force ramp reveals."""
    train = np.isin(np.arange(len(data.store)), data.training)
    columns = []
    for a, name in enumerate(ATTRIBUTES):
        weight = (train & (data.label[:, a] >= 0))[None]
        if not weight.any():  # not annotated, so no question asks for it
            columns.append(np.zeros(len(rows), int))
            continue
        log_prob = probe_log_probs(probed.force, data.label[:, a], weight, LEVELS[name], config)
        columns.append(log_prob[0, rows].argmax(-1))
    return np.stack(columns, 1)


def score_study(study: Study) -> Scored:
    """Every metric of every policy's and every baseline's answers about the test contacts.

    One about a single object is left out: no interval over objects is defined.
    """
    answers = {**study.answers, **{name: [answers] for name, answers in baselines(study).items()}}
    objects = study.data.object_ids[study.data.parts["test"]][study.answers[SFT][0].contact]
    of_several = lambda scores: {m: s for m, s in scores.items() if len({*objects[s.items]}) > 1}
    rows = {name: [of_several(score(study, one)) for one in seeds] for name, seeds in answers.items()}
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


def trained_preset(config: TrainingConfig, algorithm: AnyAlgorithm) -> str:
    """Name of the preset by which an arm of an algorithm trains, with the anchor under recipe `touch`."""
    return preset_name(dataclasses.replace(config.grpo, algorithm=config.algorithm(algorithm)))


def study_settings(config: TrainingConfig) -> dict[str, str | float]:
    """The recipe of training, the preset of the engine, and the factors on the paper's learning rates."""
    return {
        "recipe": config.recipe,
        "preset": trained_preset(config, config.grpo.algorithm),
        "lr_scale": config.grpo.lr_scale,
        "sft_lr_scale": config.sft.optimizer.lr_scale,
    }
