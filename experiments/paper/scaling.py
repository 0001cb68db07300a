"""How do accuracy and OMAE of three sizes of policy depend on parameters and seconds?

    make experiment EXP=scaling [ARGS="--scale smoke|gpu"]

The same study is run with .43, 1 and 2.1 times the default's parameters, about the ratios of 3, 7 and 14 billion in the
paper's figure.  SFT and GRPO, with the published rewards and grounding, train
every size on the same scenes, questions and seeds.  The policies, and policies of the same size without touch, answer
the bench's questions about the test objects.  Learning rates and steps are those of the default size.

Cost: an hour of one core in the recorded run, with three seeds, and data and GRPO shortened to a third; the default
size shares its SFT with other experiments; `--scale smoke` under one minute.

Expected: on 2,400 objects, the default gains some five points over the smallest size, and the largest none over the
default.  A probe on touch and picture is better than every policy (`main_table`), so data and decoding, not size, limit
the answers.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Estimate, Picture, Results, RolloutExample
from experiments.core.text import bounds, number
from experiments.core.timing import interleaved
from experiments.paper import bench_scores as bench
from experiments.paper import model_sizes as sizes
from experiments.paper import presets
from experiments.paper.components import FULL
from experiments.study import paper_numbers as paper
from experiments.study.examples import rollout_examples
from experiments.study.scores import PUBLISHED, score_study, study_settings
from experiments.study.stages import StudySFT
from experiments.study.study import BLIND, SFT, SMOKE, StudyConfig
from touchr1_jax.bench.items import Ask
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.bench.scoring import REPORTED
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import ModelConfig
from touchr1_jax.models.vision import VisionConfig
from touchr1_jax.training.train_encoder import EncoderTrainingConfig

POLICIES = {FULL: "full model", SFT: "SFT", BLIND: "without touch"}
"""Policies that are drawn, and their names in the report."""

DRAWN = ("acc", "omae")
TRENDS = (*DRAWN, "mat_acc", "sfd", *sizes.CLAIMED)

DIFFERENCES = (
    ("sizes", "3, 7, 14 billion parameters", ".28, .64 and 1.3 million by default"),
    ("steps", "the same for all, not given", "the same for all"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScalingConfig:
    """The study, the sizes that replace its model, the bench's questions, and how often steps are timed.

    All sizes are trained end to end, so that one step of SFT has one cost.
    """

    study: StudyConfig = StudyConfig(
        seeds=3, model=ModelConfig(), encoders=EncoderTrainingConfig(steps=0), sft=StudySFT(steps=450)
    )
    small: ModelConfig = sizes.SMALL
    large: ModelConfig = sizes.LARGE
    quota: Quota = Quota()
    rounds: int = 12

    @property
    def sizes(self) -> dict[str, ModelConfig]:
        """Every size by its name; the middle one is the study's own."""
        return {"small": self.small, "default": self.study.model, "large": self.large}


@dataclasses.dataclass(frozen=True, kw_only=True)
class SizeResult:
    """The study of one size: rows by policy, rows of the baselines, programs to be timed, seconds of a step of GRPO.

    `asks` and `data`, the bench's questions and the sizes of the data, are the same for all.
    """

    rows: Mapping[str, Mapping[str, Estimate]]
    baselines: Mapping[str, Mapping[str, Estimate]]
    programs: sizes.TimedPrograms
    grpo_s: float
    asks: tuple[Ask, ...]
    data: Mapping[str, Any]
    examples: tuple[RolloutExample, ...]


def run(config: ScalingConfig, context: Context) -> Results:
    """Train every size, ask, time, fit lines."""
    found = {name: one_size(config, name, context) for name in context.each("sizes", config.sizes)}
    costs = measured_costs(found, config.rounds, context)
    rows = {title: {name: s.rows[policy] for name, s in found.items()} for policy, title in POLICIES.items()}
    trends = sizes.size_trends(rows, costs, TRENDS) if config.study.seeds > 1 else ()
    full, default = rows[POLICIES[FULL]], found["default"]
    return Results(
        arms=full,
        baselines={
            **{f"{name}, {POLICIES[policy]}": s.rows[policy] for policy in (SFT, BLIND) for name, s in found.items()},
            **default.baselines,
        },
        settings=study_settings(config.study),
        verdict=verdict(full, costs, trends),
        pictures=(
            Picture(
                name="scaling",
                title="Accuracy and ordinal error against size",
                caption="Means over seeds with 95 % intervals over objects; small dots are single seeds. Accuracy over "
                "hardness, roughness and protrusion. Seconds of both stages of a seed, by the time of a step.",
                content=sizes.size_chart(rows, costs, config.study, DRAWN),
            ),
        ),
        tables=(
            sizes.size_table(config.sizes, costs, config.study),
            *((sizes.trend_table(trends),) if trends else ()),
            bench.comparison_table(
                "Comparison with the paper's sizes",
                full,
                {f"Touch-R1-{n}B": paper.MAIN["Touch-R1-7B"] if n == 7 else None for n in paper.BACKBONES},
                "The paper draws 3 and 14 billion as bars without numbers, and leaves OMAE out; there is no Qwen2.5-VL "
                "of 14 billion.",
            ),
            bench.question_table(default.asks),
            paper.differences_table((*presets.DIFFERENCES[:4], *DIFFERENCES)),
        ),
        data={**default.data, "questions": len(default.asks)},
        curves=presets.CURVES,
        examples=found["large"].examples,
    )


def one_size(config: ScalingConfig, name: str, context: Context) -> SizeResult:
    """Train and ask one size; the study itself, which keeps its clips in memory, is dropped."""
    study, timing = sizes.study_of_size(dataclasses.replace(config.study, model=config.sizes[name]), name, context)
    asks, scored = bench.bench_questions(study.data, config.quota, context), score_study(study)

    def row(policy: str) -> dict[str, Estimate]:
        single = {m: scored.estimates[policy][m] for m in ("acc", "parse_rate", "middle_rate", "reward")}
        return single | bench.bench_row(asks, bench.bench_answers(study.data, asks, study.answers[policy]))

    return SizeResult(
        rows={policy: row(policy) for policy in POLICIES},
        baselines={title: line for title, line in scored.baselines.items() if title not in POLICIES},
        programs=sizes.timed_programs(study),
        grpo_s=sizes.grpo_step_s(config.study, timing),
        asks=asks,
        data=study.data.summary(),
        examples=tuple(dataclasses.replace(e, arm=name) for e in rollout_examples(study, FULL, PUBLISHED)),
    )


def measured_costs(found: Mapping[str, SizeResult], rounds: int, context: Context) -> dict[str, sizes.SizeCost]:
    """Parameters and seconds of every size, each program in turns with those of the others."""
    calls = {f"{name}/{call}": getattr(s.programs, call) for name, s in found.items() for call in ("train", "answer")}
    with context.timed("timing"):
        measured = interleaved(calls, context.rounds("timing sizes", rounds))
    seconds = {name: float(np.median(s)) for name, s in measured.items()}
    return {
        name: sizes.SizeCost(
            parameters=s.programs.parameters,
            sft_s=seconds[f"{name}/train"],
            grpo_s=s.grpo_s,
            question_s=seconds[f"{name}/answer"] / s.programs.questions,
        )
        for name, s in found.items()
    }


def verdict(
    full: Mapping[str, Mapping[str, Estimate]], costs: Mapping[str, sizes.SizeCost], trends: tuple[sizes.SizeTrend, ...]
) -> tuple[str, ...]:
    """The sizes in one sentence, the change for a doubling, and which of the paper's claims come out."""
    shares = ", ".join(
        f"{row['acc'].mean:.1f} % with {costs[name].parameters / 1e6:.2f} million parameters"
        for name, row in full.items()
    )
    times = costs["large"].sft_s / costs["small"].sft_s
    sentences = [
        f"The full model answers {shares} right; an SFT step of the largest takes {times:.1f} times as long as one of "
        "the smallest."
    ]
    by = {t.metric: t for t in trends if t.policy == POLICIES[FULL]}
    for metric in DRAWN:
        if metric in by:
            slope = by[metric].slope
            sentences.append(
                f"A doubling of the parameters changes its {REPORTED[metric].title} by {number(slope.mean, '+.2g')} "
                f"{bounds(slope.low, slope.high, '.2g')} ({by[metric].larger_is})."
            )
    claimed = [by[metric] for metric in sizes.CLAIMED if metric in by]
    if claimed:
        count = sum(trend.larger_is == "better" for trend in claimed)
        sentences.append(
            f"Of the {len(claimed)} metrics that grow clearly in the paper, {count} grow significantly here."
        )
    return tuple(sentences)


def _narrow(width: int) -> ModelConfig:
    """Towers of one layer on quarter pictures: three of them compile in half a minute."""
    return ModelConfig(
        tactile=TactileViTConfig(sensors=0, width=width, num_layers=1, num_heads=2),
        vision=VisionConfig(width=16, num_layers=1),
        decoder=DecoderConfig(vocab_size=0, hidden_size=width, num_layers=1, num_heads=2, intermediate_size=2 * width),
        image_px=56,
    )


EXPERIMENT = presets.paper_experiment(
    "scaling",
    ScalingConfig(),
    {
        "smoke": ScalingConfig(
            study=dataclasses.replace(
                SMOKE,
                model=_narrow(24),
                encoders=EncoderTrainingConfig(steps=0),
                sft=StudySFT(steps=12, batch_size=8),
            ),
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
