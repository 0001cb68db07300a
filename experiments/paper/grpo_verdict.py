"""Does GRPO make a tactile policy better than SFT alone?

    make experiment EXP=grpo_verdict

For each seed, all arms start from the same policy, trained by both phases of SFT.  They train on the same encoded
contacts and on all properties; half of the questions use only some of the sensors, and the objective includes the
likelihood of the verified answers (anchor).  Arms differ in the conclusion (sampled, or enumerated with its exact
gradient), the prompts of a step (8 or 64) and the algorithm (DAPO, GSPO, CISPO, leave-one-out).  The control continues
SFT of the decoder for as many seconds.  The learning rate of each arm is chosen on validation objects, with the first
seed.  All policies are scored once, after their last step, on objects of another scene seed.

Cost: some 80 minutes of one core, a third of it compiling; `--scale smoke` under two minutes.

Expected: with a label for every object, no arm is better than the control in accuracy or error, and most lose one or
two points on material.  Without an anchor, GRPO loses most in the agreement of single sensors.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from experiments.core.context import Context
from experiments.core.loops import STEPPING
from experiments.core.results import Cell, Comparison, Estimate, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.core.text import bounds, interval, number
from experiments.study.answers import answers_path, load_answers, save_answers, share_right
from experiments.study.dataset import Dataset
from experiments.study.estimates import SeedScores, compare_rows, estimate_rows
from experiments.study.scores import score, study_settings, trained_preset
from experiments.study.seed import StudySeed, Validation, supervised
from experiments.study.stages import (
    EncodedContacts,
    GRPOArm,
    Weights,
    encode_rows,
    gather_evidence,
    make_arm,
    probe_features,
)
from experiments.study.study import CONTINUED, SFT, Study, StudyConfig, open_study_data
from experiments.study.study import SMOKE as SMOKE_STUDY
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import TouchPolicy, build_policy, check_model, with_lora
from touchr1_jax.rl.config import AnyAlgorithm, Cispo, Dapo, GRPOConfig, Gspo, Norm, Paper, Rloo
from touchr1_jax.training.evaluation import Evaluation, evaluate_policy
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.types import Params

Preset = Literal["dapo", "gspo", "cispo", "rloo"]
PRESETS: Mapping[Preset, type[AnyAlgorithm]] = {"dapo": Dapo, "gspo": Gspo, "cispo": Cispo, "rloo": Rloo}

NO_SIGMA: tuple[Preset, ...] = ("rloo",)
"""Presets whose rewards are not divided by their spread, enumerated or not."""

COMPARED = ("acc", "omae", "mat_acc", "csc")
"""Metrics of the verdict: ordinal accuracy and error, material, agreement of right single sensors."""

REWARDS: Weights = {"exact": 0.9, "format": 0.1}


@dataclasses.dataclass(frozen=True, kw_only=True)
class GrpoVerdictConfig(StudyConfig):
    """A study with a rate for each arm, and the objects that are scored once."""

    grpo: GRPOConfig = GRPOConfig(prompts=8, group=4, micro_prompts=8, inverse_draws=True)
    """Sizes that all arms share; prompts, algorithm and rate are the arms'."""
    presets: tuple[Preset, ...] = ("dapo", "gspo", "cispo", "rloo")
    prompts: tuple[int, ...] = (8, 64)
    """Prompts of a step."""
    steps: tuple[int, ...] = (100, 20)
    """Steps of the arms with these prompts: equal seconds."""
    lr_scales: tuple[float, ...] = (100.0, 400.0)
    """Factors on the paper's learning rate, of which validation objects choose one for each arm."""
    continued_steps: int = 70
    """Steps of the control, as many as take an arm's seconds; the report shows both."""
    samples: int = 0
    fresh: SceneConfig = SceneConfig(objects=480, sites=1, seed=4242)
    """Generated objects that are scored; with recordings the test objects are."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.prompts) != len(self.steps) or not self.prompts:
            raise ValueError(f"steps is {self.steps}: must hold one count for each of prompts {self.prompts}; set both")
        if not self.lr_scales or not self.presets:
            raise ValueError(f"lr_scales {self.lr_scales} and presets {self.presets} must not be empty; name some")
        dataclasses.replace(self.grpo, algorithm=algorithm_of("dapo", exact=True))  # half of the arms enumerate levels


@dataclasses.dataclass(frozen=True, kw_only=True)
class StartedSeed(StudySeed):
    """A seed after both phases of SFT: its policy, and the encoded contacts to train, choose and score on."""

    config: GrpoVerdictConfig
    params: Params
    train: EncodedContacts
    held_out: Validation
    fresh: Features


def run(config: GrpoVerdictConfig, context: Context) -> Results:
    """Train all arms, choose their rates, score once."""
    check_model(config.model, SENSORS)
    data = open_study_data(config, context)
    fresh, rows = data, data.parts["test"]  # of recordings; of generated objects others, all of them
    if config.data == "generated":
        fresh = open_study_data(dataclasses.replace(config, scenes=config.fresh), context)
        rows = np.arange(len(fresh.store))
    policy = with_lora(build_policy(config.model, data.clip.sensors), config.lora)
    probed = probe_features(data, context)
    study = Study(config=config, data=fresh, policy=policy, probed=probed, prior=data.prior(), arms={}, answers={})
    evidence = gather_evidence(data, probed, config.probe, context)
    made: dict[str, Any] = {"config": config, "data": data, "policy": policy, "evidence": evidence, "share": True}
    arms = made_arms(config, policy, study.prior)
    answers: dict[str, list[Evaluation]] = {name: [] for name in (SFT, CONTINUED, *arms)}
    rates: dict[str, float] = {}
    for seed in context.each("seeds", range(config.seeds)):
        started = start_seed(StudySeed(**made, context=context, seed=seed), fresh, rows)
        if not rates:
            rates = {name: chosen_rate(started, name, by_rate) for name, by_rate in arms.items()}
        for name, seeds in answers.items():
            train = functools.partial(train_policy, started, name, arms, rates)
            seeds.append(asked(started, name, train, fresh.label[rows]))
    scored = {name: [score(study, one) for one in seeds] for name, seeds in answers.items()}
    return report(config, context, scored, fresh.object_ids[rows][answers[SFT][0].contact], rates, fresh)


def made_arms(config: GrpoVerdictConfig, policy: TouchPolicy, prior: np.ndarray) -> dict[str, dict[float, GRPOArm]]:
    """Every arm by its name, at every rate."""
    found: dict[str, dict[float, GRPOArm]] = {}
    for exact in (False, True):
        for preset in config.presets:
            for prompts, steps in zip(config.prompts, config.steps, strict=True):
                name = f"{'enumerated' if exact else 'sampled'}-{preset}-{prompts}"
                sizes: dict[str, Any] = {"prompts": prompts, "micro_prompts": min(prompts, config.grpo.micro_prompts)}
                sizes["algorithm"] = config.algorithm(algorithm_of(preset, exact=exact))
                found[name] = {}
                for rate in config.lr_scales:
                    grpo = dataclasses.replace(config.grpo, lr_scale=rate, **sizes)
                    loop = LoopConfig(steps=steps, save_every=config.grpo_save_every)
                    found[name][rate] = make_arm(policy, REWARDS, prior, grpo, loop)
    return found


def algorithm_of(preset: Preset, *, exact: bool) -> AnyAlgorithm:
    """The preset, with an enumerated conclusion where `exact`: then no group is degenerate and none is drawn twice."""
    if not exact:
        return PRESETS[preset]()
    return PRESETS[preset](enumerated=Norm.NONE if preset in NO_SIGMA else Norm.STD, candidates=1)


def start_seed(of: StudySeed, fresh: Dataset, rows: np.ndarray) -> StartedSeed:
    """SFT in both phases, from the cache where a study made it, and the contacts encoded by it."""
    params = supervised(of)
    train, validation = of.contacts(params), of.validation(params)
    params = of.run_decoder(of.config.decoder, f"decoder/{SFT}", train, validation, params)
    scored = encode_rows(of.policy, params, fresh, rows, of.context)
    return of.extended(StartedSeed, params=params, train=train, held_out=validation, fresh=scored)


def chosen_rate(started: StartedSeed, name: str, by_rate: Mapping[float, GRPOArm]) -> float:
    """The rate of an arm with the most right answers about validation objects, to questions about all properties."""
    if len(by_rate) == 1:
        return next(iter(by_rate))

    def right(rate: float) -> float:
        params = reinforced(started, name, rate, by_rate[rate])
        return share_right(evaluate_policy(started.policy, params, *started.held_out, alone=False))

    by = started.context.once(f"rates/{name}", lambda: {str(rate): right(rate) for rate in by_rate})
    return max(by_rate, key=lambda rate: by[str(rate)])


def reinforced(started: StartedSeed, name: str, rate: float, arm: GRPOArm) -> Params:
    """An arm's policy at a rate, trained once in a run."""
    return started.run_grpo(arm, f"grpo/{name}-{rate:g}", started.train, started.params)


def train_policy(
    started: StartedSeed, name: str, arms: Mapping[str, Mapping[float, GRPOArm]], rates: Mapping[str, float]
) -> Params:
    """The policy of a row: SFT, the control, or an arm at its chosen rate."""
    if name == SFT:
        return started.params
    if name != CONTINUED:
        return reinforced(started, name, rates[name], arms[name][rates[name]])
    config = started.config
    longer = dataclasses.replace(config.continued, steps=config.continued_steps)
    return started.continued(longer, started.train, None, started.params)  # its last checkpoint, as of the arms


def asked(started: StartedSeed, name: str, train: Any, label: np.ndarray) -> Evaluation:
    """Answers of a policy about the fresh objects, kept in `answers/NAME-SEED.npz` of the run."""
    path = answers_path(started.context, name, started.seed)
    if not path.exists():
        params = train()
        with started.context.progress_callback(f"asking {name}") as progress:
            save_answers(path, evaluate_policy(started.policy, params, started.fresh, label, progress=progress))
    return load_answers(path)


def report(
    config: GrpoVerdictConfig,
    context: Context,
    scored: Mapping[str, SeedScores],
    objects: np.ndarray,
    rates: Mapping[str, float],
    fresh: Dataset,
) -> Results:
    """One short table with paired intervals, and a verdict on the claim."""
    rows, others = estimate_rows(scored, objects), [name for name in scored if name != CONTINUED]
    comparisons = [c for name in others for c in compare_rows(name, CONTINUED, COMPARED, scored, objects)]
    return Results(
        verdict=verdict(comparisons, list(rates)),
        arms=rows,
        comparisons=tuple(comparisons),
        tables=(verdict_table(config, context, rows, comparisons, rates, objects),),
        settings=study_settings(config)
        | trained_by(config)
        | {"rewards": ", ".join(f"{n} {w:g}" for n, w in REWARDS.items())},
        data=fresh.summary(),
    )


def trained_by(config: GrpoVerdictConfig) -> dict[str, str]:
    """Presets of the arms with what they share, and the rates of which validation objects choose."""
    changes = trained_preset(config, Paper()).partition(" with ")[1:]
    rates = " or ".join(f"{rate:g}" for rate in config.lr_scales)
    return {"preset": "".join((", ".join(config.presets), *changes)), "lr_scale": rates}


def sure(comparisons: Sequence[Comparison], arm: str, metric: str) -> int:
    """1 where an arm is better than the control beyond both kinds of interval, −1 where it is worse, else 0."""
    found = [c for c in comparisons if (c.arm, c.metric) == (arm, metric)]
    sign = -1 if metric == "omae" else 1
    if found and all(c.low > 0 for c in found):
        return sign
    return -sign if found and all(c.high < 0 for c in found) else 0


def verdict(comparisons: Sequence[Comparison], arms: Sequence[str]) -> tuple[str, ...]:
    """Numbers of arms that beat the control and that lose to it, and the answer to the paper's claim."""
    better = [arm for arm in arms if sure(comparisons, arm, "acc") > 0 or sure(comparisons, arm, "omae") > 0]
    worse = [arm for arm in arms if any(sure(comparisons, arm, metric) < 0 for metric in COMPARED)]
    clean = [arm for arm in better if arm not in worse]
    claim = "holds here for " + ", ".join(clean) if clean else "does not hold here"
    differences = [c.difference for c in comparisons if c.metric == "acc" and c.over == "objects" and c.arm in arms]
    return (
        f"The claim that reinforcement improves a tactile policy {claim}: of {len(arms)} arms {len(better)} have a "
        f"higher accuracy or a lower error than SFT continued for the same time (95 % intervals over objects and over "
        f"seeds exclude 0), and {len(worse)} are worse in accuracy, error, material or agreement of single sensors.",
        f"The differences in accuracy lie between {number(min(differences), '+.1f')} and "
        f"{number(max(differences), '+.1f')} points.",
    )


def verdict_table(
    config: GrpoVerdictConfig,
    context: Context,
    rows: Mapping[str, Mapping[str, Estimate]],
    comparisons: Sequence[Comparison],
    rates: Mapping[str, float],
    objects: np.ndarray,
) -> Table:
    """Every policy with its differences from the control, its rate and its seconds."""
    by = {(c.arm, c.metric, c.over): c for c in comparisons}
    timing, lines = context.timing(), list[dict[str, Cell]]()
    for name, row in rows.items():
        line: dict[str, Cell] = {"policy": name, "accuracy": interval(row["acc"], ".1f"), "OMAE": row["omae"].mean}
        line |= {title: row[key].mean for key, title in (("mat_acc", "material"), ("csc", "CSC")) if key in row}
        for over in ("objects", "seeds"):
            found = by.get((name, "acc", over))
            if found is not None:
                mean = number(found.difference, "+.1f")
                line[f"accuracy over {over}"] = f"{mean} {bounds(found.low, found.high, '.1f')}"
        stage = f"decoder/{name}" if name in (SFT, CONTINUED) else f"grpo/{name}-{rates[name]:g}"
        seconds = [timing[key] for seed in range(config.seeds) if (key := f"{STEPPING}/{stage}/{seed}") in timing]
        line["rate"] = rates.get(name)
        line["seconds"] = float(np.mean(seconds)) if seconds else None
        lines.append(line)
    differences = [
        f"accuracy over {over}" for over in ("objects", "seeds") if any(f"accuracy over {over}" in x for x in lines)
    ]
    return named_table(
        f"Policies on {len(np.unique(objects))} objects that nothing was chosen on",
        lines,
        formats={"OMAE": ".3f", "material": ".1f", "CSC": ".1f", "rate": "g", "seconds": ".0f"},
        units={**dict.fromkeys(("accuracy", "material", "CSC"), "%"), "OMAE": "levels", "seconds": "s"}
        | dict.fromkeys(differences, "points"),
        meanings={"rate": "factor on the paper's 1e-6, chosen on validation objects", "seconds": "of the last stage"}
        | dict.fromkeys(differences, f"minus {CONTINUED}, 95 %"),
        note="Arms are named by conclusion, algorithm and prompts a step.",
    )


SMOKE = GrpoVerdictConfig(
    **{
        f.name: getattr(SMOKE_STUDY, f.name)
        for f in dataclasses.fields(StudyConfig)
        if f.name not in ("grpo", "samples")
    },
    grpo=GRPOConfig(prompts=2, group=2, micro_prompts=2, inverse_draws=True),
    presets=("rloo",),
    prompts=(2, 4),
    steps=(2, 1),
    continued_steps=3,
    fresh=SceneConfig(objects=60, sites=1, seed=4242),
)

EXPERIMENT = Experiment(
    name="grpo_verdict",
    config=GrpoVerdictConfig(),
    scales={"smoke": SMOKE},
    run=run,
    curves={"sft": ("loss",), "grpo": ("reward", "accuracy", "entropy")},
    quick=("smoke",),
)
