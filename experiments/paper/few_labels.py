"""With few labels, what pays: likelihood, reinforcement, touch without labels, or pretraining?

    make experiment EXP=few_labels

Policies are trained with 10, 30, 100, 300 and all labelled contacts, from a random encoder and from one that stage 1
has pretrained on the touch of all training objects: by SFT end to end (`sft`), or in two phases, of the encoders by a
linear head and of the decoder (`two_phases`), and from there by GRPO on the labelled contacts (`grpo`), GRPO that also
asks about unlabelled contacts and pays the level that most sensors alone agree on (`agreement`), and GRPO that pays the
level that measured physics implies (`physics`): hardness from the slope of force over indentation, roughness from
friction force over load where a contact slides.  All are scored once on test objects.

Cost: about half an hour on two cores; `--scale smoke` under two minutes.

Expected: every tenfold number of labels brings more than any method; label-free terms can pay only where the agreed or
measured level is right more often than the policy, and the report shows how often it is.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.core.artifacts import write_bytes
from experiments.core.context import Context
from experiments.core.results import Cell, Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.encoder.pretrain import pretrain
from experiments.paper.label_curves import (
    METHODS,
    PRETRAINED,
    RANDOM,
    Method,
    compare,
    compared_pairs,
    curve_chart,
    curve_table,
    verdict,
)
from experiments.paper.label_free import agreed_levels, measured_levels
from experiments.study.dataset import Dataset
from experiments.study.estimates import estimate
from experiments.study.scores import score, study_settings
from experiments.study.stages import (
    EncodedContacts,
    GRPOArm,
    StudySFT,
    Weights,
    encode_rows,
    gather_evidence,
    make_arm,
    noise_bank,
    probe_features,
    run_decoder,
    run_grpo,
    run_sft,
)
from experiments.study.study import (
    SMOKE as SMOKE_STUDY,
)
from experiments.study.study import (
    Study,
    StudyConfig,
    StudySeed,
    load_answers,
    open_study_data,
    save_answers,
    supervised,
)
from experiments.study.training import DECODER, starting_model
from sensors_io.schema import SENSORS
from touchr1_jax.bench.metrics import Scores
from touchr1_jax.models.policy import Features
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import TouchPolicy, build_policy, check_model, with_lora
from touchr1_jax.rewards import uniform_prior
from touchr1_jax.rl.config import GRPOConfig, Norm, Rloo
from touchr1_jax.training.evaluation import Evaluation, evaluate_policy
from touchr1_jax.training.feeds import FULL_SHARE
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.pretraining import PretrainConfig, encoder_of
from touchr1_jax.training.train_encoder import EncoderTrainingConfig
from touchr1_jax.training.train_sft import SFTConfig
from touchr1_jax.types import Params
from touchr1_jax.validation import at_least

REWARDS: Weights = {"exact": 0.9, "format": 0.1}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FewLabelsConfig(StudyConfig):
    """A study for each number of labels and each encoder."""

    seeds: int = 3
    labelled: tuple[int, ...] = (10, 30, 100, 300, 1_680)
    """Labelled contacts; more than there are means all."""
    unlabelled: int = 300
    """Contacts without labels that label-free rewards ask about."""
    encoders: EncoderTrainingConfig = EncoderTrainingConfig(steps=500)
    sft: StudySFT = StudySFT(steps=150)
    decoder: SFTConfig = dataclasses.replace(DECODER, steps=150, save_every=50)
    grpo: GRPOConfig = GRPOConfig(
        prompts=32,
        group=4,
        micro_prompts=8,
        inverse_draws=True,
        lr_scale=200.0,
        algorithm=Rloo(enumerated=Norm.NONE),
    )
    grpo_steps: int = 40
    samples: int = 0
    pretrain: PretrainConfig = PretrainConfig(
        encoder=TactileViTConfig(sensors=0, causal=True), objective="physics", steps=300, probe_every=300, batch_size=16
    )
    """Stage 1 on the touch of all training objects."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "unlabelled")
        if not self.labelled or list(self.labelled) != sorted(set(self.labelled)) or self.labelled[0] < 1:
            raise ValueError(f"labelled is {self.labelled}: must hold different counts ≥ 1, ascending; sort it")
        if self.labelled[0] < self.probe.folds:
            raise ValueError(
                f"labelled[0] is {self.labelled[0]}: must be at least probe.folds = {self.probe.folds}, between which "
                "the probes of the verified answers are crossed; raise it"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class LabelledSet:
    """One seed's training on some labelled contacts from one encoder.

    Attributes:
      data: its part `sft` are the labelled contacts, `grpo` those without labels.
      tactile: parameters of the pretrained encoder, or none.
      measured: levels that measured physics implies, int [contact, A], −1 where it implies none.
      name: of the set, in stages and files.
    """

    config: FewLabelsConfig
    context: Context
    data: Dataset
    policy: TouchPolicy
    evidence: np.ndarray
    tactile: Params | None
    measured: np.ndarray
    seed: int
    name: str

    def answers(self) -> dict[Method, Evaluation]:
        """Answers of every method about the test contacts, kept in the run."""
        paths = {method: self._path(method) for method in METHODS}
        if not all(path.exists() for path in paths.values()):
            self._train()
        return {method: load_answers(path) for method, path in paths.items()}

    def _train(self) -> None:
        config, data = self.config, self.data
        order: dict[str, Any] = {"seed": self.seed, "share": True}
        tactile = {} if self.tactile is None else {"tactile": self.tactile}
        stage = f"sft/{self.name}/{self.seed}"
        whole = run_sft(self.policy, data, self.evidence, config.sft, self.context, stage=stage, start=tactile, **order)
        self._keep("sft", whole, encode_rows(self.policy, whole, data, data.parts["test"], self.context))
        phases = dataclasses.replace(config, sft=dataclasses.replace(config.sft, steps=0))
        of: dict[str, Any] = {"config": phases, "data": data, "policy": self.policy, "context": self.context}
        seed = StudySeed(**of, evidence=self.evidence, seed=self.seed)
        start = supervised(seed, tactile=self.tactile, name=self.name, share=True)
        test, val = (encode_rows(self.policy, start, data, data.parts[part], self.context) for part in ("test", "val"))
        known, free = self._contacts(start)
        stage = f"decoder/{self.name}/{self.seed}"
        held_out = val, data.labels("val")
        longer = run_decoder(self.policy, known, held_out, config.decoder, start, self.context, stage=stage, **order)
        self._keep("two_phases", longer, test)
        agreed = self._implied("agreement", known, free, self._agreed(longer, free))
        measured = self._implied("physics", known, free, self.measured[data.parts["grpo"]])
        of_method: dict[Method, EncodedContacts] = {"grpo": known, "agreement": agreed, "physics": measured}
        for method, contacts in of_method.items():
            self._keep(method, self._reinforced(method, contacts, longer), test)

    def _contacts(self, params: Params) -> tuple[EncodedContacts, EncodedContacts]:
        """The labelled contacts, and those without labels, whose levels are hidden."""
        data, parts = self.data, (self.data.parts["sft"], self.data.parts["grpo"])
        noise = noise_bank(self.policy, params, data, seed=self.seed, contacts=self.config.noise_contacts)
        found = []
        for rows, shown in zip(parts, (True, False), strict=True):
            label = data.label[rows] if shown else np.full_like(data.label[rows], -1)
            features = encode_rows(self.policy, params, data, rows, self.context)
            of: dict[str, Any] = {"features": features, "label": label, "truth": label, "noise": noise}
            found.append(EncodedContacts(**of, evidence=self.evidence[rows], full_share=FULL_SHARE))
        return found[0], found[1]

    def _agreed(self, params: Params, free: EncodedContacts) -> np.ndarray:
        ask_all = np.zeros_like(free.label)  # a label of 0 has every question asked; nothing else reads it
        return agreed_levels(evaluate_policy(self.policy, params, free.features, ask_all), free.label)

    def _implied(
        self, method: Method, known: EncodedContacts, free: EncodedContacts, level: np.ndarray
    ) -> EncodedContacts:
        """Both kinds of contacts, those without labels with the levels that a label-free reward pays."""
        right, asked = level == self.data.label[self.data.parts["grpo"]], level >= 0
        found = [100 * float(asked.mean()), 100 * float(right[asked].mean()) if asked.any() else None]
        self.context.save_stage(f"implied/{method}-{self.name}/{self.seed}", found)
        if not asked.any():
            return known
        label = np.concatenate([known.label, level])
        join = lambda a, b: np.concatenate([np.asarray(a), np.asarray(b)])
        features: Features = jax.tree.map(join, known.features, free.features)
        evidence = np.concatenate([known.evidence, free.evidence])
        return dataclasses.replace(known, features=features, label=label, truth=label, evidence=evidence)

    def _reinforced(self, method: str, contacts: EncodedContacts, start: Params) -> Params:
        config = self.config
        grpo = dataclasses.replace(config.grpo, algorithm=config.algorithm(config.grpo.algorithm))
        arm = arm_of(self.policy, grpo, config.grpo_loop)
        order: dict[str, Any] = {"seed": self.seed, "stage": f"grpo/{method}-{self.name}/{self.seed}", "share": True}
        return run_grpo(self.policy, arm, contacts, start, self.context, **order)

    def _keep(self, method: Method, params: Params, test: Features) -> None:
        if not self._path(method).exists():
            label = self.data.labels("test")
            save_answers(self._path(method), evaluate_policy(self.policy, params, test, label, alone=False))

    def _path(self, method: Method) -> Path:
        return self.context.directory / "answers" / f"{method}-{self.name}-{self.seed}.npz"


@functools.cache
def arm_of(policy: TouchPolicy, grpo: GRPOConfig, loop: LoopConfig) -> GRPOArm:
    """The arm of all sets, so that its step is compiled once; its rewards need no shares of labels."""
    return make_arm(policy, REWARDS, uniform_prior(policy.levels), grpo, loop)


def run(config: FewLabelsConfig, context: Context) -> Results:
    """Pretrain once, train every set, compare."""
    check_model(config.model, SENSORS)
    data = open_study_data(config, context)
    train = data.training
    path = pretrained_encoder(config, data, train, context)
    model, tactile = starting_model(config.model, path, data.clip.sensors)
    policy, probed = with_lora(build_policy(model, data.clip.sensors), config.lora), probe_features(data, context)
    levels = np.array(context.once("measured", lambda: measured_levels(data.store, train).tolist()))
    answers: dict[str, list[Evaluation]] = {}
    for seed in context.each("seeds", range(config.seeds)):
        order = np.random.default_rng((seed, 31)).permutation(train)
        for count in context.each("labels", config.labelled):
            few = with_parts(data, order[:count], order[count : count + config.unlabelled])
            evidence = gather_evidence(few, probed, config.probe, context)
            if not len(few.parts["grpo"]):  # everything is labelled: label-free rewards ask about the same contacts
                few = with_parts(data, order[:count], order[: config.unlabelled])
            for encoder, start in ((RANDOM, None), (PRETRAINED, tactile)):
                name = f"{min(count, len(train))}-{encoder}"
                made: dict[str, Any] = {"config": config, "context": context, "data": few, "policy": policy}
                made |= {"evidence": evidence, "tactile": start, "measured": levels, "seed": seed, "name": name}
                for method, evaluation in LabelledSet(**made).answers().items():
                    answers.setdefault(f"{method}-{name}", []).append(evaluation)
    study = Study(config=config, data=data, policy=policy, probed=probed, prior=data.prior(), arms={}, answers={})
    scored = {name: [score(study, one) for one in seeds] for name, seeds in answers.items()}
    objects = data.object_ids[data.parts["test"]][next(iter(answers.values()))[0].contact]
    counts = [min(count, len(train)) for count in config.labelled]
    counts = list(dict.fromkeys(counts))
    return report(config, data, scored, objects, counts, implied_table(config, context, counts))


def with_parts(data: Dataset, labelled: np.ndarray, unlabelled: np.ndarray) -> Dataset:
    """The data with other contacts in the parts that are trained on."""
    return dataclasses.replace(data, parts={**data.parts, "sft": labelled, "grpo": unlabelled})


def pretrained_encoder(config: FewLabelsConfig, data: Dataset, rows: np.ndarray, context: Context) -> Path:
    """File of the encoder after stage 1, made once in a run."""
    path = context.directory / "encoder.npz"
    if not path.exists():
        state = pretrain(config.pretrain, data.store, rows, data.clip, context, stage="stage1/0", seed=0)
        online = dataclasses.replace(state, target=state.params["encoder"])
        write_bytes(path, encoder_of(config.pretrain, online, data.clip.sensors).to_bytes())
    return path


def implied_table(config: FewLabelsConfig, context: Context, counts: Sequence[int]) -> Table:
    """Share of levels that each label-free reward pays, and of those that are right, means over seeds."""
    lines: list[dict[str, Cell]] = []
    for method in ("agreement", "physics"):
        for name in (f"{count}-{encoder}" for encoder in (RANDOM, PRETRAINED) for count in counts):
            found = [context.load_stage(f"implied/{method}-{name}/{seed}") for seed in range(config.seeds)]
            right = [x for _, x in found if x is not None]
            share = float(np.mean([x for x, _ in found]))
            lines.append(
                {"set": f"{method}-{name}", "implied": share, "right": float(np.mean(right)) if right else None}
            )
    return named_table(
        "Levels without labels",
        lines,
        formats={"implied": ".0f", "right": ".0f"},
        units={"implied": "%", "right": "%"},
        meanings={"implied": "of four properties of the contacts without labels", "right": "of the implied levels"},
    )


def report(
    config: FewLabelsConfig,
    data: Dataset,
    scored: Mapping[str, Sequence[Mapping[str, Scores]]],
    objects: np.ndarray,
    counts: Sequence[int],
    implied: Table,
) -> Results:
    """Learning curves, their differences, and where each method pays."""
    rows = {
        name: {metric: estimate([s[metric] for s in seeds], objects) for metric in seeds[0]}
        for name, seeds in scored.items()
    }
    pairs = [pair for count in counts for pair in compared_pairs(count)]
    comparisons = [c for a, b in pairs for c in compare(scored, rows, a, b, objects)]
    return Results(
        verdict=verdict(comparisons, counts),
        arms=rows,
        comparisons=tuple(comparisons),
        tables=(curve_table(rows, comparisons, counts), implied),
        pictures=(
            Picture(
                name="few_labels",
                title="Learning curves",
                caption="Right answers about unseen objects by the number of labelled contacts, mean of hardness, "
                "roughness and protrusion, seeds pooled; 95 % over objects.",
                content=curve_chart(rows, counts),
            ),
        ),
        settings={**study_settings(config), "stage 1": f"{config.pretrain.objective}, {config.pretrain.steps} steps"},
        data=data.summary(),
    )


SMOKE = FewLabelsConfig(
    seeds=2,
    labelled=(5, 12),
    unlabelled=8,
    scenes=SMOKE_STUDY.scenes,
    encoders=EncoderTrainingConfig(steps=3, batch_size=4),
    sft=StudySFT(steps=3, batch_size=4),
    decoder=dataclasses.replace(SMOKE_STUDY.decoder, steps=2, save_every=1),
    grpo=dataclasses.replace(FewLabelsConfig().grpo, prompts=2, group=2, micro_prompts=2),
    grpo_steps=1,
    pretrain=dataclasses.replace(FewLabelsConfig().pretrain, steps=2, probe_every=2, batch_size=4),
)

EXPERIMENT = Experiment(
    name="few_labels",
    config=FewLabelsConfig(),
    scales={"smoke": SMOKE},
    run=run,
    curves={"sft": ("loss",), "decoder": ("loss",), "grpo": ("reward", "accuracy")},
    quick=("smoke",),
)
