"""What gains most per second: training the encoders, the decoder on encoded contacts, or both end to end?

    make experiment EXP=pareto_sft [ARGS="--scale smoke"]

The encoders are trained with a linear head, or with the decoder end to end, for several numbers of steps.  From each of
these policies, the decoder alone is trained on schedules of several lengths.  Every policy answers all questions about
the validation objects, on which the lengths of the studies are chosen; no test object is used.  Seconds exclude
compilation.

Cost: 19 minutes of one core with one seed; `--scale smoke` under two minutes.

Expected: a step with the linear head improves the encoders more than a step end to end, at a quarter of its cost;
four times as many steps gain some 3 to 4 points, up to 78.8 % after 324 seconds.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from experiments.core.charts import Panel, Series, dominated, draw
from experiments.core.context import Context
from experiments.core.loops import STEPPING
from experiments.core.results import Cell, Picture, Results, Table, named_table
from experiments.core.runner import Experiment
from experiments.paper.presets import CURVES
from experiments.study.answers import asked_label, concluded
from experiments.study.seed import StudySeed, Validation, supervised
from experiments.study.stages import gather_evidence, probe_features
from experiments.study.study import SMOKE, StudyConfig, open_study_data
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.models.touch_policy import build_policy, with_lora
from touchr1_jax.training.evaluation import evaluate_policy
from touchr1_jax.types import Params

Lengths = tuple[str, int, int]
"""How the encoders are trained, their steps, and those of the decoder alone."""

HEAD, WHOLE = "linear head", "end to end"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ParetoSFTConfig:
    """The study, and the lengths of the phases that are tried."""

    study: StudyConfig = StudyConfig(seeds=1)
    encoders: tuple[int, ...] = (500, 1000, 2000, 4000)
    end_to_end: tuple[int, ...] = (300,)
    decoder: tuple[int, ...] = (300, 900)

    def __post_init__(self) -> None:
        for field in ("encoders", "end_to_end", "decoder"):
            lengths = getattr(self, field)
            if not lengths or min(lengths) < 1:
                raise ValueError(f"{field} is {lengths}: must hold lengths of at least 1 steps; add or raise one")


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
    policy = with_lora(build_policy(study.model, data.clip.sensors), study.lora)
    evidence = gather_evidence(data, probe_features(data, context), study.probe, context)
    scores: dict[Lengths, list[Mapping[str, float]]] = {}
    for number in context.each("seeds", range(study.seeds)):
        seed = StudySeed(config=study, data=data, policy=policy, evidence=evidence, context=context, seed=number)
        for phase, lengths in ((HEAD, config.encoders), (WHOLE, config.end_to_end)):
            for steps in lengths:
                for length, score in seed_scores(seed, phase, steps, config.decoder).items():
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
                caption="A line is one training of the encoders, a point on it a length of the decoder's phase.",
                content=phase_chart(found),
            ),
        ),
        data=data.summary(),
        curves=CURVES,
    )


def seed_scores(
    seed: StudySeed, phase: str, steps: int, lengths: tuple[int, ...]
) -> dict[Lengths, Mapping[str, float]]:
    """Scores of one seed after so many steps of a phase of the encoders and each length of the decoder's phase."""
    context, name = seed.context, f"{phase.replace(' ', '_')}-{steps}"
    encoders = dataclasses.replace(seed.config.encoders, steps=steps if phase == HEAD else 0)
    sft = dataclasses.replace(seed.config.sft, steps=0 if phase == HEAD else steps)
    seed = dataclasses.replace(seed, config=dataclasses.replace(seed.config, encoders=encoders, sft=sft))

    def compute() -> list[Mapping[str, float]]:
        params = supervised(seed, name=name)
        contacts, validation = seed.contacts(params), seed.validation(params)
        spent = trained_s(context, f"{'encoders' if phase == HEAD else 'sft'}/{name}/{seed.seed}")
        found = list[Mapping[str, float]]()
        for length in lengths:
            stage, decoder = f"decoder/{name}-{length}", dataclasses.replace(seed.config.decoder, steps=length)
            longer = seed.run_decoder(decoder, stage, contacts, validation, params)
            seconds = spent + trained_s(context, f"{stage}/{seed.seed}")
            found.append({"seconds": seconds, **validation_scores(seed, longer, validation)})
        return found

    of_lengths = context.once(f"scores/{name}/{seed.seed}", compute)
    return {(phase, steps, length): score for length, score in zip(lengths, of_lengths, strict=True)}


def trained_s(context: Context, stage: str) -> float:
    """Seconds that a stage spent in its steps."""
    return context.timing().get(f"{STEPPING}/{stage}", 0.0)


def validation_scores(seed: StudySeed, params: Params, validation: Validation) -> Mapping[str, float]:
    """Accuracy and OMAE of greedy answers about the validation contacts."""
    asked = evaluate_policy(seed.policy, params, *validation, alone=False)
    level, label = concluded(asked), asked_label(asked)
    ordinal = np.isin(asked.attribute, [ATTRIBUTES.index(name) for name in ORDINAL])
    distance = np.where(level < 0, 2, np.abs(level - label))
    return {
        "accuracy": 100 * float(np.mean((level == label)[ordinal])),
        "material": 100 * float(np.mean((level == label)[~ordinal])),
        "omae": float(np.mean(distance[ordinal])),
    }


def efficient(found: Mapping[Lengths, PhaseResult]) -> list[Lengths]:
    """Lengths that no other dominates in seconds and accuracy, by rising seconds."""
    beaten = dominated([(result.seconds, -result.accuracy) for result in found.values()])
    kept = (length for length, is_beaten in zip(found, beaten, strict=True) if not is_beaten)
    return sorted(kept, key=lambda length: found[length].seconds)


def phase_table(found: Mapping[Lengths, PhaseResult]) -> Table:
    """Seconds and scores of every combination."""
    best = efficient(found)
    rows: list[dict[str, Cell]] = [
        {
            "encoders": phase,
            "their steps": first,
            "decoder": second,
            "seconds": result.seconds,
            "accuracy": result.accuracy,
            "material": result.material,
            "OMAE": result.omae,
            "efficient": "yes" if (phase, first, second) in best else "",
        }
        for (phase, first, second), result in found.items()
    ]
    return named_table(
        "Steps of each phase, seconds, and scores on validation objects",
        rows,
        formats={"their steps": "d", "decoder": "d", "seconds": ".0f"}
        | {"accuracy": ".1f", "material": ".1f", "OMAE": ".3f"},
        units={"seconds": "s", "accuracy": "%", "material": "%", "OMAE": "levels"},
        meanings={"efficient": "no other is better in accuracy with as many seconds or fewer"},
    )


def phase_chart(found: Mapping[Lengths, PhaseResult]) -> bytes:
    """One line for each length of the end-to-end phase, in a panel each for accuracy and material."""
    panels = []
    for field, label in (("accuracy", "hardness, roughness, protrusion right (%)"), ("material", "material right (%)")):
        series = []
        for phase, first in dict.fromkeys(length[:2] for length in found):
            of = [result for length, result in found.items() if length[:2] == (phase, first)]
            x, y = [result.seconds for result in of], [getattr(result, field) for result in of]
            series.append(Series(f"{first} steps, {phase}", x=x, y=y, marker="o"))
        panels.append(Panel(series, x_label="seconds of training", y_label=label, better=("lower", "higher")))
    return draw(panels, size=(8.2, 3.6))


def verdict(found: Mapping[Lengths, PhaseResult]) -> tuple[str, ...]:
    """The efficient combinations in their order."""
    listed = ", ".join(
        f"{steps} {phase} + {decoder}: {found[phase, steps, decoder].accuracy:.1f} % in "
        f"{found[phase, steps, decoder].seconds:.0f} s"
        for phase, steps, decoder in efficient(found)
    )
    return (f"Efficient combinations of steps of the encoders and of the decoder alone: {listed}.",)


EXPERIMENT = Experiment(
    name="pareto_sft",
    config=ParetoSFTConfig(),
    scales={
        "smoke": ParetoSFTConfig(
            study=dataclasses.replace(SMOKE, seeds=1), encoders=(2, 4), end_to_end=(2,), decoder=(2,)
        ),
    },
    run=run,
    curves=CURVES,
    quick=("smoke",),
)
