"""An ensemble of policies trained on described videos, its answers, and its file."""

import dataclasses
import hashlib
import io
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jaxtyping import Float, Int

from experiments.core.artifacts import jsonable, write_bytes
from experiments.core.context import Context
from experiments.core.loops import stage_hooks
from experiments.recordings.descriptions import AuxiliaryData, DescribedVideos
from experiments.recordings.level_probes import LevelProbeConfig, ProbedVideos
from sensors_io.arrays import load_arrays
from sensors_io.importers.keep import ImportSourceError
from touchr1_jax.models.description_policy import COMBINATIONS, LEVELS, PolicyShape, description_policy
from touchr1_jax.training.description_tuning import (
    READING,
    Lesson,
    ReinforceConfig,
    TuneConfig,
    evidence_inputs,
    reading_lesson,
    reinforce,
    tune,
)
from touchr1_jax.training.kernel_probe import object_weights, standardise
from touchr1_jax.types import Params

READINGS = 8192  # examples of made-up evidence
ROWS = 64  # numbers of videos are padded to a multiple of it


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """Architecture and training of an ensemble.

    Args:
      evidence: probes whose log-probabilities the encoder reads, and whose most likely levels `perceive` repeats.
      reading, tune, reinforce: training on made-up evidence, then on the answers of real objects, then GRPO.
      components: principal components of the description that the encoder reads too.
      members: policies of different seeds whose log-probabilities are averaged.
    """

    evidence: LevelProbeConfig = LevelProbeConfig()
    components: int = 0
    members: int = 3
    shape: PolicyShape = PolicyShape()
    reading: TuneConfig = READING
    tune: TuneConfig = TuneConfig()
    reinforce: ReinforceConfig = ReinforceConfig()

    @property
    def inputs(self) -> int:
        """Numbers that the encoder reads."""
        return len(self.evidence.families) * COMBINATIONS.shape[1] * LEVELS + self.components


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainedEnsemble:
    """Parameters of the members, stacked, and the data that its probes are fitted on."""

    config: LearnConfig
    params: Params
    training: DescribedVideos
    auxiliary: AuxiliaryData


def learn(
    config: LearnConfig, training: DescribedVideos, auxiliary: AuxiliaryData, seed: int, context: Context, stage: str
) -> TrainedEnsemble:
    """Train every member on labelled videos.

    Args:
      config, training, auxiliary: the ensemble, its labelled videos, scenes and unlabelled videos.
      seed: of members and folds; member m has 1000 · seed + m, but its training on made-up evidence does not depend
        on it.
      context: keeps log, times and checkpoints.
      stage: name of the stage; training on made-up evidence is `reading/…`, GRPO `grpo/…`.
    """
    policy, seeds = description_policy(config.shape), [1000 * seed + m for m in range(config.members)]
    with context.timed(stage):
        read = ProbedVideos(training, auxiliary, training, config.evidence)
        weight = object_weights(training.objects, np.ones(len(training.names), bool))
        components, _ = principal_components(read, config.components)
        lessons = [_lesson(read.crossed(own), components, training.label, weight) for own in seeds]
        readers = [_reader(config, 1000 + m, context) for m in range(config.members)]
    trained = _tuned(config, config.tune, readers, lessons, seeds, context, stage)
    for m, own in enumerate(seeds if config.reinforce.steps else ()):
        with stage_hooks(context, f"grpo/{stage}/{own}", config.reinforce.steps) as hooks:
            trained[m] = reinforce(policy, config.reinforce, trained[m], lessons[m], own, hooks)
    params = jax.tree.map(lambda *x: np.stack(x), *jax.device_get(trained))
    return TrainedEnsemble(config=config, params=params, training=training, auxiliary=auxiliary)


def _reader(config: LearnConfig, seed: int, context: Context) -> Params:
    """A policy that can read evidence and has met no object."""
    shape, families, components = config.shape, len(config.evidence.families), config.components
    policy, lesson = description_policy(shape), reading_lesson(families, components, READINGS, seed)
    params, stage = policy.fresh(jax.random.key(seed), config.inputs), f"reading/{families}-{components}/{seed}"
    return _tuned(config, config.reading, [params], [lesson], [seed], context, stage)[0]


def _tuned(
    config: LearnConfig,
    tuning: TuneConfig,
    members: list[Params],
    lessons: list[Lesson],
    seeds: list[int],
    context: Context,
    stage: str,
) -> list[Params]:
    """The members after a stage of supervised training; 0 steps leave them as they are."""
    if not tuning.steps:
        return members
    with stage_hooks(context, stage, tuning.steps) as hooks:
        return tune(description_policy(config.shape), tuning, members, lessons, seeds, hooks)


def answer_log_probs(trained: TrainedEnsemble, videos: DescribedVideos) -> Float[np.ndarray, "n 27"]:
    """Log-probabilities of every conclusion about videos, known or not; their levels and objects are ignored."""
    config = trained.config
    read = ProbedVideos(trained.training, trained.auxiliary, videos, config.evidence)
    x = np.concatenate([evidence_inputs(read.evidence()), principal_components(read, config.components)[1]], 1)
    padded = jnp.asarray(_padded(x), jnp.float32)
    members = jnp.broadcast_to(padded, (config.members, *padded.shape))
    return jax.device_get(description_policy(config.shape).posterior(trained.params, members))[: len(x)]


def probe_answers(
    config: LearnConfig, training: DescribedVideos, auxiliary: AuxiliaryData, videos: DescribedVideos
) -> Int[np.ndarray, "n A"]:
    """Answers of the probes without a policy: the most likely level of each attribute, families averaged."""
    return ProbedVideos(training, auxiliary, videos, config.evidence).evidence().mean(1).argmax(-1)


def principal_components(read: ProbedVideos, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Principal components of standardised descriptions, of the training videos and of the others."""
    both = np.concatenate([read.fitted, read.others])
    fitted = np.arange(len(both)) < len(read.fitted)
    z = standardise(both, fitted)
    _, _, axes = np.linalg.svd(z[fitted] - z[fitted].mean(0), full_matrices=False)
    scores = standardise(z @ axes[:count].T, fitted)
    return scores[fitted], scores[~fitted]


def _lesson(evidence: np.ndarray, components: np.ndarray, label: np.ndarray, weight: np.ndarray) -> Lesson:
    """Padded by videos of weight 0, so that folds of different sizes share one compiled program."""
    x = np.concatenate([evidence_inputs(evidence), components], 1)
    pad: Any = lambda y, kind: jnp.asarray(_padded(y), kind)
    return Lesson(
        x=pad(x, jnp.float32),
        percept=pad(evidence.mean(1).argmax(-1), jnp.int32),
        label=pad(label, jnp.int32),
        weight=pad(weight, jnp.float32),
    )


def _padded(x: np.ndarray) -> np.ndarray:
    """x with rows of zeros behind it, up to a multiple of `ROWS`."""
    return np.pad(x, [(0, -len(x) % ROWS), *[(0, 0)] * (x.ndim - 1)])


def save(path: Path, trained: TrainedEnsemble) -> None:
    """Publish an ensemble as one file."""
    videos = {name: getattr(trained.training, name) for name in ("names", "objects", "label", "x")}
    parts = {"params": trained.params, "training": videos, "auxiliary": dict(vars(trained.auxiliary))}
    buffer = io.BytesIO()
    np.savez(buffer, identity=identity(trained.config), **traverse_util.flatten_dict(parts, sep="/"))
    write_bytes(path, buffer.getvalue())


def identity(config: LearnConfig) -> str:
    """Hash of the settings of an ensemble."""
    return hashlib.sha256(json.dumps(jsonable(config), sort_keys=True).encode()).hexdigest()[:16]


def load(path: Path, config: LearnConfig) -> TrainedEnsemble:
    """The ensemble that `save` published.

    Raises:
      ImportSourceError: no such file, or a policy of another configuration.
    """
    if not path.is_file():
        raise ImportSourceError(f"policy is {path}: no such file; train one, or name a run's policy.npz")
    arrays = load_arrays(path)
    if str(arrays["identity"]) != identity(config):
        raise ImportSourceError(f"policy is {path}: was trained with another `learn`; give the same, or train anew")
    found = traverse_util.unflatten_dict(arrays, sep="/")
    return TrainedEnsemble(
        config=config,
        params=found["params"],
        training=DescribedVideos(**found["training"]),
        auxiliary=AuxiliaryData(**found["auxiliary"]),
    )
