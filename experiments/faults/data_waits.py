"""Share of training time that waits for data, at the sizes of the studies."""

import dataclasses
from collections.abc import Mapping

from experiments.core.context import Context
from experiments.core.loops import STEPPING, WAITING
from experiments.encoder.pretrain import PretrainConfig, pretrain
from experiments.study.scores import PUBLISHED
from experiments.study.stages import (
    EncodedContacts,
    encode_rows,
    gather_evidence,
    make_arm,
    noise_bank,
    probe_features,
    run_grpo,
    run_sft,
)
from experiments.study.study import StudyConfig, open_study_data
from sensors_io.scenes.config import SceneConfig
from touchr1_jax.models.touch_policy import build_policy
from touchr1_jax.training.loop import LoopConfig

STAGES = ("sft/0", "grpo/published/0", "blind/0", "dynamics/0")


BLIND = 4
"""Steps without touch for each with it: they take a quarter of the time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WaitingConfig:
    """Steps of each stage, of which the first is not timed, and the objects that they are about."""

    steps: int = 16
    study: StudyConfig = StudyConfig(scenes=SceneConfig(objects=60, sites=1))
    dynamics: PretrainConfig = PretrainConfig()


Waits = Mapping[str, tuple[float, float]]
"""Stage → seconds in steps, and those of them that waited for data."""


def waits(config: WaitingConfig, context: Context) -> Waits:
    """Train each stage for some steps from where it is; a stage that is done is not timed again."""
    study, loop = config.study, LoopConfig(steps=config.steps, save_every=config.steps)
    data = open_study_data(study, context)
    policy = build_policy(study.model, data.clip.sensors)
    evidence = gather_evidence(data, probe_features(data, context), study.probe, context)
    sft = dataclasses.replace(study.sft, steps=config.steps, save_every=config.steps)
    params = run_sft(policy, data, evidence, sft, context, seed=0, stage=STAGES[0])
    features = encode_rows(policy, params, data, data.parts["grpo"], context)
    noise = noise_bank(policy, params, data, seed=0)
    label = data.label[data.parts["grpo"]]
    contacts = EncodedContacts(features=features, label=label, truth=label, noise=noise)
    arm = make_arm(policy, PUBLISHED, data.prior(), study.grpo, loop)
    run_grpo(policy, arm, contacts, params, context, seed=0, stage=STAGES[1])
    blind = dataclasses.replace(study.blind, steps=BLIND * config.steps, save_every=BLIND * config.steps)
    run_sft(policy, data, evidence, blind, context, seed=0, stage=STAGES[2], blind=True)
    dynamics = dataclasses.replace(config.dynamics, steps=config.steps, probe_every=config.steps)
    pretrain(dynamics, data.store, data.parts["sft"], data.clip, context, stage=STAGES[3], seed=0)
    times = context.timing()
    return {stage: (times[f"{STEPPING}/{stage}"], times[f"{WAITING}/{stage}"]) for stage in STAGES}
