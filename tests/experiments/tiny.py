"""A study small enough for a test: sixteen objects, pictures of 28 px, one decoder layer, no encoder layer."""

import io

import jax
import numpy as np
from rich.console import Console

from experiments.faults.trainings.small_grpo import drawn_features
from experiments.faults.trainings.small_study import MODEL, SCENES
from experiments.study.dataset import Dataset
from experiments.study.stages import StudySFT
from experiments.study.study import StudyConfig
from sensors_io.pipeline import clip_batches
from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.feeds import touch_batch
from touchr1_jax.training.linear_probe import ProbeConfig
from touchr1_jax.training.optimizer import OptimizerConfig
from touchr1_jax.training.train_encoder import EncoderTrainingConfig
from touchr1_jax.training.train_sft import SFTConfig
from touchr1_jax.types import Params, TouchBatch

STUDY = StudyConfig(
    seeds=2,
    scenes=SCENES,
    model=MODEL,
    probe=ProbeConfig(folds=2, iterations=4),
    encoders=EncoderTrainingConfig(steps=2, batch_size=4),
    sft=StudySFT(steps=3, batch_size=4),
    decoder=SFTConfig(steps=2, batch_size=2, questions=2, save_every=1, optimizer=OptimizerConfig(learning_rate=1e-3)),
    grpo=GRPOConfig(prompts=2, group=3, length=20, micro_prompts=2),
    grpo_steps=2,
    samples=0,
)


QUIET = Console(file=io.StringIO())


def one_batch(data: Dataset) -> TouchBatch:
    """The first test contact."""
    rows = data.parts["test"][:1]
    clips = clip_batches(data.store, rows, data.clip, batch_size=1, seed=0, shuffle=False, repeat=False)
    return touch_batch(next(iter(clips)))


def params(policy: TouchPolicy, data: Dataset, *, loud: float = 0.4, seed: int = 0) -> Params:
    """Loud parameters, so that answers depend on the question and on touch."""
    return draw_params(jax.eval_shape(lambda batch: policy.init(0, batch), one_batch(data)), seed, loud=loud)


def features(n: int, seed: int = 0) -> Features:
    """N encoded contacts made up without an encoder, everything present; on the host, as the stages keep them."""
    return drawn_features(np.random.default_rng(seed), n)
