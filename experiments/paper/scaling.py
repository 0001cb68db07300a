"""What does a larger policy gain: accuracy and ordinal error of three sizes against parameters and seconds?

    make experiment EXP=scaling [ARGS="--scale smoke|gpu"]

The same study three times: a tactile encoder, picture tower and decoder of .43, 1 and 2.1 times the default's
parameters, as 3 and 14 billion are of 7 in the paper's figure.  Every size is trained by SFT and by GRPO with the
published rewards and grounding, on the same scenes, questions and seeds, and answers the bench's questions about the
test objects; beside it a policy of its size without touch.  Learning rates and steps are the default size's.

Cost: some 45 minutes of one core with three seeds and their data, GRPO shortened to a third; the default size's SFT is
shared with other experiments; `--scale smoke` under one minute.

Expected: on 2,400 objects some five points from the smallest to the default, and nothing beyond: the encoder's probe
stands above every policy here (`main_table`), so that data and decoding, not size, hold answers back.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from experiments.bench.draw import Quota
from experiments.core.context import Context
from experiments.core.results import Estimate, Picture, Results, RolloutExample
from experiments.core.timing import interleaved
from experiments.paper import presets
from experiments.paper.experiment import bench_experiment
from experiments.paper.growth import (
    CLAIMED,
    Growth,
    Rows,
    beside_sizes,
    growth_chart,
    growth_table,
    growths,
    size_table,
)
from experiments.paper.ladder_arms import FULL
from experiments.paper.ladder_tables import DIFFERS
from experiments.paper.outcome import CURVES
from experiments.paper.paper_comparison import tier_table
from experiments.paper.questions import answered, questions
from experiments.paper.rows import bench_row
from experiments.paper.sizes import CALLS, LARGE, SMALL, Calls, Cost, calls_of, grpo_step_s, study_apart
from experiments.study.assembly import ModelConfig
from experiments.study.examples import rollout_examples
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, score_study, study_settings
from experiments.study.study import BLIND, SFT, SMOKE, StudyConfig
from touchr1_jax.bench.items import Ask
from touchr1_jax.bench.scoring import REPORTED
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.vision import VisionConfig

POLICIES = {FULL: "full model", SFT: "SFT", BLIND: "without touch"}
"""Who is drawn, and how the report calls it."""

DRAWN = ("acc", "omae")
LOOKED_AT = (*DRAWN, "mat_acc", "sfd", *CLAIMED)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScalingConfig:
    """The study, the sizes that take the place of its model, the bench's questions, and how often steps are timed."""

    study: StudyConfig = StudyConfig(seeds=3, grpo_steps=300)
    small: ModelConfig = SMALL
    large: ModelConfig = LARGE
    quota: Quota = Quota()
    rounds: int = 12

    @property
    def sizes(self) -> dict[str, ModelConfig]:
        """Every size by its name; the one between is the study's own."""
        return {"small": self.small, "default": self.study.model, "large": self.large}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sized:
    """What is kept of the study of one size: rows by policy, what is to be timed, seconds of a step of GRPO.

    `asks` and `data`, the bench's questions and the sizes of the data, are the same for all.
    """

    rows: Mapping[str, Mapping[str, Estimate]]
    others: Mapping[str, Mapping[str, Estimate]]
    calls: Calls
    grpo_s: float
    asks: tuple[Ask, ...]
    data: Mapping[str, Any]
    examples: tuple[RolloutExample, ...]


def run(config: ScalingConfig, context: Context) -> Results:
    """Train every size, ask, time, fit lines."""
    sized = {name: one_size(config, name, context) for name in context.each("sizes", config.sizes)}
    costs = timed(sized, config.rounds, context)
    rows: Rows = {title: {name: s.rows[policy] for name, s in sized.items()} for policy, title in POLICIES.items()}
    found = growths(rows, costs, LOOKED_AT) if config.study.seeds > 1 else ()
    full = rows[POLICIES[FULL]]
    return Results(
        arms=full,
        baselines={
            **{f"{name}, {POLICIES[policy]}": s.rows[policy] for policy in (SFT, BLIND) for name, s in sized.items()},
            **sized["default"].others,
        },
        settings=study_settings(config.study),
        verdict=verdict(full, costs, found),
        pictures=(_picture(rows, costs, config.study),),
        tables=(
            size_table({name: shape(model) for name, model in config.sizes.items()}, costs, config.study),
            *((growth_table(found),) if found else ()),
            beside_sizes(full),
            tier_table(sized["default"].asks),
            differences_table((*DIFFERS[:4], *HERE)),
        ),
        data={**sized["default"].data, "questions": len(sized["default"].asks)},
        curves=CURVES,
        examples=sized["large"].examples,
    )


HERE = (
    ("sizes", "3, 7, 14 billion parameters", ".28, .64 and 1.3 million"),
    ("steps", "the same for all, not given", "the same for all, GRPO a third of the other experiments'"),
)
"""What differs besides."""


def one_size(config: ScalingConfig, name: str, context: Context) -> Sized:
    """Train and ask one size; the study itself, which keeps its clips in memory, is not kept."""
    study, timing = study_apart(dataclasses.replace(config.study, model=config.sizes[name]), name, context)
    asks, scored = questions(study.data, config.quota, context), score_study(study)

    def row(policy: str) -> dict[str, Estimate]:
        alone = {m: scored.estimates[policy][m] for m in ("acc", "parse_rate", "middle_rate", "reward")}
        return alone | bench_row(asks, answered(study.data, asks, study.answers[policy]))

    return Sized(
        rows={policy: row(policy) for policy in POLICIES},
        others={title: line for title, line in scored.baselines.items() if title not in POLICIES},
        calls=calls_of(study),
        grpo_s=grpo_step_s(config.study, timing),
        asks=asks,
        data=study.data.summary(),
        examples=tuple(dataclasses.replace(e, arm=name) for e in rollout_examples(study, FULL, PUBLISHED)),
    )


def timed(sized: Mapping[str, Sized], rounds: int, context: Context) -> dict[str, Cost]:
    """Parameters and seconds of every size, each call in turns with those of the others."""
    calls: dict[str, Callable[[], Any]] = {
        f"{name}/{call}": s.calls.by_name[call] for name, s in sized.items() for call in CALLS
    }
    with context.timed("timing"):
        measured = interleaved(calls, context.rounds("timing sizes", rounds))
        seconds = {name: float(np.median(s)) for name, s in measured.items()}
    return {
        name: Cost(
            parameters=s.calls.parameters,
            sft_s=seconds[f"{name}/train"],
            grpo_s=s.grpo_s,
            question_s=seconds[f"{name}/answer"] / s.calls.questions,
        )
        for name, s in sized.items()
    }


def shape(model: ModelConfig) -> str:
    """Layers × width of the three towers."""
    towers = ((x.num_layers, x.width) for x in (model.tactile, model.vision))
    return ", ".join(f"{n}×{w}" for n, w in (*towers, (model.decoder.num_layers, model.decoder.hidden_size)))


def _picture(rows: Rows, costs: Mapping[str, Cost], config: StudyConfig) -> Picture:
    return Picture(
        name="scaling",
        title="Accuracy and ordinal error against size",
        caption="Means over seeds with 95 % intervals over objects; small dots are single seeds. Accuracy over "
        "hardness, roughness and protrusion. Seconds of both stages of a seed, by the time of a step.",
        content=growth_chart(rows, costs, config, DRAWN),
    )


def verdict(
    full: Mapping[str, Mapping[str, Estimate]], costs: Mapping[str, Cost], found: tuple[Growth, ...]
) -> tuple[str, ...]:
    """The sizes in one sentence, what a doubling changes, and which of the paper's claims come out."""
    told = ", ".join(
        f"{row['acc'].mean:.1f} % with {costs[name].parameters / 1e6:.2f} million parameters"
        for name, row in full.items()
    )
    times = costs["large"].sft_s / costs["small"].sft_s
    said = [f"The full model answers {told}; a step of SFT of the largest takes {times:.1f} times the smallest's."]
    by = {(g.policy, g.metric): g for g in found}
    for metric in DRAWN:
        growth = by.get((POLICIES[FULL], metric))
        if growth is not None:
            slope = growth.slope
            said.append(
                f"A doubling of the parameters changes its {REPORTED[metric].title} by {slope.mean:+.2g} "
                f"[{slope.low:.2g}, {slope.high:.2g}] ({growth.sign})."
            )
    claimed = [by[key] for m in CLAIMED if (key := (POLICIES[FULL], m)) in by]
    if claimed:
        count = sum(g.sign == "better" for g in claimed)
        said.append(f"Of the {len(claimed)} metrics that grow clearly in the paper, {count} here beyond chance.")
    return tuple(said)


def _narrow(width: int) -> ModelConfig:
    """Towers of one layer that look at quarter pictures: three of them compile in half a minute."""
    return ModelConfig(
        tactile=TactileViTConfig(sensors=0, width=width, num_layers=1, num_heads=2),
        vision=VisionConfig(width=16, num_layers=1),
        decoder=DecoderConfig(vocab_size=0, hidden_size=width, num_layers=1, num_heads=2, intermediate_size=2 * width),
        image_px=56,
    )


EXPERIMENT = bench_experiment(
    "scaling",
    ScalingConfig(),
    {
        "smoke": ScalingConfig(
            study=dataclasses.replace(SMOKE, model=_narrow(24)),
            small=_narrow(16),
            large=_narrow(32),
            quota=presets.SMALL_QUOTA,
            rounds=2,
        ),
        "gpu": ScalingConfig(study=presets.GPU, small=presets.GPU_SMALL, large=presets.GPU_LARGE),
    },
    run,
    spreads=False,
)
