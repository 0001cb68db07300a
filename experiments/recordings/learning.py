"""An ensemble of policies trained on descriptions of videos, its answers, and its file."""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jaxtyping import Float

from experiments.core.artifacts import jsonable, read_arrays, write_arrays
from experiments.core.context import Context
from experiments.core.loops import stage_hooks
from experiments.recordings.descriptions import ROWS, AuxiliaryData, DescribedVideos
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
from touchr1_jax.training.kernel_probe import object_weights
from touchr1_jax.types import Params

READINGS = 8192  # examples of made-up evidence
BLOCK = 64  # numbers of videos are padded to a multiple of it


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """Architecture and training of an ensemble."""

    evidence: LevelProbeConfig = LevelProbeConfig()
    """Probes whose log-probabilities the encoder reads, and whose most likely levels `perceive` repeats."""
    members: int = 3  # policies of different seeds whose log-probabilities are averaged
    shape: PolicyShape = PolicyShape()
    reading: TuneConfig = READING
    tune: TuneConfig = TuneConfig(steps=0)
    reinforce: ReinforceConfig = ReinforceConfig()
    """Training on made-up evidence, then on the answers of real objects, then GRPO. The last two have no steps by
    default: labels reach the policy through the evidence, and to learn from them again costs.
    """

    @property
    def inputs(self) -> int:
        """Numbers that the encoder reads."""
        return COMBINATIONS.shape[1] * LEVELS


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

    Member m has seed 1000 · seed + m, on which its training on made-up evidence, stage `reading/…`, does not depend.
    """
    policy, seeds = description_policy(config.shape), [1000 * seed + m for m in range(config.members)]
    with context.timed(stage):
        trained = [_reader(config, 1000 + m, context) for m in range(config.members)]
        lessons = list[Lesson]()
        if config.tune.steps or config.reinforce.steps:
            read = ProbedVideos(training, auxiliary, training, config.evidence)
            lessons = [_lesson(config, read, training, own) for own in seeds]
    trained = _tuned(config, config.tune, trained, lessons, seeds, context, stage)
    for m, own in enumerate(seeds if config.reinforce.steps else ()):
        with stage_hooks(context, f"grpo/{stage}/{own}", config.reinforce.steps) as hooks:
            trained[m] = reinforce(policy, config.reinforce, trained[m], lessons[m], own, hooks)
    params = jax.tree.map(lambda *x: np.stack(x), *jax.device_get(trained))
    return TrainedEnsemble(config=config, params=params, training=training, auxiliary=auxiliary)


@functools.lru_cache(maxsize=8)
def _reader(config: LearnConfig, seed: int, context: Context) -> Params:
    """A policy that can read evidence and has met no object."""
    contacts = config.shape.contacts
    policy, lesson = description_policy(config.shape), reading_lesson(contacts, READINGS, seed)
    params, stage = policy.fresh(jax.random.key(seed), config.inputs), f"reading/{contacts}/{seed}"
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


def answer_log_probs(
    trained: TrainedEnsemble, videos: DescribedVideos, asked: Sequence[np.ndarray] | None = None
) -> Float[np.ndarray, "n 27"]:
    """Log-probabilities of every conclusion about objects, known or not; levels of the videos are ignored.

    `asked` are the rows of the videos that each prompt holds; by default a prompt for each video.
    """
    config = trained.config
    p = ProbedVideos(trained.training, trained.auxiliary, videos, config.evidence).evidence()
    rows = [np.array([i]) for i in range(len(p))] if asked is None else asked
    x = jnp.asarray(_padded(evidence_inputs(_prompts(p, rows, config.shape.contacts))), jnp.float32)
    return jax.device_get(description_policy(config.shape).posterior(trained.params, x))[: len(rows)]


def _lesson(config: LearnConfig, read: ProbedVideos, training: DescribedVideos, seed: int) -> Lesson:
    """Prompts about the training objects: each of its videos alone or, if prompts hold several, draws of them.

    Padded by rows of weight 0, so that folds of different sizes share one compiled program.
    """
    evidence, contacts, rng = read.crossed(seed), config.shape.contacts, np.random.default_rng(seed)
    mine = [np.flatnonzero(training.objects == name) for name in training.objects]
    draw = lambda rows: rng.choice(rows, min(len(rows), int(rng.integers(1, contacts + 1))), replace=False)
    rows = [np.array([i]) if contacts == 1 else draw(rows) for i, rows in enumerate(mine)]
    p = _prompts(evidence, rows, contacts)
    pad: Any = lambda y, kind: jnp.asarray(_padded(y), kind)
    return Lesson(
        x=pad(evidence_inputs(p), jnp.float32),
        percept=pad(np.nanmean(p, 1).argmax(-1), jnp.int32),
        target=pad(read.target, jnp.float32),
        weight=pad(object_weights(training.objects, np.ones(len(rows), bool)), jnp.float32),
    )


def _prompts(p: Float[np.ndarray, "n A K"], rows: Sequence[np.ndarray], contacts: int) -> Float[np.ndarray, "m C A K"]:
    """Evidence of the videos of each prompt, the first C of them; NaN where it has fewer."""
    out = np.full((len(rows), contacts, *p.shape[1:]), np.nan)
    for i, mine in enumerate(rows):
        out[i, : len(mine)] = p[mine[:contacts]]
    return out


def _padded(x: np.ndarray) -> np.ndarray:
    """x with rows of zeros behind it, up to a multiple of `BLOCK`."""
    return np.pad(x, [(0, -len(x) % BLOCK), *[(0, 0)] * (x.ndim - 1)])


def save(path: Path, trained: TrainedEnsemble, of: str = "") -> None:
    """Publish an ensemble as one file; `of` as of `write_arrays`."""
    videos = {name: getattr(trained.training, name) for name in ROWS}
    parts = {"params": trained.params, "training": videos, "auxiliary": dict(vars(trained.auxiliary))}
    write_arrays(path, {"identity": identity(trained.config), **traverse_util.flatten_dict(parts, sep="/")}, of=of)


def identity(config: LearnConfig) -> str:
    """Hash of the settings of an ensemble."""
    return hashlib.sha256(json.dumps(jsonable(config), sort_keys=True).encode()).hexdigest()[:16]


def load(path: Path, config: LearnConfig, of: str = "") -> TrainedEnsemble:
    """The ensemble that `save` published, of the same configuration; with `of`, `ArraysError` of another one."""
    if not path.is_file():
        raise ImportSourceError(
            f"policy is {path}: no such file; give the --seeds that it was trained with, train one, or name a run's "
            "policy.npz by --policy"
        )
    arrays = read_arrays(path, of) if of else load_arrays(path)
    if str(arrays["identity"]) != identity(config):
        raise ImportSourceError(f"policy is {path}: was trained with another `learn`; give the same, or train anew")
    found = traverse_util.unflatten_dict(arrays, sep="/")
    return TrainedEnsemble(
        config=config,
        params=found["params"],
        training=DescribedVideos(**found["training"]),
        auxiliary=AuxiliaryData(**found["auxiliary"]),
    )
