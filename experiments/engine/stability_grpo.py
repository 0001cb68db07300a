"""Where does reinforcement learning from touch fail, does the stable preset hold there, and does an alarm notice it?

    make experiment EXP=stability_grpo [ARGS="--scale smoke"]

Twelve known failures, each driven by one knob until the published objective, or a variant named in the table, fails.
Small policies are trained by the library's own step in a world of touch whose truth is known (see
`experiments.engine.world`): supervised on verified answers, then reinforced, ten seeds for each value of each knob.
Each failure has a criterion of its own, fixed before the runs (`experiments.engine.failures`).  The `stable` preset is
trained at the same values, and the alarms are those that either would have raised during training.  Presets, bounds and
knobs were chosen on seeds 100 to 109; seeds 0 to 9 are reported.

Cost: about 17 minutes on one core, 12 once everything is compiled; `--scale smoke` about one, most of it compilation.

Expected: every failure can be provoked, and its alarm fires during training.  `stable` should fail nowhere.
"""

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.engine.failures import PAPER, PLAIN, SCENARIOS, STABLE, FailureScenario
from experiments.engine.stability_report import (
    Alarms,
    ScenarioOutcome,
    VariantOutcome,
    alarm_table,
    counts,
    criterion_table,
    failure_picture,
    odds_table,
    requirements,
    summary_table,
    verdict,
)
from experiments.engine.world_training import FirstAlarm, GrpoVariant, TrainingBudget, VariantRuns, hyperparameters_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityGrpoConfig:
    """Training budget, seeds, failures by `codes`, and how many of a knob's values are driven, from the mildest on."""

    effort: TrainingBudget = TrainingBudget()
    seeds: int = 10
    first_seed: int = 0
    codes: tuple[str, ...] = tuple(dict.fromkeys(s.code for s in SCENARIOS))
    most_values: int = 5
    margins: tuple[float, ...] = (0.05, 0.1, 0.13, 0.16, 0.2)
    """Margins δ of the tactile-use reward whose odds are tabulated."""


def run(config: StabilityGrpoConfig, context: Context) -> Results:
    """Drive every knob, judge every seed, collect the alarms."""
    runs = VariantRuns(config.effort, range(config.first_seed, config.first_seed + config.seeds))
    outcomes = []
    for scenario in context.each("failures", [s for s in SCENARIOS if s.code in config.codes]):
        outcomes.append(drive(scenario, config, runs, context))
        context.print(outcomes[-1].sentence)
    undriven = undriven_alarms(config, runs, context)
    return Results(
        verdict=verdict(outcomes, undriven),
        requirements=requirements(outcomes),
        tables=(
            summary_table(outcomes),
            criterion_table(outcomes),
            alarm_table(outcomes),
            odds_table(config.margins),
        ),
        pictures=(failure_picture(outcomes),),
        settings={
            "seeds": config.seeds,
            "updates": config.effort.steps,
            "rollouts": f"{config.effort.prompts} prompts × {config.effort.group}",
        },
        data={"failed": {o.name: counts(o) for o in outcomes}},
    )


def drive(
    scenario: FailureScenario, config: StabilityGrpoConfig, runs: VariantRuns, context: Context
) -> ScenarioOutcome:
    """Both variants at every value of the knob; an interrupted run continues with the first unfinished variant."""
    values = scenario.values[: config.most_values]
    found = []
    for variant in (scenario.failing, STABLE):
        stage = f"drive/{scenario.slug}/{'stable' if variant is STABLE else 'failing'}"
        if not context.done(stage):
            shown = context.each(stage, values)
            context.save_stage(stage, _drive_variant(scenario, variant, shown, config.seeds, runs))
        saved = context.load_stage(stage)
        raised = [[_alarms(alarms) for alarms in seeds] for seeds in saved["raised"]]
        found.append(VariantOutcome(failed=np.array(saved["failed"], bool), raised=raised))
    return ScenarioOutcome(scenario=scenario, values=values, failing=found[0], stable=found[1])


def _drive_variant(
    scenario: FailureScenario, variant: GrpoVariant, values: Iterable[float], seeds: int, runs: VariantRuns
) -> dict[str, list[list[object]]]:
    """Failed flags and alarms, [value][seed]; a run that the check before training refuses raises none."""
    found = [runs.run(variant, scenario.setting(variant, value), checked=variant is STABLE) for value in values]
    raised = [[{} if run.refused else run.alarms(seed) for seed in range(seeds)] for run in found]
    return {"failed": [scenario.failed(run).tolist() for run in found], "raised": raised}


def undriven_alarms(config: StabilityGrpoConfig, runs: VariantRuns, context: Context) -> dict[str, list[Alarms]]:
    """Preset → alarms of each seed in the plain world, with the preset's own weights."""
    found = {}
    for variant in context.each("undriven", (PAPER, STABLE)):
        stage = f"undriven/{variant.name}"
        if not context.done(stage):
            plain = runs.run(variant, (PLAIN, hyperparameters_of(variant)), checked=False)
            context.save_stage(stage, [plain.alarms(seed) for seed in range(config.seeds)])
        found[variant.name] = [_alarms(alarms) for alarms in context.load_stage(stage)]
    return found


def _alarms(saved: Mapping[str, list[float]]) -> Alarms:
    """First alarms from JSON, which turns tuples into lists."""
    return {code: FirstAlarm(int(step), value) for code, (step, value) in saved.items()}


DEFAULT = StabilityGrpoConfig()
SMOKE = StabilityGrpoConfig(
    effort=TrainingBudget(pretrain_steps=4, pretrain_batch=8, steps=22, prompts=2, group=4, examined=8, answers=2),
    seeds=2,
    codes=("F3",),
    most_values=2,
)

EXPERIMENT = Experiment(name="stability_grpo", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
