"""Into which phase of SFT do seconds go best: end to end, or the decoder alone on encoded contacts?

    make experiment EXP=pareto_sft [ARGS="--scale smoke"]

For every length of the end-to-end phase a policy is trained, and from each of them the decoder alone, on schedules of
several lengths.  Every policy answers all questions about the validation objects, on which the lengths of the studies
are chosen; no test object is read.  Seconds are those of the steps themselves, without compilation.

Cost: about half an hour of one core with one seed; `--scale smoke` under two minutes.

Expected: a second in the decoder's phase brings more than a second end to end once the end-to-end loss has fallen; the
encoder's phase is still needed for the material.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.loops import STEPPING
from experiments.core.results import Cell, Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.paper.presets import CURVES
from experiments.study.stages import encode_rows, gather_evidence, probe_features, run_decoder, run_sft
from experiments.study.study import SMOKE, StudyConfig, StudySeed, open_study_data
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.models.policy import Features
from touchr1_jax.models.touch_policy import build_policy
from touchr1_jax.training.evaluation import evaluate_policy
from touchr1_jax.types import Params

Lengths = tuple[int, int]
"""Steps end to end, and of the decoder alone."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParetoSFTConfig:
    """The study, and the lengths of both phases that are tried; 0 leaves the decoder's phase out."""

    study: StudyConfig = StudyConfig(seeds=1)
    end_to_end: tuple[int, ...] = (150, 300, 600, 1200)
    decoder: tuple[int, ...] = (0, 300, 900)

    def __post_init__(self) -> None:
        for field, least in (("end_to_end", 1), ("decoder", 0)):
            lengths = getattr(self, field)
            if not lengths or min(lengths) < least:
                raise ValueError(f"{field} is {lengths}: must hold lengths of at least {least} steps; add or raise one")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseResult:
    """Means over seeds: seconds of both phases, percent of ordinal and of material answers right, and the OMAE."""

    seconds: float
    accuracy: float
    material: float
    omae: float


def run(config: ParetoSFTConfig, context: Context) -> Results:
    """Train every combination of lengths, score it on validation objects."""
    study = config.study
    data = open_study_data(study, context)
    policy = build_policy(study.model, data.clip.sensors)
    evidence = gather_evidence(data, probe_features(data, context), study.probe, context)
    scores: dict[Lengths, list[Mapping[str, float]]] = {}
    for number in context.each("seeds", range(study.seeds)):
        seed = StudySeed(config=study, data=data, policy=policy, evidence=evidence, context=context, seed=number)
        for steps in config.end_to_end:
            for length, score in seed_scores(seed, steps, config.decoder).items():
                scores.setdefault(length, []).append(score)
    found = {
        length: PhaseResult(**{name: float(np.mean([score[name] for score in of])) for name in of[0]})
        for length, of in scores.items()
    }
    return Results(
        verdict=verdict(found),
        tables=(phase_table(found),),
        pictures=(
            Picture(
                name="pareto_sft",
                title="Accuracy on validation objects over seconds of SFT",
                caption="Each line begins with the end-to-end phase alone and continues with the decoder's phase.",
                content=phase_chart(found),
            ),
        ),
        data=data.summary(),
        curves=CURVES,
    )


def seed_scores(seed: StudySeed, steps: int, lengths: tuple[int, ...]) -> dict[Lengths, Mapping[str, float]]:
    """Scores of one seed after so many steps end to end and each length of the decoder's phase."""
    config, data, context = seed.config, seed.data, seed.context

    def compute() -> list[Mapping[str, float]]:
        sft = dataclasses.replace(config.sft, steps=steps)
        stage = f"sft/{steps}/{seed.seed}"
        params = run_sft(seed.policy, data, seed.evidence, sft, context, seed=seed.seed, stage=stage)
        contacts = seed.contacts(params)
        held_out = encode_rows(seed.policy, params, data, data.parts["val"], context), data.labels("val")
        spent, found = trained_s(context, stage), list[Mapping[str, float]]()
        for length in lengths:
            more, longer = f"decoder/{steps}+{length}/{seed.seed}", params
            if length:
                phase = dataclasses.replace(config.decoder, steps=length)
                order: dict[str, Any] = {"seed": seed.seed, "stage": more}
                longer = run_decoder(seed.policy, contacts, held_out, phase, params, context, **order)
            seconds = spent + (trained_s(context, more) if length else 0.0)
            found.append({"seconds": seconds, **validation_scores(seed, longer, held_out[0])})
        return found

    of_lengths = context.once(f"scores/{steps}/{seed.seed}", compute)
    return {(steps, length): score for length, score in zip(lengths, of_lengths, strict=True)}


def trained_s(context: Context, stage: str) -> float:
    """Seconds that a stage spent in its steps."""
    return context.timing().get(f"{STEPPING}/{stage}", 0.0)


def validation_scores(seed: StudySeed, params: Params, features: Features) -> Mapping[str, float]:
    """Accuracy and OMAE of greedy answers about the validation contacts."""
    asked = evaluate_policy(seed.policy, params, features, seed.data.labels("val"), alone=False)
    n = np.arange(len(asked.contact))
    level, label = np.asarray(asked.parsed.conclude)[n, asked.attribute], asked.label[n, asked.attribute]
    ordinal = np.isin(asked.attribute, [ATTRIBUTES.index(name) for name in ORDINAL])
    distance = np.where(level < 0, 2, np.abs(level - label))
    return {
        "accuracy": 100 * float(np.mean((level == label)[ordinal])),
        "material": 100 * float(np.mean((level == label)[~ordinal])),
        "omae": float(np.mean(distance[ordinal])),
    }


def efficient(found: Mapping[Lengths, PhaseResult]) -> list[Lengths]:
    """Lengths that none beats in accuracy with as many seconds or fewer, by rising seconds."""
    kept: list[Lengths] = []
    for length in sorted(found, key=lambda x: (found[x].seconds, -found[x].accuracy)):
        if not kept or found[length].accuracy > found[kept[-1]].accuracy:
            kept.append(length)
    return kept


def phase_table(found: Mapping[Lengths, PhaseResult]) -> Table:
    """Seconds and scores of every combination."""
    best = efficient(found)
    rows: list[dict[str, Cell]] = [
        {
            "end to end": first,
            "decoder": second,
            "seconds": result.seconds,
            "accuracy": result.accuracy,
            "material": result.material,
            "OMAE": result.omae,
            "efficient": "yes" if (first, second) in best else "",
        }
        for (first, second), result in found.items()
    ]
    return named_table(
        "Steps of each phase, seconds, and scores on validation objects",
        rows,
        formats={"end to end": "d", "decoder": "d", "seconds": ".0f"}
        | {"accuracy": ".1f", "material": ".1f", "OMAE": ".3f"},
        units={"seconds": "s", "accuracy": "%", "material": "%", "OMAE": "levels"},
        meanings={"efficient": "no other is better in accuracy with as many seconds or fewer"},
    )


def phase_chart(found: Mapping[Lengths, PhaseResult]) -> bytes:
    """One line for each length of the end-to-end phase, in a panel each for accuracy and material."""
    panels = []
    for field, label in (("accuracy", "hardness, roughness, protrusion right (%)"), ("material", "material right (%)")):
        series = []
        for first in dict.fromkeys(length[0] for length in found):
            of = [result for length, result in found.items() if length[0] == first]
            x, y = [result.seconds for result in of], [getattr(result, field) for result in of]
            series.append(Series(f"{first} steps end to end", x=x, y=y, marker="o"))
        panels.append(Panel(series, x_label="seconds of training", y_label=label))
    return draw(panels, size=(8.2, 3.6))


def verdict(found: Mapping[Lengths, PhaseResult]) -> tuple[str, ...]:
    """The efficient combinations in their order."""
    told = ", ".join(
        f"{first} + {second} steps: {found[first, second].accuracy:.1f} % in {found[first, second].seconds:.0f} s"
        for first, second in efficient(found)
    )
    return (f"Efficient combinations of steps end to end and of the decoder alone: {told}.",)


EXPERIMENT = Experiment(
    name="pareto_sft",
    config=ParetoSFTConfig(),
    scales={
        "smoke": ParetoSFTConfig(study=dataclasses.replace(SMOKE, seeds=1), end_to_end=(2, 4), decoder=(0, 2)),
    },
    run=run,
    curves=CURVES,
    quick=("smoke",),
)
