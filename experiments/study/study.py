"""A study: several arms of GRPO from one SFT checkpoint per seed, on the same data in the same order.

The answers of a finished policy are kept in `answers/NAME-SEED.npz` of the run, so a resumed run repeats no evaluation,
and the policy itself in `policies/NAME/SEED`, so that it can be asked about new data (`python -m experiments ask`).
"""

import contextlib
import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from experiments.core import numerics, runs
from experiments.core.artifacts import write_json
from experiments.core.concurrency import concurrently, idle_cores
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError, DataError
from experiments.study.cache import NEVER, fingerprint, source_digest
from experiments.study.dataset import Dataset
from experiments.study.seed import BLIND, CONTINUED, SFT, EvalVariant, SeedTraining
from experiments.study.stages import (
    GRPOArm,
    ProbeFeatures,
    Weights,
    gather_evidence,
    make_arm,
    probe_features,
)
from experiments.study.training import (
    DECODER,
    TrainingConfig,
    algorithm_name,
    open_data,
    require_derived,
    require_encoder,
    starting_model,
)
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from sensors_io.units import WorkUnit, finish
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig, TouchPolicy, build_policy, check_model, with_lora
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.rewards import AnyReward, RewardError, make_rewards, uniform_prior
from touchr1_jax.rl.config import AnyAlgorithm, GRPOConfig, Paper
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.training.compilation import compilations_kept, compiled_quickly
from touchr1_jax.training.evaluation import Evaluation
from touchr1_jax.training.rollout_server import RolloutServer
from touchr1_jax.training.train_encoder import EncoderTrainingConfig
from touchr1_jax.training.train_grpo import check_rewards
from touchr1_jax.types import Params

MODEL = ModelConfig(
    tactile=TactileViTConfig(sensors=0, num_layers=1, stem="statistics", stem_width=64),
    vision=VisionConfig(stem="statistics", num_layers=0),
)
"""The default policy; its tactile stem has no parameters before its first layer, so that it is computed once."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyConfig(TrainingConfig):
    """All settings of a study whose towers start from fresh parameters."""

    model: ModelConfig = MODEL
    encoders: EncoderTrainingConfig = EncoderTrainingConfig(steps=500)
    """Half of the default: comparisons of rewards start from one policy, and need not start from the best."""
    share: bool = True
    """Take policies from the cache where an experiment with the same data, settings and code trained them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_derived("decoder.vocab_size", self.model.decoder.vocab_size)


SMOKE = StudyConfig(
    model=dataclasses.replace(MODEL, decoder=dataclasses.replace(MODEL.decoder, num_layers=1)),  # most of it compiles
    seeds=2,
    scenes=SceneConfig(objects=60, sites=1),
    encoders=EncoderTrainingConfig(steps=12, batch_size=8),
    decoder=dataclasses.replace(DECODER, steps=6, batch_size=4, save_every=3),
    grpo=GRPOConfig(prompts=4, micro_prompts=2),
    grpo_steps=4,
)
"""A study that takes under two minutes and learns nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study:
    """The result of a study; `answers[name][seed]` are a policy's answers, `variants[…]` those of an `EvalVariant`."""

    config: TrainingConfig
    data: Dataset
    policy: TouchPolicy
    probed: ProbeFeatures
    prior: np.ndarray
    arms: Mapping[str, Weights]
    answers: Mapping[str, Sequence[Evaluation]]
    variants: Mapping[str, Sequence[Evaluation]] = dataclasses.field(default_factory=dict)

    @property
    def policies(self) -> tuple[str, ...]:
        """SFT, its control, and the arms."""
        return (SFT, CONTINUED, *self.arms)


def run_study(
    config: StudyConfig,
    arms: Mapping[str, Weights],
    context: Context,
    algorithms: Mapping[str, AnyAlgorithm] = {},
    variants: Mapping[str, EvalVariant] = {},
) -> Study:
    """Make the data, train every arm of every seed, evaluate every policy.

    Args:
      config: sizes, data, algorithm.
      arms: reward weights of each arm.
      context: the run.
      algorithms: those of the arms that do not use the configured one.
      variants: further evaluations of SFT, the control and the arms, by the names of their answers.

    Raises:
      ConfigurationError: an algorithm that no arm uses, or as `require_encoder`.
      ValueError, RewardError, SizeError, EncoderError: as `check_arms`, `check_model` and `require_encoder`.
    """
    if arms.keys() <= algorithms.keys() and config.grpo.algorithm != Paper():
        given = algorithm_name(config.grpo.algorithm)
        raise ConfigurationError(f"grpo.algorithm is {given}: no arm trains by it, for each has its own; leave it out")
    check_arms({arm: {**weights, **config.more_rewards} for arm, weights in arms.items()}, variants)
    check_model(config.model, SENSORS)
    require_encoder(config.encoder, context)
    data, policy, tactile = _opened(config, context, min(idle_cores(context), config.seeds))
    if not context.launcher.here:
        order = tuple((name, seed) for name in (SFT, BLIND, CONTINUED, *arms) for seed in range(config.seeds))
        parts = [StudyPart(name=name, seed=seed, first=name in (SFT, BLIND)) for name, seed in order]
        values = {
            "records": [data.store.digest, data.digest()],
            "config": config,
            "arms": arms,
            "algorithms": algorithms,
        }
        train_parts(functools.partial(train_part, config, arms, algorithms), parts, values, config.share, context)
    return train_study(config, data, policy, arms, context, algorithms, variants, tactile=tactile, share=config.share)


PARTS, PROGRAMS = "units", "compiled"
"""Folders of the cache: of the units, each with its checkpoints until it is done, and of compiled programs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyPart:
    """One policy of one seed; those that are `first` are what the others start from."""

    name: str
    seed: int
    first: bool


Train = Callable[[StudyPart, Context], None]


def train_parts(
    train: Train, parts: Sequence[StudyPart], values: Mapping[str, Any], share: bool, context: Context
) -> None:
    """Have workers train the policies of a study that are not in the cache yet; they depend on `values` alone.

    `DataError` if the study takes none from the cache; `LauncherError` and `UnitsError` as of `units.finish`.
    """
    if not share:
        raise DataError("share is False: workers hand policies over by the cache; leave --launcher out, or set --share")
    listed = {part: _unit(train, part, values, context.cache_dir.absolute()) for part in parts}
    for first in (True, False):
        units = [unit for part, unit in listed.items() if part.first == first]
        for done, unit in enumerate(finish(units, context.launcher, context.print), 1):
            context.print(f"{done} of {len(units)} policies {'to start from ' if first else ''}trained: {unit.name}")


def _unit(train: Train, part: StudyPart, values: Mapping[str, Any], cache_dir: Path) -> WorkUnit:
    digest = fingerprint({**values, "part": part}, {}, source_digest(NEVER))
    folder, machine = cache_dir / PARTS / digest, {**numerics.machine(), **numerics.settings()}
    quick = bool(jax.config.values["jax_disable_most_optimizations"])
    run = functools.partial(_work, train, part, cache_dir, folder, machine, quick)
    return WorkUnit(name=f"{part.name}/{part.seed} {digest}", run=run, done=_result(folder).exists)


def _result(folder: Path) -> Path:
    return folder.with_suffix(".json")


def _work(
    train: Train, part: StudyPart, cache_dir: Path, folder: Path, machine: Mapping[str, Any], quick: bool
) -> None:
    """Train one policy, in a worker; one that was killed goes on from its checkpoints."""
    if "cores" in machine and not os.environ.get("NPROC"):  # read when JAX begins: as many parts of sums as there
        os.environ["NPROC"] = machine["cores"]
    with compiled_quickly() if quick else contextlib.nullcontext(), compilations_kept(cache_dir / PROGRAMS):
        if changes := numerics.changed(machine, {**numerics.machine(), **numerics.settings()}):
            raise DataError(
                f"this worker computes other bits than the driver ({', '.join(changes)}): the study would not take its "
                "policies; use workers of the driver's kind, or for cores alone set NPROC to one number for all of them"
            )
        logging.getLogger("orbax").setLevel(logging.ERROR)
        folder.mkdir(parents=True, exist_ok=True)
        with runs.locked(folder), contextlib.closing(Context(folder, cache_dir, Console(quiet=True))) as context:
            train(part, context)
            write_json(_result(folder), dataclasses.asdict(part))


def train_part(
    config: StudyConfig,
    arms: Mapping[str, Weights],
    algorithms: Mapping[str, AnyAlgorithm],
    part: StudyPart,
    context: Context,
) -> None:
    """Train one policy of one seed into the cache, where `run_study` finds it; other arguments as there."""
    data, policy, tactile = _opened(config, context)
    arms = {name: weights for name, weights in arms.items() if name == part.name}
    shared = _shared(config, data, policy, arms, algorithms, probe_features(data, context), context)
    SeedTraining(**shared, tactile=tactile, share=True, variants={}, seed=part.seed).train(part.name)


def _opened(config: StudyConfig, context: Context, at_once: int = 1) -> tuple[Dataset, TouchPolicy, Params | None]:
    """Data, the untrained policy, and parameters of the tactile encoder that SFT starts from."""
    data = open_study_data(config, context, at_once)
    model, tactile = starting_model(config.model, config.encoder, data.clip.sensors)
    return data, with_lora(build_policy(model, data.clip.sensors), config.lora), tactile


def _shared(
    config: TrainingConfig,
    data: Dataset,
    policy: TouchPolicy,
    arms: Mapping[str, Weights],
    algorithms: Mapping[str, AnyAlgorithm],
    probed: ProbeFeatures,
    context: Context,
) -> dict[str, Any]:
    """Fields of all seeds."""
    of = lambda arm: algorithms.get(arm, config.grpo.algorithm)
    return {
        "config": config,
        "data": data,
        "policy": policy,
        "evidence": gather_evidence(data, probed, config.probe, context),
        "context": context,
        "arms": {a: make_study_arm(config, policy, weights, data.prior(), of(a)) for a, weights in arms.items()},
    }


def check_arms(
    arms: Mapping[str, Weights],
    variants: Mapping[str, EvalVariant] = {},
    rewards: Mapping[str, AnyReward] | None = None,
) -> None:
    """Try every weighted reward of every arm, so that a misfit is reported before anything is made.

    `RewardError` names the arm; `ValueError` for a variant of a policy that is not there, or with the name of one.
    """
    known = rewards or make_rewards(uniform_prior([len(a.levels) for a in TOUCH_LANGUAGE.attributes]))
    for arm, weights in arms.items():
        try:
            check_rewards(known, weights, TOUCH_LANGUAGE)
        except RewardError as error:
            raise RewardError(f"{error} (in the weights of arm {arm!r}, {dict(weights)})") from error
    policies = (SFT, CONTINUED, *arms)
    for name, variant in variants.items():
        if variant.of not in policies:
            raise ValueError(f"variant {name!r} is of {variant.of!r}: must be one of {', '.join(policies)}; correct it")
        if name in (BLIND, *policies):
            raise ValueError(f"variant {name!r} has the name of a policy, whose answers it would replace; rename it")


def open_study_data(config: StudyConfig, context: Context, at_once: int = 1) -> Dataset:
    """Records of the configured source, with clips of the model's size; `at_once` as in `open_data`."""
    return open_data(config, config.model.vision.image_px, context, at_once)


def train_study(
    config: TrainingConfig,
    data: Dataset,
    policy: TouchPolicy,
    arms: Mapping[str, Weights],
    context: Context,
    algorithms: Mapping[str, AnyAlgorithm] = {},
    variants: Mapping[str, EvalVariant] = {},
    *,
    tactile: Params | None = None,
    share: bool = False,
    rollouts: RolloutServer | None = None,
) -> Study:
    """Train every arm of every seed and evaluate every policy, with data and policy at hand; see `run_study`.

    `tactile` are parameters of the tactile encoder that SFT starts from; with `share` policies come from the cache.
    `rollouts` is a server that draws the rollouts of GRPO; by default its steps do.
    """
    probed = probe_features(data, context)
    study = _shared(config, data, policy, arms, algorithms, probed, context)
    made: Mapping[str, GRPOArm] = study["arms"]
    answers: dict[str, list[Evaluation]] = {name: [] for name in (SFT, CONTINUED, *arms, BLIND, *variants)}
    study |= {"share": share, "tactile": tactile, "variants": variants, "rollouts": rollouts}
    train = lambda seed: SeedTraining(**study, seed=seed).answers()
    at_once = 1 if policy.frozen else None  # of released weights one copy must do
    for found in concurrently(context, "seeds", range(config.seeds), train, at_once=at_once):
        for name, evaluation in found.items():
            answers[name].append(evaluation)
    further = {name: answers.pop(name) for name in variants}
    return Study(
        config=config,
        data=data,
        policy=policy,
        probed=probed,
        prior=data.prior(),
        arms={name: arm.weights for name, arm in made.items()},
        answers=answers,
        variants=further,
    )


def make_study_arm(
    config: TrainingConfig, policy: TouchPolicy, weights: Weights, prior: np.ndarray, algorithm: AnyAlgorithm
) -> GRPOArm:
    """An arm with a study's steps and further rewards."""
    weights = {**weights, **config.more_rewards}
    grpo = dataclasses.replace(config.grpo, algorithm=config.algorithm(algorithm))
    return make_arm(policy, weights, prior, grpo, config.grpo_loop)
