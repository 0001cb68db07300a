"""One seed of a study: its SFT policy, the arms and the control that start from it, and its blind baseline.

A stage is the library's training, filled with a run's data; its log and checkpoints are in the run's directory, so that
a stopped run continues from its last checkpoint.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Array

from experiments.core.context import Context
from experiments.core.loops import stage_hooks
from experiments.study.alarm_log import alarm_log
from experiments.study.answers import answers_path, load_answers, save_answers, share_right
from experiments.study.cache import DAMAGED, cached
from experiments.study.dataset import Dataset
from experiments.study.policies import fault_of, policy_folder, publish_policy, require_published
from experiments.study.stages import (
    EncodedContacts,
    GRPOArm,
    StudySFT,
    answer_feed,
    computed_touch,
    describe_sample,
    encode_rows,
    noise_bank,
    untrained,
)
from experiments.study.training import GRPO_ATTRIBUTES, TrainingConfig
from sensors_io.schema import ATTRIBUTES, UNKNOWN
from touchr1_jax.models.policy import Features
from touchr1_jax.models.saved_policy import PolicyError
from touchr1_jax.models.touch_policy import TouchPolicy
from touchr1_jax.rl.config import left_out
from touchr1_jax.training.evaluation import Evaluation, evaluate_policy
from touchr1_jax.training.feeds import FULL_SHARE, AnswerFeed, encoded_clips, host_touch
from touchr1_jax.training.loop import Batches
from touchr1_jax.training.questions import QuestionFeed
from touchr1_jax.training.rollout_server import RolloutServer
from touchr1_jax.training.train_encoder import touch_rows, train_encoder
from touchr1_jax.training.train_grpo import train_grpo
from touchr1_jax.training.train_sft import SFTConfig, train_sft
from touchr1_jax.types import Params

SFT, CONTINUED, BLIND = "sft", "sft_continued", "tactile_blind"
"""Policies of every study besides its arms: SFT, from which arms start, the control that continues SFT for as many
seconds as an arm takes, and SFT without touch."""

CONTINUED_ORDER = 1_000
"""Added to the seed of the questions of the control, which would otherwise be those of the phase before it."""

Validation = tuple[Features, np.ndarray]
"""Features and labels of contacts; the share of right answers about them chooses a checkpoint."""

S = TypeVar("S", bound="StudySeed")


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudySeed:
    """One seed of a study and its stages of training, each named `PHASE/SEED` or `PHASE/NAME/SEED`.

    `evidence` [contact, S, A, K] is that of its verified answers.  With `share` a policy comes from the cache where an
    experiment trained it before.
    """

    config: TrainingConfig
    data: Dataset
    policy: TouchPolicy
    evidence: np.ndarray
    context: Context
    seed: int
    share: bool = False

    def extended(self, kind: type[S], **more: Any) -> S:
        """The same seed with the further fields of a subclass."""
        return kind(**{field.name: getattr(self, field.name) for field in dataclasses.fields(StudySeed)}, **more)

    def encode(self, params: Params, part: str, *, blind: bool = False) -> Features:
        """The contacts of a part of the data, encoded by a policy."""
        return encode_rows(self.policy, params, self.data, self.data.parts[part], self.context, blind=blind)

    def validation(self, params: Params) -> Validation:
        """The validation contacts, encoded by a policy."""
        return self.encode(params, "val"), self.data.labels("val")

    def contacts(self, params: Params) -> EncodedContacts:
        """The contacts that a policy's decoder is trained on, encoded by it (see `training.Recipe`)."""
        data, paper = self.data, self.config.recipe == "paper"
        rows = data.parts["grpo"]
        truth = data.label[rows]
        return EncodedContacts(
            features=self.encode(params, "grpo"),
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

    def run_encoders(self, stage: str, start: Mapping[str, Any] = {}) -> Params:
        """Training of the encoders by a linear head on the contacts of SFT; `start` as in `run_sft`."""
        policy, data, config = self.policy, self.data, self.config.encoders
        rows, stage = data.parts["sft"], f"{stage}/{self.seed}"

        def train() -> Params:
            order = self._order(config.batch_size)
            touch = computed_touch(policy, data, self.context)
            if touch is None:
                feed: Batches = iter(data.batches(rows, **order).map(host_touch))
            else:
                feed = touch_rows(touch, rows, **order)
            with stage_hooks(self.context, stage, config.steps) as hooks:
                whole = untrained(policy, data, self.seed) | dict(start)
                return train_encoder(policy, whole, feed, config, hooks, seed=self.seed)

        values = {"records": [data.store.digest, data.digest()], "encoders": config, "clip": data.clip}
        return self._shared("sft", stage, train, values, {"rows": rows, "start": start})

    def run_sft(self, config: StudySFT, stage: str, start: Mapping[str, Any] = {}, *, blind: bool = False) -> Params:
        """SFT end to end of fresh parameters, in which those of `start` take their places.

        `blind` is the control without touch, under recipe `touch` up to its best checkpoint, as its rival's decoder.
        """
        policy, data, stage = self.policy, self.data, f"{stage}/{self.seed}"
        judge = self._judge_blind if blind and self.config.recipe == "touch" else None

        def train() -> Params:
            own, devices = self._order(config.batch_size)["own"], math.prod(self.context.devices.shape[:2])
            feed = answer_feed(
                policy, data, self.evidence, config, seed=self.seed, blind=blind, own=own, devices=devices
            )
            params = untrained(policy, data, self.seed) | dict(start)
            with stage_hooks(self.context, stage, config.steps, scored=judge is not None) as hooks:
                return train_sft(policy, params, feed, config, hooks, seed=self.seed, blind=blind, held_out=judge)

        values = {"records": [data.store.digest, data.digest()], "config": config, "clip": data.clip, "blind": blind}
        judged = np.zeros(0) if judge is None else data.parts["val"]
        arrays = {"evidence": self.evidence, "rows": data.parts["sft"], "start": start, "validation": judged}
        return self._shared("sft", stage, train, values, arrays)

    def run_decoder(
        self,
        config: SFTConfig,
        stage: str,
        contacts: EncodedContacts,
        validation: Validation | None,
        params: Params,
        seed: int | None = None,
    ) -> Params:
        """SFT of the decoder alone on encoded contacts; `validation` as in `run_grpo`, `seed` is of the questions."""
        policy, stage, seed = self.policy, f"{stage}/{self.seed}", self.seed if seed is None else seed

        def train() -> Params:
            order = self._order(config.batch_size) | {"seed": seed}
            clips = encoded_clips(contacts.features, np.arange(len(contacts.truth)), contacts.truth, **order)
            order |= {"questions": config.questions, "conclusion_weight": config.conclusion_weight}
            feed = AnswerFeed(policy, clips, contacts.evidence, **order)
            with stage_hooks(self.context, stage, config.steps, scored=validation is not None) as hooks:
                options: dict[str, Any] = {"seed": seed, "decoder_only": True}
                options["held_out"] = None if validation is None else self._judge(validation)
                return train_sft(policy, params, feed, config, hooks, **options)

        inputs = {**dataclasses.asdict(contacts.features), "truth": contacts.truth, "evidence": contacts.evidence}
        arrays = {**params, "input": inputs, "validation": {} if validation is None else _named(validation)}
        return self._shared("grpo", stage, train, {"config": config, "seed": seed}, arrays)

    def run_grpo(
        self,
        arm: GRPOArm,
        stage: str,
        contacts: EncodedContacts,
        params: Params,
        rollouts: RolloutServer | None = None,
        validation: Validation | None = None,
    ) -> Params:
        """GRPO of an SFT policy's decoder with an arm's reward; alarms are logged and printed.

        With `validation` it is the policy of the best checkpoint, without it that of the last step.  `rollouts` is a
        server that draws the rollouts; by default the step does.
        """
        policy, config, loop, stage = self.policy, arm.config, arm.loop, f"{stage}/{self.seed}"

        def train() -> Params:
            order = self._order(config.drawn) | {"truth": contacts.truth, "full_share": contacts.full_share}
            order |= {"evidence": None if left_out(config.algorithm.anchor) else contacts.evidence}
            feed = QuestionFeed(policy, contacts.features, contacts.label, **order)
            describe = functools.partial(describe_sample, policy)
            options: dict[str, Any] = {"make_log": alarm_log, "describe": describe, "scored": validation is not None}
            with stage_hooks(self.context, stage, loop.steps, **options) as hooks:
                more: dict[str, Any] = {"noise": contacts.noise, "seed": self.seed, "rollouts": rollouts}
                more["held_out"] = None if validation is None else self._judge(validation)
                return train_grpo(policy, params, feed, arm.score, config, loop, hooks, **more)

        values = {"weights": list(arm.weights.items()), "config": config, "loop": loop}
        values |= {"full_share": contacts.full_share}
        inputs = {**dataclasses.asdict(contacts.features), "noise": contacts.noise, "prior": arm.prior}
        inputs |= {"label": contacts.label, "truth": contacts.truth, "evidence": contacts.evidence}
        scored = {} if validation is None else _named(validation)
        return self._shared("grpo", stage, train, values, {**params, "input": inputs, "validation": scored})

    def continued(
        self, config: SFTConfig, contacts: EncodedContacts, validation: Validation | None, params: Params
    ) -> Params:
        """The control, which continues SFT of the decoder on other questions."""
        order = self.seed + CONTINUED_ORDER
        return self.run_decoder(config, f"decoder/{CONTINUED}", contacts, validation, params, order)

    def _judge(self, validation: Validation) -> Callable[[Params], float]:
        """The share of right answers about validation contacts, of parameters."""
        return lambda params: share_right(evaluate_policy(self.policy, params, *validation, alone=False))

    def _judge_blind(self, params: Params) -> float:
        """The same of a policy without touch, which trains its view too."""
        return self._judge((self.encode(params, "val", blind=True), self.data.labels("val")))(params)

    def _order(self, batch_size: int) -> dict[str, Any]:
        """Batches of this seed, of which the process reads its own rows."""
        return {"batch_size": batch_size, "seed": self.seed, "own": self.context.devices.local_rows(batch_size)}

    def _shared(
        self,
        kind: Literal["sft", "grpo"],
        stage: str,
        train: Callable[[], Params],
        values: Mapping[str, Any],
        arrays: Mapping[str, Any],
    ) -> Params:
        """The result of `train`, which depends on these values and arrays, from the cache where the study shares it."""
        if not self.share:
            return train()
        fns, shape = self.policy.fns, self.context.devices.shape
        common = {"model": self.policy.model, "lora": fns.lora, "seed": self.seed, "mesh": shape}
        return cached(kind, {**common, **values}, arrays, train, self.context, stage)


def _named(validation: Validation) -> dict[str, Any]:
    """The arrays of validation contacts, for the hash of what depends on them."""
    return {**dataclasses.asdict(validation[0]), "label": validation[1]}


def supervised(of: StudySeed, *, tactile: Params | None = None, name: str = "") -> Params:
    """The policy of a seed before the phase of its decoder: its encoders trained by a head, then SFT end to end.

    `tactile` are parameters of the tactile encoder to start from, `name` is that of the policy in its stages where a
    run trains several with one seed.
    """
    config, start = of.config, {} if tactile is None else {"tactile": tactile}
    ending = f"/{name}" if name else ""
    if config.recipe == "touch" and config.encoders.steps:
        start = of.run_encoders(f"encoders{ending}", start)
    return of.run_sft(config.sft, f"sft{ending}", start) if config.sft.steps else start


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
    """Another evaluation, about the test contacts, of the policy named `of`: SFT, the control or an arm."""

    of: str
    evaluate: Callable[[TrainedPolicy], Evaluation]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SeedTraining(StudySeed):
    """Its SFT checkpoint, the arms that start from it, and its blind baseline."""

    tactile: Params | None
    arms: Mapping[str, GRPOArm]
    variants: Mapping[str, EvalVariant]
    rollouts: RolloutServer | None = None
    """Server that draws the rollouts of GRPO; by default its steps do."""

    def answers(self) -> dict[str, Evaluation]:
        """Answers of all policies of this seed, from disk where they are there."""
        names = (SFT, CONTINUED, *self.arms, BLIND, *self.variants)
        self.context.processes.write_once(lambda: self._drop_damaged(names))
        if not all(self._path(name).exists() for name in names):
            order = (self._evaluate_arms, self._evaluate_blind)
            for evaluate in order if self.seed % 2 == 0 else order[::-1]:  # see `_evaluate_arms`
                evaluate()
        return {name: load_answers(self._path(name)) for name in names}

    def train(self, name: str) -> None:
        """One policy alone, and those that it starts from, without answers."""
        if name == BLIND:
            self._train_blind()
            return
        start = self._start()
        if name != SFT:
            self._continue(name, *start)

    def _start(self) -> tuple[Params, EncodedContacts, Validation]:
        """SFT in its phases, and the contacts that it encodes to go on from there."""
        params = supervised(self, tactile=self.tactile)
        contacts, validation = self.contacts(params), self.validation(params)
        if self.config.recipe == "touch":
            params = self.run_decoder(self.config.decoder, f"decoder/{SFT}", contacts, validation, params)
        return params, contacts, validation

    def _continue(self, name: str, params: Params, contacts: EncodedContacts, validation: Validation) -> Params:
        """The control or an arm, from what `_start` made; recipe `paper` takes the last checkpoint of each."""
        judged = validation if self.config.recipe == "touch" else None
        if name == CONTINUED:
            return self.continued(self.config.continued, contacts, judged, params)
        return self.run_grpo(self.arms[name], f"grpo/{name}", contacts, params, self.rollouts, judged)

    def _evaluate_arms(self) -> None:
        """SFT, its control and the arms; of seeds trained at the same time, one compiles what the other does not."""
        params, contacts, validation = self._start()
        test = self.encode(params, "test")
        self._evaluate_all(SFT, params, test, contacts.noise)
        others = (CONTINUED, *self.arms)
        first = self.seed % 2 * (len(others) // 2)
        for name in others[first:] + others[:first]:
            self._evaluate_all(name, self._continue(name, params, contacts, validation), test, contacts.noise)

    def _evaluate_blind(self) -> None:
        """The policy without touch; its answers may be there without its log, in a run that was copied in part."""
        if not (self._path(BLIND).exists() and self.context.has_sealed(f"blind/{self.seed}")):
            params = self._train_blind()
            unseen = self.encode(params, "test", blind=True)
            self._evaluate(BLIND, lambda: self.ask(params, unseen, samples=self.config.samples))

    def _train_blind(self) -> Params:
        return self.run_sft(self.config.blind, "blind", blind=True)

    def _evaluate_all(self, name: str, params: Params, test: Features, noise: Array) -> None:
        """Save and evaluate a policy, then evaluate all variants of it."""
        publish_policy(self.policy, params, self.data, name, self.seed, self.context)
        self._evaluate(name, lambda: self.ask(params, test, samples=self.config.samples))
        for title, variant in self.variants.items():
            if variant.of == name:
                folder, evaluation = policy_folder(self.context, name, self.seed), load_answers(self._path(name))
                made: dict[str, Any] = {"params": params, "test": test, "noise": noise, "evaluation": evaluation}
                trained = self.extended(TrainedPolicy, **made, folder=folder)
                self._evaluate(title, functools.partial(variant.evaluate, trained))

    def _evaluate(self, name: str, evaluate: Callable[[], Evaluation]) -> None:
        if not self._path(name).exists():
            with self.context.timed(f"ask/{name}/{self.seed}"):
                evaluation = evaluate()
                self.context.processes.write_once(lambda: save_answers(self._path(name), evaluation))

    def _drop_damaged(self, names: Sequence[str]) -> None:
        """Remove answers that cannot be read, and move policies that cannot, so that both are made again."""
        for name in names:
            path, folder = self._path(name), policy_folder(self.context, name, self.seed)
            try:
                if path.exists():
                    load_answers(path)
            except DAMAGED as error:
                self.context.print(f"{path} is damaged ({error.__cause__ or error}), and is made again")
                path.unlink()
            try:
                if name in (SFT, CONTINUED, *self.arms) and (path.exists() or folder.exists()):
                    require_published(folder)
            except PolicyError as error:
                self.context.print(f"{fault_of(error)}; it is made again, with {path}")
                if folder.exists():
                    places = (folder.with_name(f"damaged-{folder.name}-{i}") for i in itertools.count(1))
                    folder.rename(next(place for place in places if not place.exists()))
                path.unlink(missing_ok=True)

    def _path(self, name: str) -> Path:
        return answers_path(self.context, name, self.seed)
