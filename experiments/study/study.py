"""A study: several arms of GRPO from one SFT checkpoint per seed, on the same data in the same order.

What a finished policy said lies in `answers/NAME-SEED.npz` of the run, so a resumed run asks nothing twice.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array

from experiments.core.context import Context
from experiments.study.answers import Evaluated, evaluate_policy, load_answers, save_answers
from experiments.study.assembly import Assembly, ModelConfig, Weights, assemble, prove_model, prove_rewards
from experiments.study.cache import shared_grpo, shared_sft
from experiments.study.dataset import Dataset
from experiments.study.pretrained import load_encoder
from experiments.study.reinforcement import Arm, Asked, make_arm, run_grpo
from experiments.study.stages import (
    Probed,
    SFTConfig,
    encode_contacts,
    gather_evidence,
    noise_bank,
    probe_features,
    run_sft,
)
from experiments.study.training import TrainingConfig, open_data, starting_model
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS, UNKNOWN
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.config import AnyAlgorithm, GRPOConfig
from touchr1_jax.types import Params

SFT, BLIND = "sft", "tactile_blind"


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyConfig(TrainingConfig):
    """Everything that a study depends on, whose towers start from drawn parameters."""

    model: ModelConfig = ModelConfig()
    share: bool = True
    """Take policies from the cache where an experiment with the same data, settings and code trained them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_told("decoder.vocab_size", self.model.decoder.vocab_size)


SMOKE = StudyConfig(
    seeds=2,
    scenes=SceneConfig(objects=60, sites=1),
    sft=SFTConfig(steps=12, batch_size=8),
    blind=SFTConfig(steps=12, batch_size=8, micro_contacts=8),
    grpo=dataclasses.replace(GRPOConfig.paper(), prompts=4, micro_prompts=2),
    grpo_steps=4,
)
"""A study that takes under two minutes and learns nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trained:
    """A trained policy of one seed, and all that is needed to ask it in another way.

    Attributes:
      assembly, data, config, context, seed: those of the study.
      params: of the policy.
      test: encoded test contacts; `noise` is the encoded noise bank of its encoder.
      said: its answers about them.
      grpo_label: labels that GRPO may ask about, int32 [contact of the GRPO part, A].
    """

    assembly: Assembly
    data: Dataset
    config: TrainingConfig
    context: Context
    seed: int
    params: Params
    test: Features
    noise: Array
    said: Evaluated
    grpo_label: np.ndarray

    @property
    def label(self) -> np.ndarray:
        """Labels of the test contacts, int32 [contact, A]."""
        return self.data.label[self.data.parts["test"]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Way:
    """Another way to ask the policy named `of`, SFT or an arm: `ask` answers about the test contacts."""

    of: str
    ask: Callable[[Trained], Evaluated]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study:
    """What a study knows when it is done; `answers[name][seed]` are the answers about the test contacts.

    `further[name][seed]` are those that were got in another way.
    """

    config: TrainingConfig
    data: Dataset
    assembly: Assembly
    probed: Probed
    prior: np.ndarray
    arms: Mapping[str, Weights]
    answers: Mapping[str, Sequence[Evaluated]]
    further: Mapping[str, Sequence[Evaluated]] = dataclasses.field(default_factory=dict)

    @property
    def test_label(self) -> np.ndarray:
        """Labels of the test contacts, int32 [contact, A]."""
        return self.data.label[self.data.parts["test"]]


def run_study(
    config: StudyConfig,
    arms: Mapping[str, Weights],
    context: Context,
    algorithms: Mapping[str, AnyAlgorithm] | None = None,
    ways: Mapping[str, Way] | None = None,
) -> Study:
    """Make the data, train every arm of every seed, ask every policy.

    Args:
      config: sizes, data, algorithm.
      arms: reward weights of each arm.
      context: the run.
      algorithms: those of the arms that do not use the configured one.
      ways: other ways to ask SFT and the arms, by the names of their answers.

    Raises:
      ValueError: a way that asks a policy that is not there, or has the name of one.
      RewardError, SizeError, EncoderError: as `prove_rewards`, `prove_model` and `load_encoder`.
    """
    prove_rewards(arms)
    prove_model(config.model, SENSORS)
    if config.encoder is not None:
        load_encoder(config.encoder)  # what is no encoder is named before data are made
    check_ways(ways or {}, arms)
    data = open_study_data(config, context)
    model, tactile = starting_model(config.model, config.encoder, data.clip.sensors)
    start = Start(data=data, assembly=assemble(model, data.clip.sensors), tactile=tactile, share=config.share)
    return train_study(config, start, arms, context, algorithms, ways)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Start:
    """What a study begins with: data, policy, perhaps a tactile encoder, and whether policies are shared."""

    data: Dataset
    assembly: Assembly
    tactile: Params | None = None
    share: bool = False


def train_study(
    config: TrainingConfig,
    start: Start,
    arms: Mapping[str, Weights],
    context: Context,
    algorithms: Mapping[str, AnyAlgorithm] | None = None,
    ways: Mapping[str, Way] | None = None,
) -> Study:
    """Train every arm of every seed, ask every policy; arguments as in `run_study`, which has checked them."""
    data, assembly, ways = start.data, start.assembly, ways or {}
    configs = {
        arm: dataclasses.replace(config.grpo, algorithm=(algorithms or {}).get(arm, config.grpo.algorithm))
        for arm in arms
    }
    probed = probe_features(data, context)
    evidence = gather_evidence(data, probed, config.probe, context)
    prior = data.prior()
    make = functools.partial(make_arm, assembly, prior=prior, loop=config.grpo_loop, lora=config.grpo_lora)
    made = {arm: make(weights, config=configs[arm]) for arm, weights in arms.items()}
    answers: dict[str, list[Evaluated]] = {name: [] for name in (SFT, *arms, BLIND, *ways)}
    for seed in context.each("seeds", range(config.seeds)):
        one = _Seed(config, start, evidence, made, ways, context, seed)
        for name, said in one.answers().items():
            answers[name].append(said)
    further = {name: answers.pop(name) for name in ways}
    return Study(
        config=config,
        data=data,
        assembly=assembly,
        probed=probed,
        prior=prior,
        arms=arms,
        answers=answers,
        further=further,
    )


def check_ways(ways: Mapping[str, Way], arms: Mapping[str, Weights]) -> None:
    """Refuse ways that no study with these arms has room for.

    Raises:
      ValueError: a way that asks a policy that is not there, or has the name of one.
    """
    for name, way in ways.items():
        if way.of not in (SFT, *arms):
            raise ValueError(f"way {name!r} asks {way.of!r}: must be one of {', '.join((SFT, *arms))}; correct it")
        if name in (SFT, BLIND, *arms):
            raise ValueError(f"way {name!r} has the name of a policy: its answers would take their place; rename it")


def open_study_data(config: StudyConfig, context: Context) -> Dataset:
    """Records of the configured source, with clips of the model's size."""
    return open_data(config, config.model.vision.image_px, context)


@dataclasses.dataclass(frozen=True)
class _Seed:
    """One seed: its SFT checkpoint, the arms that start from it, and its blind baseline."""

    config: TrainingConfig
    start: Start
    evidence: np.ndarray
    arms: Mapping[str, Arm]
    ways: Mapping[str, Way]
    context: Context
    seed: int

    @property
    def assembly(self) -> Assembly:
        """The policy's."""
        return self.start.assembly

    @property
    def data(self) -> Dataset:
        """The study's."""
        return self.start.data

    def answers(self) -> dict[str, Evaluated]:
        """Answers of all policies of this seed, from disk where they are there."""
        names = (SFT, *self.arms, BLIND, *self.ways)
        if not all(self._path(name).exists() for name in names):
            self._train()
            self._ask(BLIND, self._blind)
        return {name: load_answers(self._path(name)) for name in names}

    def _train(self) -> None:
        """Everything that feels."""
        config, data, assembly, context, seed = self.config, self.data, self.assembly, self.context, self.seed
        params = self._sft(config.sft, f"sft/{seed}", tactile=self.start.tactile)
        encode = functools.partial(encode_contacts, assembly, params, data, context=context)
        test, train = encode(rows=data.parts["test"]), encode(rows=data.parts["grpo"])
        noise = noise_bank(assembly.fns, params, data, seed=seed, probe=config.noise_contacts)
        asked = Asked(features=train, label=self._grpo_label(), noise=noise)
        self._ask(SFT, lambda: evaluate_policy(assembly, params, test, self._label("test"), context))
        self._ask_further(SFT, params, test, noise)
        for arm in self.arms:
            tuned = self._grpo(arm, params, asked)
            self._ask(arm, functools.partial(evaluate_policy, assembly, tuned, test, self._label("test"), context))
            self._ask_further(arm, tuned, test, noise)

    def _blind(self) -> Evaluated:
        params = self._sft(self.config.blind, f"blind/{self.seed}", blind=True)
        features = encode_contacts(self.assembly, params, self.data, self.data.parts["test"], self.context, blind=True)
        return evaluate_policy(self.assembly, params, features, self._label("test"), self.context)

    def _sft(self, sft: SFTConfig, stage: str, *, blind: bool = False, tactile: Params | None = None) -> Params:
        make = shared_sft if self.start.share else run_sft
        return make(
            self.assembly,
            self.data,
            self.evidence,
            sft,
            self.context,
            seed=self.seed,
            stage=stage,
            blind=blind,
            tactile=tactile,
        )

    def _grpo(self, arm: str, params: Params, asked: Asked) -> Params:
        make = shared_grpo if self.start.share else run_grpo
        stage = f"grpo/{arm}/{self.seed}"
        return make(self.assembly, self.arms[arm], asked, params, self.context, seed=self.seed, stage=stage)

    def _ask(self, name: str, evaluate: Callable[[], Evaluated]) -> None:
        if not self._path(name).exists():
            with self.context.timed(f"ask/{name}/{self.seed}"):
                said = evaluate()
                self.context.processes.write_once(lambda: save_answers(self._path(name), said))

    def _ask_further(self, name: str, params: Params, test: Features, noise: Array) -> None:
        """Ask a policy in all other ways that are wanted of it."""
        for title, way in self.ways.items():
            if way.of == name:
                trained = Trained(
                    assembly=self.assembly,
                    data=self.data,
                    config=self.config,
                    context=self.context,
                    seed=self.seed,
                    params=params,
                    test=test,
                    noise=noise,
                    said=load_answers(self._path(name)),
                    grpo_label=self._grpo_label(),
                )
                self._ask(title, functools.partial(way.ask, trained))

    def _label(self, part: str) -> np.ndarray:
        return self.data.label[self.data.parts[part]]

    def _grpo_label(self) -> np.ndarray:
        """Labels of the GRPO contacts, with those of attributes that GRPO does not ask about hidden."""
        names = [a.name for a in self.assembly.language.attributes]
        return np.where(np.isin(names, self.config.grpo_attributes), self._label("grpo"), UNKNOWN)

    def _path(self, name: str) -> Path:
        return self.context.directory / "answers" / f"{name}-{self.seed}.npz"
