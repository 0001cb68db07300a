"""A study: several arms of GRPO from one SFT checkpoint per seed, on the same data in the same order.

The answers of a finished policy are kept in `answers/NAME-SEED.npz` of the run, so a resumed run repeats no evaluation,
and the policy itself in `policies/NAME/SEED`, so that it can be asked about new data (`python -m experiments ask`).
"""

import dataclasses
import functools
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array

from experiments.core.artifacts import write_bytes
from experiments.core.context import Context
from experiments.study.cache import DAMAGED
from experiments.study.dataset import Dataset
from experiments.study.policies import policy_folder, publish_policy
from experiments.study.stages import (
    EncodedContacts,
    GRPOArm,
    ProbeFeatures,
    StudySFT,
    Weights,
    encode_rows,
    gather_evidence,
    make_arm,
    noise_bank,
    probe_features,
    run_decoder,
    run_encoders,
    run_grpo,
    run_sft,
)
from experiments.study.training import (
    DECODER,
    GRPO_ATTRIBUTES,
    TrainingConfig,
    open_data,
    require_derived,
    starting_model,
)
from sensors_io.arrays import load_arrays
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import ATTRIBUTES, SENSORS, UNKNOWN
from touchr1_jax.models.policy import Features
from touchr1_jax.models.pretrained import load_encoder
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig, TouchPolicy, build_policy, check_model, with_lora
from touchr1_jax.rewards import AnyReward, RewardError, make_rewards, uniform_prior
from touchr1_jax.rl.config import AnyAlgorithm, GRPOConfig
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.training.evaluation import Evaluation, evaluate_policy
from touchr1_jax.training.feeds import FULL_SHARE
from touchr1_jax.training.train_encoder import EncoderTrainingConfig
from touchr1_jax.training.train_grpo import check_rewards
from touchr1_jax.types import Params, Parsed

SFT, CONTINUED, BLIND = "sft", "sft_continued", "tactile_blind"
"""Policies of every study besides its arms: SFT, from which arms start, the control that continues SFT for as many
seconds as an arm takes, and SFT without touch."""

CONTINUED_ORDER = 1_000
"""Added to the seed of the questions of the control, which would otherwise be those of the phase before it."""


MODEL = ModelConfig(tactile=TactileViTConfig(sensors=0, num_layers=1, stem="statistics", stem_width=64))
"""The default policy; its stem has no parameters before its first layer, so that it is computed once."""


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
    seeds=2,
    scenes=SceneConfig(objects=60, sites=1),
    encoders=EncoderTrainingConfig(steps=12, batch_size=8),
    blind=StudySFT(steps=12, batch_size=8, micro_contacts=8),
    decoder=dataclasses.replace(DECODER, steps=6, batch_size=4, save_every=3),
    grpo=dataclasses.replace(GRPOConfig.paper(), prompts=4, micro_prompts=2),
    grpo_steps=4,
)
"""A study that takes under two minutes and learns nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudySeed:
    """One seed of a study; `evidence` [contact, S, A, K] is that of its verified answers."""

    config: TrainingConfig
    data: Dataset
    policy: TouchPolicy
    evidence: np.ndarray
    context: Context
    seed: int

    def contacts(self, params: Params) -> EncodedContacts:
        """The contacts that a policy's decoder is trained on, encoded by it (see `training.Recipe`)."""
        data, paper = self.data, self.config.recipe == "paper"
        rows = data.parts["grpo"]
        truth = data.label[rows]
        return EncodedContacts(
            features=encode_rows(self.policy, params, data, rows, self.context),
            label=np.where(np.isin(ATTRIBUTES, GRPO_ATTRIBUTES), truth, UNKNOWN) if paper else truth,
            truth=truth,
            noise=noise_bank(self.policy, params, data, seed=self.seed, contacts=self.config.noise_contacts),
            evidence=self.evidence[rows],
            **({} if paper else {"full_share": FULL_SHARE}),
        )

    def ask(self, params: Params, features: Features, *, alone: bool = True, samples: int = 0) -> Evaluation:
        """Answers about encoded test contacts, asked under a progress bar; arguments of `evaluate_policy`."""
        label = self.data.labels("test")
        with self.context.progress_callback("asking") as progress:
            order: dict[str, Any] = {"alone": alone, "samples": samples, "progress": progress}
            return evaluate_policy(self.policy, params, features, label, **order)


def supervised(of: StudySeed, *, tactile: Params | None = None, name: str = "", share: bool = False) -> Params:
    """The policy of a seed before the phase of its decoder: its encoders trained by a head, then SFT end to end.

    `tactile` are parameters of the tactile encoder to start from, `name` is that of the policy in its stages where a
    run trains several with one seed; `share` as in `run_sft`.
    """
    config, start = of.config, {} if tactile is None else {"tactile": tactile}
    order: dict[str, Any] = {"seed": of.seed, "share": share}
    ending = f"{name}/{of.seed}" if name else f"{of.seed}"
    if config.recipe == "touch" and config.encoders.steps:
        order |= {"stage": f"encoders/{ending}", "start": start}
        start = run_encoders(of.policy, of.data, config.encoders, of.context, **order)
    if not config.sft.steps:
        return start
    order |= {"stage": f"sft/{ending}", "start": start}
    return run_sft(of.policy, of.data, of.evidence, config.sft, of.context, **order)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainedPolicy(StudySeed):
    """A saved policy of one seed; `noise` is its encoder's noise bank, `evaluation` its answers about `test`."""

    folder: Path
    params: Params
    test: Features
    noise: Array
    evaluation: Evaluation


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvalVariant:
    """Another evaluation, about the test contacts, of the policy named `of`, which is SFT or an arm."""

    of: str
    evaluate: Callable[[TrainedPolicy], Evaluation]


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
      variants: further evaluations of SFT and the arms, by the names of their answers.

    Raises:
      ValueError, RewardError, SizeError, EncoderError: as `check_arms`, `check_model` and `load_encoder`.
    """
    check_arms({arm: {**weights, **config.more_rewards} for arm, weights in arms.items()}, variants)
    check_model(config.model, SENSORS)
    if config.encoder is not None:
        load_encoder(config.encoder)  # a file that is no encoder is reported before data are made
    data = open_study_data(config, context)
    model, tactile = starting_model(config.model, config.encoder, data.clip.sensors)
    policy = with_lora(build_policy(model, data.clip.sensors), config.lora)
    return train_study(config, data, policy, arms, context, algorithms, variants, tactile=tactile, share=config.share)


def check_arms(
    arms: Mapping[str, Weights],
    variants: Mapping[str, EvalVariant] = {},
    rewards: Mapping[str, AnyReward] | None = None,
) -> None:
    """Try every weighted reward of every arm, so that a misfit is reported before anything is made.

    Raises:
      RewardError: as `check_rewards`; it names the arm.
      ValueError: a variant of a policy that is not there, or with the name of one.
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


def open_study_data(config: StudyConfig, context: Context) -> Dataset:
    """Records of the configured source, with clips of the model's size."""
    return open_data(config, config.model.vision.image_px, context)


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
) -> Study:
    """Train every arm of every seed and evaluate every policy, with data and policy at hand.

    Args:
      config, data, policy, arms, context, algorithms, variants: as in `run_study`, which checks them.
      tactile: parameters of the tactile encoder that SFT starts from; `None` starts from fresh ones.
      share: take policies from the cache.
    """
    probed = probe_features(data, context)
    evidence = gather_evidence(data, probed, config.probe, context)
    prior = data.prior()
    made = {
        arm: make_study_arm(config, policy, weights, prior, algorithms.get(arm, config.grpo.algorithm))
        for arm, weights in arms.items()
    }
    answers: dict[str, list[Evaluation]] = {name: [] for name in (SFT, CONTINUED, *arms, BLIND, *variants)}
    study: dict[str, Any] = {"config": config, "data": data, "policy": policy, "context": context, "share": share}
    study |= {"tactile": tactile, "evidence": evidence, "arms": made, "variants": variants}
    for seed in context.each("seeds", range(config.seeds)):
        for name, evaluation in _Seed(**study, seed=seed).answers().items():
            answers[name].append(evaluation)
    further = {name: answers.pop(name) for name in variants}
    return Study(
        config=config,
        data=data,
        policy=policy,
        probed=probed,
        prior=prior,
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Seed(StudySeed):
    """Its SFT checkpoint, the arms that start from it, and its blind baseline."""

    tactile: Params | None
    share: bool
    arms: Mapping[str, GRPOArm]
    variants: Mapping[str, EvalVariant]

    def answers(self) -> dict[str, Evaluation]:
        """Answers of all policies of this seed, from disk where they are there."""
        names = (SFT, CONTINUED, *self.arms, BLIND, *self.variants)
        self.context.processes.write_once(lambda: self._drop_damaged(names))
        if not all(self._path(name).exists() for name in names):
            self._train()
            self._evaluate(BLIND, self._blind)
        return {name: load_answers(self._path(name)) for name in names}

    def _train(self) -> None:
        """SFT in its phases, its control, and every arm."""
        data, policy, context, config, seed = self.data, self.policy, self.context, self.config, self.seed
        params = supervised(self, tactile=self.tactile, share=self.share)
        contacts = self.contacts(params)
        test, val = (encode_rows(policy, params, data, data.parts[part], context) for part in ("test", "val"))
        held_out = val, data.labels("val")
        more_sft = functools.partial(run_decoder, policy, contacts, held_out, context=context, share=self.share)
        if config.recipe == "touch":
            params = more_sft(config.decoder, params, seed=seed, stage=f"decoder/{SFT}/{seed}")
        self._evaluate_all(SFT, params, test, contacts.noise)
        stage = f"decoder/{CONTINUED}/{seed}"
        longer = more_sft(config.continued, params, seed=seed + CONTINUED_ORDER, stage=stage)
        self._evaluate_all(CONTINUED, longer, test, contacts.noise)
        for name, arm in self.arms.items():
            order: dict[str, Any] = {"seed": seed, "stage": f"grpo/{name}/{seed}", "share": self.share}
            tuned = run_grpo(policy, arm, contacts, params, context, **order)
            self._evaluate_all(name, tuned, test, contacts.noise)

    def _blind(self) -> Evaluation:
        order: dict[str, Any] = {"seed": self.seed, "stage": f"blind/{self.seed}", "share": self.share, "blind": True}
        params = run_sft(self.policy, self.data, self.evidence, self.config.blind, self.context, **order)
        features = encode_rows(self.policy, params, self.data, self.data.parts["test"], self.context, blind=True)
        return self.ask(params, features, samples=self.config.samples)

    def _evaluate_all(self, name: str, params: Params, test: Features, noise: Array) -> None:
        """Save and evaluate a policy, then evaluate all variants of it."""
        publish_policy(self.policy, params, self.data, name, self.seed, self.context)
        self._evaluate(name, lambda: self.ask(params, test, samples=self.config.samples))
        of_study = {field.name: getattr(self, field.name) for field in dataclasses.fields(StudySeed)}
        for title, variant in self.variants.items():
            if variant.of == name:
                evaluation = load_answers(self._path(name))
                made: dict[str, Any] = {"params": params, "test": test, "noise": noise, "evaluation": evaluation}
                trained = TrainedPolicy(**of_study, **made, folder=policy_folder(self.context, name, self.seed))
                self._evaluate(title, functools.partial(variant.evaluate, trained))

    def _evaluate(self, name: str, evaluate: Callable[[], Evaluation]) -> None:
        if not self._path(name).exists():
            with self.context.timed(f"ask/{name}/{self.seed}"):
                evaluation = evaluate()
                self.context.processes.write_once(lambda: save_answers(self._path(name), evaluation))

    def _drop_damaged(self, names: Sequence[str]) -> None:
        """Remove answers that cannot be read, so that they are made again."""
        for path in filter(Path.exists, map(self._path, names)):
            try:
                load_answers(path)
            except DAMAGED as error:
                self.context.print(f"{path} is damaged ({error}), and is made again")
                path.unlink()

    def _path(self, name: str) -> Path:
        return self.context.directory / "answers" / f"{name}-{self.seed}.npz"


def save_answers(path: Path, evaluation: Evaluation) -> None:
    """Publish answers as one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    flat: dict[str, Any] = {f: getattr(evaluation, f) for f in _FLAT if getattr(evaluation, f) is not None}
    flat |= {f"parsed_{f}": getattr(evaluation.parsed, f) for f in _PARSED}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **flat)
    write_bytes(path, buffer.getvalue())


def load_answers(path: Path) -> Evaluation:
    """Answers that `save_answers` published.

    Raises:
      ValueError, KeyError: the file is damaged.
    """
    arrays = load_arrays(path)
    flat: dict[str, Any] = {f: arrays.get(f) for f in _FLAT}
    parsed: dict[str, Any] = {f: arrays[f"parsed_{f}"] for f in _PARSED}
    return Evaluation(**flat, parsed=Parsed(**parsed))


_FLAT = tuple(f.name for f in dataclasses.fields(Evaluation) if f.name != "parsed")
_PARSED = tuple(f.name for f in dataclasses.fields(Parsed))
