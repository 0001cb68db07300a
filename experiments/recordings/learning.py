"""From described videos to a trained policy, and from a trained policy to answers."""

import dataclasses
import functools
import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jaxtyping import Float, Int

from experiments.core.artifacts import jsonable, write_bytes
from experiments.core.context import Context
from experiments.recordings.descriptions import Described
from experiments.recordings.evidence import EvidenceConfig, cross_probe, probe, standardise
from experiments.recordings.policy import COMBINATIONS, LEVELS, PolicyShape, assemble_policy, choose, utility
from experiments.recordings.scenes import Scenes, sense
from experiments.recordings.training import (
    READING,
    Lesson,
    ReinforceConfig,
    TuneConfig,
    evidence_inputs,
    reading_lesson,
    reinforce,
    tune,
)
from experiments.recordings.validation import object_weights
from sensors_io.importers.keep import ImportSourceError
from touchr1_jax.types import Params

READINGS = 8192
"""Examples of made-up evidence."""

ROWS = 64
"""Numbers of videos are padded to a multiple of it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """Architecture and training of a policy.

    Args:
      evidence: probes whose log-probabilities the encoder reads, and whose verdict `perceive` repeats.
      read_evidence: whether the encoder reads them.
      reading, tune, reinforce: first to read made-up evidence, then the answers of real objects, then GRPO.
      components: principal components of the description that it reads beside them.
      members: policies of different seeds whose log-probabilities are averaged.
    """

    evidence: EvidenceConfig = EvidenceConfig()
    read_evidence: bool = True
    components: int = 0
    members: int = 3
    shape: PolicyShape = PolicyShape()
    reading: TuneConfig = READING
    tune: TuneConfig = TuneConfig()
    reinforce: ReinforceConfig = ReinforceConfig()

    def __post_init__(self) -> None:
        if not self.read_evidence and not self.components:
            raise ValueError("components is 0 and read_evidence False: the encoder must read something; raise one")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Background:
    """Data without labels of real objects: scenes, and descriptions of unlabelled videos [m, D]."""

    scenes: Scenes
    unlabelled: Float[np.ndarray, "m D"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Learned:
    """A trained policy: parameters of its members, and what its probes remember."""

    config: LearnConfig
    params: Params
    memory: Described
    background: Background


@dataclasses.dataclass(frozen=True, kw_only=True)
class Said:
    """Answers about n videos: what was perceived, log-probabilities of the 27 conclusions, and the one chosen."""

    percept: Int[np.ndarray, "n A"]
    log_prob: Float[np.ndarray, "n 27"]

    @property
    def conclude(self) -> Int[np.ndarray, "n A"]:
        """The levels that are expected to score most."""
        return choose(self.log_prob, utility())


def learn(
    config: LearnConfig, training: Described, background: Background, seed: int, context: Context
) -> tuple[Learned, dict[str, np.ndarray]]:
    """Train every member on labelled videos.

    Args:
      config: the policy.
      training: videos, all of known levels.
      background: what else is known.
      seed: of members and folds; member m has 1000 · seed + m, but what it reads with is the same for all seeds.
      context: shows how far it is.

    Returns:
      The policy, and its loss and rewards by step, [members, steps].
    """
    policy = assemble_policy(config.shape)
    everywhere = np.ones(len(training.names), bool)
    weight = object_weights(training.objects, everywhere)
    felt = _Felt(training, background, training, config)
    families = len(config.evidence.families) if config.read_evidence else 0
    trained, losses, rewards = [], [], []
    for member in context.each("members", range(config.members)):
        own = 1000 * seed + member
        x, percept = felt.inputs(own)
        params = _reader(config.shape, config.reading, families, config.components, 1000 + member)
        lesson = _lesson(x, percept, training.label, weight)
        params, loss = tune(policy, config.tune, params, lesson, own)
        params, log = reinforce(policy, config.reinforce, params, lesson, own)
        trained.append(params)
        losses.append(loss)
        rewards.append([row["reward"] for row in log])
    params = jax.tree.map(lambda *x: np.stack(x), *jax.device_get(trained))
    return Learned(config=config, params=params, memory=training, background=background), {
        "loss": np.array(losses),
        "reward": np.array(rewards),
    }


@functools.cache
def _reader(shape: PolicyShape, reading: TuneConfig, families: int, components: int, seed: int) -> Params:
    """A policy that can read the evidence of so many families and has met no object; made once for all folds."""
    policy = assemble_policy(shape)
    params = policy.init(jax.random.key(seed), families * COMBINATIONS.shape[1] * LEVELS + components)
    if not families:
        return params
    return tune(policy, reading, params, reading_lesson(families, components, READINGS, seed), seed)[0]


def say(learned: Learned, videos: Described) -> Said:
    """Ask a trained policy about videos, known or not; their levels and objects are not looked at."""
    policy = assemble_policy(learned.config.shape)
    x, _ = _Felt(learned.memory, learned.background, videos, learned.config).inputs(None)
    padded = jnp.asarray(_padded(x), jnp.float32)
    members = jnp.broadcast_to(padded, (learned.config.members, *padded.shape))
    percept, log_prob = jax.device_get(policy.posterior(learned.params, members))
    return Said(percept=COMBINATIONS[percept[: len(x)]], log_prob=log_prob[: len(x)])


def evidence_alone(
    config: LearnConfig, training: Described, background: Background, videos: Described
) -> Int[np.ndarray, "n A"]:
    """Answers of the probes without a policy: the most likely level of each attribute, families averaged."""
    return _Felt(training, background, videos, config).evidence.mean(1).argmax(-1)


class _Felt:
    """Training videos and others as their probes and encoders read them.

    Args:
      training: videos to learn from.
      background: what else is known.
      videos: videos to read; those of the training themselves, to learn.
      config: of the policy.
    """

    def __init__(self, training: Described, background: Background, videos: Described, config: LearnConfig) -> None:
        world = np.concatenate([training.x, background.unlabelled])
        widen = lambda x: np.concatenate([x, sense(background.scenes, world, x, config.evidence)], 1)
        self._config, self._training = config, training
        self._x, self._other = widen(training.x).astype(np.float64), widen(videos.x).astype(np.float64)
        senses = self._x.shape[1] - training.x.shape[1]
        self._family = np.array([*training.family, *["scenes"] * senses])
        self._weight = object_weights(training.objects, np.ones(len(training.names), bool))

    @functools.cached_property
    def evidence(self) -> Float[np.ndarray, "n M A K"]:
        """Predictions for other videos by probes that were fitted on all training videos."""
        n = len(self._x)
        label = np.zeros((n + len(self._other), self._training.label.shape[1]), np.int32)
        label[:n] = self._training.label
        weight = np.concatenate([self._weight, np.zeros(len(self._other))])
        x = np.concatenate([self._x, self._other])
        return probe(x, label, weight, self._family, self._config.evidence)[n:]

    def crossed(self, seed: int) -> Float[np.ndarray, "n M A K"]:
        """Predictions for the training videos by probes that were fitted without the object in question."""
        t = self._training
        return cross_probe(self._x, t.label, self._weight, t.objects, self._family, self._config.evidence, seed)

    def inputs(self, seed: int | None) -> tuple[Float[np.ndarray, "n D"], Int[np.ndarray, "n A"]]:
        """Input of the encoder, and the probes' probabilities.

        With a seed, of the training videos by out-of-fold evidence, else of the others.
        """
        said = self.evidence if seed is None else self.crossed(seed)
        fitted, others = _components(self._x, self._other, self._config.components, self._config.evidence.clip)
        read = evidence_inputs(said) if self._config.read_evidence else np.zeros((len(said), 0))
        return np.concatenate([read, others if seed is None else fitted], 1), said.mean(1).argmax(-1)


def _components(training: np.ndarray, videos: np.ndarray, count: int, clip: float) -> tuple[np.ndarray, np.ndarray]:
    """Principal components of standardised descriptions, of the training videos and of others."""
    both = np.concatenate([training, videos]).astype(np.float64)
    fitted = np.arange(len(both)) < len(training)
    z = standardise(both, fitted, clip)
    _, _, axes = np.linalg.svd(z[fitted] - z[fitted].mean(0), full_matrices=False)
    scores = standardise(z @ axes[:count].T, fitted, clip)
    return scores[fitted], scores[~fitted]


def _lesson(x: np.ndarray, percept: np.ndarray, label: np.ndarray, weight: np.ndarray) -> Lesson:
    """Padded by videos of weight 0, so that folds of different sizes share one compiled program."""
    pad = lambda y, kind: jnp.asarray(_padded(np.asarray(y)), kind)
    return Lesson(
        x=pad(x, jnp.float32),
        percept=pad(percept, jnp.int32),
        label=pad(label, jnp.int32),
        weight=pad(weight, jnp.float32),
    )


def _padded(x: np.ndarray) -> np.ndarray:
    """x with rows of zeros behind it, up to a multiple of `ROWS`."""
    return np.pad(x, [(0, -len(x) % ROWS), *[(0, 0)] * (x.ndim - 1)])


def save(path: Path, learned: Learned) -> None:
    """Publish a policy as one file."""
    flat: Mapping[str, Any] = traverse_util.flatten_dict(learned.params, sep="/")
    memory = {name: getattr(learned.memory, name) for name in _MEMORY}
    memory |= {"unlabelled": learned.background.unlabelled}
    memory |= {"scenes_x": learned.background.scenes.x, "scenes_target": learned.background.scenes.target}
    buffer = io.BytesIO()
    np.savez(
        buffer,
        identity=identity(learned.config),
        **{f"params/{k}": v for k, v in flat.items()},
        **{f"memory/{k}": v for k, v in memory.items()},
    )
    write_bytes(path, buffer.getvalue())


def identity(config: LearnConfig) -> str:
    """Hash of what a policy is made of and how it is trained."""
    return hashlib.sha256(json.dumps(jsonable(config), sort_keys=True).encode()).hexdigest()[:16]


def load(path: Path, config: LearnConfig) -> Learned:
    """The policy that `save` published.

    Raises:
      ImportSourceError: no such file, or a policy of another configuration.
    """
    if not path.is_file():
        raise ImportSourceError(f"policy is {path}: no such file; train one, or name a run's policy.npz")
    with np.load(path) as file:
        if str(file["identity"]) != identity(config):
            raise ImportSourceError(f"policy is {path}: was trained with another `learn`; give the same, or train anew")
        part = lambda head: {k.removeprefix(head): file[k] for k in file.files if k.startswith(head)}
        params, memory = traverse_util.unflatten_dict(part("params/"), sep="/"), part("memory/")
    scenes = Scenes(x=memory["scenes_x"], target=memory["scenes_target"])
    return Learned(
        config=config,
        params=params,
        memory=Described(**{name: memory[name] for name in _MEMORY}, skipped=()),
        background=Background(scenes=scenes, unlabelled=memory["unlabelled"]),
    )


_MEMORY = ("names", "objects", "label", "x")
