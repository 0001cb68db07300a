"""One seed of a study: its SFT policy, the arms and the control that start from it, and its blind baseline."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array

from experiments.core.context import Context
from experiments.study.answers import load_answers, save_answers
from experiments.study.cache import DAMAGED
from experiments.study.dataset import Dataset
from experiments.study.policies import policy_folder, publish_policy
from experiments.study.stages import (
    EncodedContacts,
    GRPOArm,
    encode_rows,
    noise_bank,
    run_decoder,
    run_encoders,
    run_grpo,
    run_sft,
)
from experiments.study.training import GRPO_ATTRIBUTES, TrainingConfig
from sensors_io.schema import ATTRIBUTES, UNKNOWN
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.training.evaluation import Evaluation, evaluate_policy
from touchr1_jax.training.feeds import FULL_SHARE
from touchr1_jax.training.rollout_server import RolloutServer
from touchr1_jax.types import Params

SFT, CONTINUED, BLIND = "sft", "sft_continued", "tactile_blind"
"""Policies of every study besides its arms: SFT, from which arms start, the control that continues SFT for as many
seconds as an arm takes, and SFT without touch."""

CONTINUED_ORDER = 1_000
"""Added to the seed of the questions of the control, which would otherwise be those of the phase before it."""


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
class SeedTraining(StudySeed):
    """Its SFT checkpoint, the arms that start from it, and its blind baseline."""

    tactile: Params | None
    share: bool
    arms: Mapping[str, GRPOArm]
    variants: Mapping[str, EvalVariant]
    rollouts: RolloutServer | None = None
    """Server that draws the rollouts of GRPO; by default its steps do."""

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
        params, contacts, more_sft = self._start()
        test = encode_rows(self.policy, params, self.data, self.data.parts["test"], self.context)
        self._evaluate_all(SFT, params, test, contacts.noise)
        for name in (CONTINUED, *self.arms):
            self._evaluate_all(name, self._continue(name, params, contacts, more_sft), test, contacts.noise)

    def train(self, name: str) -> None:
        """One policy alone, and those that it starts from, without answers."""
        if name == BLIND:
            self._train_blind()
            return
        params, contacts, more_sft = self._start()
        if name != SFT:
            self._continue(name, params, contacts, more_sft)

    def _start(self) -> tuple[Params, EncodedContacts, Callable[..., Params]]:
        """SFT in its phases, the contacts that it encodes, and the function that goes on with SFT of its decoder."""
        data, policy, context, config = self.data, self.policy, self.context, self.config
        params = supervised(self, tactile=self.tactile, share=self.share)
        contacts = self.contacts(params)
        held_out = encode_rows(policy, params, data, data.parts["val"], context), data.labels("val")
        more_sft = functools.partial(run_decoder, policy, contacts, held_out, context=context, share=self.share)
        if config.recipe == "touch":
            params = more_sft(config.decoder, params, seed=self.seed, stage=f"decoder/{SFT}/{self.seed}")
        return params, contacts, more_sft

    def _continue(
        self, name: str, params: Params, contacts: EncodedContacts, more_sft: Callable[..., Params]
    ) -> Params:
        """The control or an arm, from what `_start` made."""
        if name == CONTINUED:
            stage = f"decoder/{CONTINUED}/{self.seed}"
            return more_sft(self.config.continued, params, seed=self.seed + CONTINUED_ORDER, stage=stage)
        order: dict[str, Any] = {"seed": self.seed, "stage": f"grpo/{name}/{self.seed}", "share": self.share}
        order |= {"rollouts": self.rollouts}
        return run_grpo(self.policy, self.arms[name], contacts, params, self.context, **order)

    def _train_blind(self) -> Params:
        order: dict[str, Any] = {"seed": self.seed, "stage": f"blind/{self.seed}", "share": self.share, "blind": True}
        return run_sft(self.policy, self.data, self.evidence, self.config.blind, self.context, **order)

    def _blind(self) -> Evaluation:
        params, rows = self._train_blind(), self.data.parts["test"]
        features = encode_rows(self.policy, params, self.data, rows, self.context, blind=True)
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
