"""With few labels, what helps most: SFT, GRPO, touch without labels, or pretraining?

    make experiment EXP=few_labels

Policies are trained with 10, 30, 100, 300 and all labelled contacts, from a random encoder and from one that stage 1
has pretrained on the touch of all training objects (contrast between the sensors of a contact).  SFT is end to end
(`sft`), or trains the encoders with a linear head and then the decoder (`two_phases`).  GRPO starts from `two_phases`.
It trains on the labelled contacts (`grpo`), or also asks about unlabelled contacts and rewards the level on which most
single sensors agree (`agreement`) or which measured physics implies (`physics`): hardness from the slope of force over
indentation, roughness from friction force over load if a contact slides.  All policies are scored once on test
objects.

Cost: 3.6 hours in the recorded run; `--scale smoke` under two minutes.

Expected: two phases gain 9 points over SFT end to end with 10 labels and 16 to 31 with more; GRPO on the same labels
gains nothing.  Measured hardness, right in 61 % of the contacts that it judges, gains 3 points with 10 labels, 1 with
30 and nothing from 300 on, where the policy is right as often; agreement of sensors never gains.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from experiments.core.artifacts import write_bytes
from experiments.core.charts import Panel, draw, estimates
from experiments.core.context import Context
from experiments.core.results import Cell, Comparison, Estimate, Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval, number
from experiments.encoder.pretrain import pretrain
from experiments.paper.label_free import agreed_levels, measured_levels
from experiments.study.answers import answers_path, load_answers, save_answers
from experiments.study.dataset import Dataset
from experiments.study.estimates import SeedScores, compare_rows, estimate_rows
from experiments.study.scores import score, study_settings
from experiments.study.seed import StudySeed, supervised
from experiments.study.stages import (
    EncodedContacts,
    GRPOArm,
    StudySFT,
    Weights,
    gather_evidence,
    make_arm,
    noise_bank,
    probe_features,
)
from experiments.study.study import MODEL, Study, StudyConfig, open_study_data
from experiments.study.study import SMOKE as SMOKE_STUDY
from experiments.study.training import DECODER, starting_model
from sensors_io.schema import SENSORS
from touchr1_jax.models.policy import Features
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

Method = Literal["sft", "two_phases", "grpo", "agreement", "physics"]
METHODS: tuple[Method, ...] = ("sft", "two_phases", "grpo", "agreement", "physics")

RANDOM, PRETRAINED = "random", "pretrained"  # encoders that SFT starts from

COMPARED = ("acc", "omae", "mat_acc")


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
    pretrain: PretrainConfig = PretrainConfig(encoder=MODEL.tactile, objective="contrast", steps=300, probe_every=300)
    """Stage 1 of the studies' encoder on the touch of all training objects, by the objective that gained most in
    `stage_one`."""

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
class LabelledSet(StudySeed):
    """One seed's training on some labelled contacts, the part `sft` of its data; `grpo` are those without labels.

    `tactile` are parameters of the pretrained encoder, `measured` the levels that measured physics implies, int
    [contact, A], −1 where it implies none; `name` is that of the set in stages and files.
    """

    config: FewLabelsConfig
    tactile: Params | None
    measured: np.ndarray
    name: str

    def answers(self) -> dict[Method, Evaluation]:
        """Answers of every method about the test contacts, kept in the run."""
        paths = {method: self._path(method) for method in METHODS}
        if not all(path.exists() for path in paths.values()):
            self._train()
        return {method: load_answers(path) for method, path in paths.items()}

    def _train(self) -> None:
        config, tactile = self.config, {} if self.tactile is None else {"tactile": self.tactile}
        whole = self.run_sft(config.sft, f"sft/{self.name}", tactile)
        self._keep("sft", whole, self.encode(whole, "test"))
        phases = dataclasses.replace(config, sft=dataclasses.replace(config.sft, steps=0))
        start = supervised(dataclasses.replace(self, config=phases), tactile=self.tactile, name=self.name)
        test, validation, (known, free) = self.encode(start, "test"), self.validation(start), self._contacts(start)
        longer = self.run_decoder(config.decoder, f"decoder/{self.name}", known, validation, start)
        self._keep("two_phases", longer, test)
        implied = {"agreement": self._agreed(longer, free), "physics": self.measured[self.data.parts["grpo"]]}
        contacts = {"grpo": known, **{m: self._implied(m, known, free, level) for m, level in implied.items()}}
        arm = arm_of(
            self.policy,
            dataclasses.replace(config.grpo, algorithm=config.algorithm(config.grpo.algorithm)),
            config.grpo_loop,
        )
        for method, of in contacts.items():
            self._keep(method, self.run_grpo(arm, f"grpo/{method}-{self.name}", of, longer), test)

    def _contacts(self, params: Params) -> tuple[EncodedContacts, EncodedContacts]:
        """The labelled contacts, and those without labels, whose levels are hidden."""
        data = self.data
        noise = noise_bank(self.policy, params, data, seed=self.seed, contacts=self.config.noise_contacts)
        found = []
        for part, shown in (("sft", True), ("grpo", False)):
            label = data.labels(part) if shown else np.full_like(data.labels(part), -1)
            of: dict[str, Any] = {"label": label, "truth": label, "noise": noise, "full_share": FULL_SHARE}
            evidence = self.evidence[data.parts[part]]
            found.append(EncodedContacts(features=self.encode(params, part), evidence=evidence, **of))
        return found[0], found[1]

    def _agreed(self, params: Params, free: EncodedContacts) -> np.ndarray:
        ask_all = np.zeros_like(free.label)  # a label of 0 has every question asked; nothing else reads it
        return agreed_levels(evaluate_policy(self.policy, params, free.features, ask_all), free.label)

    def _implied(
        self, method: str, known: EncodedContacts, free: EncodedContacts, level: np.ndarray
    ) -> EncodedContacts:
        """Both kinds of contacts, those without labels with the levels that a label-free reward pays."""
        right, asked = level == self.data.labels("grpo"), level >= 0
        found = [100 * float(asked.mean()), 100 * float(right[asked].mean()) if asked.any() else None]
        self.context.save_stage(f"implied/{method}-{self.name}/{self.seed}", found)
        if not asked.any():
            return known
        label = np.concatenate([known.label, level])
        join = lambda a, b: np.concatenate([np.asarray(a), np.asarray(b)])
        features: Features = jax.tree.map(join, known.features, free.features)
        evidence = np.concatenate([known.evidence, free.evidence])
        return dataclasses.replace(known, features=features, label=label, truth=label, evidence=evidence)

    def _keep(self, method: str, params: Params, test: Features) -> None:
        if not self._path(method).exists():
            label = self.data.labels("test")
            save_answers(self._path(method), evaluate_policy(self.policy, params, test, label, alone=False))

    def _path(self, method: str) -> Path:
        return answers_path(self.context, f"{method}-{self.name}", self.seed)


@functools.cache
def arm_of(policy: TouchPolicy, grpo: GRPOConfig, loop: LoopConfig) -> GRPOArm:
    """The arm of all sets, so that its step is compiled once; its rewards need no shares of labels."""
    return make_arm(policy, REWARDS, uniform_prior(policy.levels), grpo, loop)


def run(config: FewLabelsConfig, context: Context) -> Results:
    """Pretrain once, train every set, compare."""
    check_model(config.model, SENSORS)
    data = open_study_data(config, context)
    train = data.training
    model, tactile = starting_model(config.model, pretrained_encoder(config, data, train, context), data.clip.sensors)
    policy, probed = with_lora(build_policy(model, data.clip.sensors), config.lora), probe_features(data, context)
    levels = np.array(context.once("measured", lambda: measured_levels(data.store, train).tolist()))
    made: dict[str, Any] = {"config": config, "context": context, "policy": policy, "measured": levels, "share": True}
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
                of_set = LabelledSet(**made, data=few, evidence=evidence, tactile=start, seed=seed, name=name)
                for method, evaluation in of_set.answers().items():
                    answers.setdefault(f"{method}-{name}", []).append(evaluation)
    study = Study(config=config, data=data, policy=policy, probed=probed, prior=data.prior(), arms={}, answers={})
    scored = {name: [score(study, one) for one in seeds] for name, seeds in answers.items()}
    objects = data.object_ids[data.parts["test"]][next(iter(answers.values()))[0].contact]
    counts = list(dict.fromkeys(min(count, len(train)) for count in config.labelled))
    return report(config, data, scored, objects, counts, implied_table(config, context, counts))


def with_parts(data: Dataset, labelled: np.ndarray, unlabelled: np.ndarray) -> Dataset:
    """The data with other contacts in the parts that are trained on."""
    return dataclasses.replace(data, parts={**data.parts, "sft": labelled, "grpo": unlabelled})


def pretrained_encoder(config: FewLabelsConfig, data: Dataset, rows: np.ndarray, context: Context) -> Path:
    """File of the encoder after stage 1, which a run that goes on writes again, from its own checkpoint."""
    path = context.directory / "encoder.npz"
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
            mean = float(np.mean(right)) if right else None
            lines.append({"set": f"{method}-{name}", "implied": share, "right": mean})
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
    scored: Mapping[str, SeedScores],
    objects: np.ndarray,
    counts: Sequence[int],
    implied: Table,
) -> Results:
    """Learning curves, their differences, and where each method pays."""
    rows = estimate_rows(scored, objects)
    pairs = [pair for count in counts for pair in compared_pairs(count)]
    comparisons = [c for pair in pairs for c in compare_rows(*pair, COMPARED, scored, objects)]
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


def compared_pairs(count: int) -> list[tuple[str, str]]:
    """Policies that are compared: each method with the one that it starts from, and pretrained with random encoders."""
    before: Mapping[Method, Method] = {"two_phases": "sft", "grpo": "two_phases"}
    before = {**before, "agreement": "two_phases", "physics": "two_phases"}
    of_methods = [(f"{a}-{count}-{e}", f"{b}-{count}-{e}") for e in (RANDOM, PRETRAINED) for a, b in before.items()]
    of_encoders = [(f"{m}-{count}-{PRETRAINED}", f"{m}-{count}-{RANDOM}") for m in ("sft", "two_phases")]
    return of_methods + of_encoders


def verdict(comparisons: Sequence[Comparison], counts: Sequence[int]) -> tuple[str, ...]:
    """For each step of training, numbers of labels at which it pays, and at which it costs, beyond both intervals."""
    steps = {
        "SFT in two phases": ("two_phases", "sft", None),
        "GRPO on labelled contacts": ("grpo", "two_phases", None),
        "agreement of sensors without labels": ("agreement", "two_phases", None),
        "measured physics without labels": ("physics", "two_phases", None),
        "stage 1": ("two_phases", "two_phases", PRETRAINED),
    }
    sentences = []
    for title, (a, b, encoder) in steps.items():
        pays, costs = [], []
        for count in counts:
            for start in (RANDOM, PRETRAINED) if encoder is None else (encoder,):
                of = f"{a}-{count}-{start}", f"{b}-{count}-{start if encoder is None else RANDOM}"
                found = [c for c in comparisons if (c.arm, c.against) == of and c.metric == "acc"]
                label = f"{count} labels" + (f" ({start} encoder)" if encoder is None else "")
                if found and all(c.low > 0 for c in found):
                    pays.append(f"{label} {number(found[0].difference, '+.1f')}")
                if found and all(c.high < 0 for c in found):
                    costs.append(f"{label} {number(found[0].difference, '+.1f')}")
        sentences.append(
            f"{title[0].upper()}{title[1:]} raises accuracy significantly at {', '.join(pays) or 'no number of labels'}"
            f" and lowers it at {', '.join(costs) or 'none'}."
        )
    return tuple(sentences)


def curve_table(
    rows: Mapping[str, Mapping[str, Estimate]], comparisons: Sequence[Comparison], counts: Sequence[int]
) -> Table:
    """Every policy with its difference from the one that it starts from."""
    lines: list[dict[str, Cell]] = []
    for encoder in (RANDOM, PRETRAINED):
        for count in counts:
            for method in METHODS:
                name = f"{method}-{count}-{encoder}"
                row = rows[name]
                line: dict[str, Cell] = {"policy": name, "accuracy": interval(row["acc"], ".1f")}
                line |= {"OMAE": row["omae"].mean, "material": row["mat_acc"].mean if "mat_acc" in row else None}
                for c in comparisons:
                    same = c.arm == name and c.metric == "acc" and c.against.endswith(f"-{encoder}")
                    if same and c.over == "objects":
                        line["gain"] = f"{number(c.difference, '+.1f')} {bounds(c.low, c.high, '.1f')}"
                lines.append(line)
    return named_table(
        "Policies by method, labelled contacts and encoder",
        lines,
        formats={"OMAE": ".3f", "material": ".1f"},
        units={"accuracy": "%", "OMAE": "levels", "material": "%", "gain": "points"},
        meanings={"gain": "accuracy minus that of the policy that training starts from, 95 % over objects"},
        note="sft is end to end; GRPO, agreement and physics start from two_phases, which is the best of its decoder's "
        "checkpoints on all validation objects, labels that are in no count. All others are their last checkpoint.",
    )


def curve_chart(rows: Mapping[str, Mapping[str, Estimate]], counts: Sequence[int]) -> bytes:
    """Draw accuracy over the number of labels, a panel for each encoder."""
    panels = []
    for encoder in (RANDOM, PRETRAINED):
        series = []
        for i, method in enumerate(METHODS):
            found = [rows[f"{method}-{count}-{encoder}"]["acc"] for count in counts]
            series.append(estimates(method, found, at=np.arange(len(counts)), shift=0.06 * (i - 2)))
        ticks = {float(i): str(count) for i, count in enumerate(counts)}
        panels.append(
            Panel(series, title=f"{encoder} encoder", x_label="labelled contacts", y_label="right (%)", x_ticks=ticks)
        )
    return draw(panels, size=(10.0, 4.0))


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
