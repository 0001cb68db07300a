"""Where does reinforcement from touch fail, does the stable preset hold there, and does an alarm say so?

    make experiment EXP=stability_grpo [ARGS="--scale smoke"]

Twelve known failures, each driven by one knob until the published objective, or a variant named in the table, fails.
Small policies are trained by the engine's own step in a world of touch whose truth is known (see
`experiments.engine.world`): supervised on verified answers, then reinforced, ten seeds for each value of each knob.  A
seed fails by a number of that failure alone, written down before the runs (`experiments.engine.failures`).  Beside it
stands the `stable` preset at the same knob, and the alarms of both as they would have been raised during training.
Presets, bounds and knobs were chosen on seeds 100 to 109; seeds 0 to 9 are reported.

Cost: about 17 minutes on one core, 12 once everything is compiled; `--scale smoke` about one, most of it compilation.

Expected: every failure can be provoked, and alarms fire before anybody looks.  `stable` should fail in none of the
places.
"""

import dataclasses
from collections.abc import Iterable

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Picture, Results
from experiments.core.runner import Experiment
from experiments.engine.failures import PAPER, PLAIN, SCENARIOS, STABLE, FailureScenario
from experiments.engine.outcomes import Raised, ScenarioOutcome, VariantOutcome
from experiments.engine.stability_charts import KnobPanel, failed_against_knob
from experiments.engine.stability_runs import FirstAlarm, VariantRuns, alarms_of
from experiments.engine.stability_tables import (
    Sound,
    alarm_table,
    counts,
    criteria,
    odds_table,
    requirements,
    summary,
    verdict,
)
from experiments.engine.training import GrpoVariant, TrainingBudget, dials_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityGrpoConfig:
    """How long and how often; `codes` name failures, `most_values` of a knob are driven from its mild end."""

    effort: TrainingBudget = TrainingBudget()
    seeds: int = 10
    first_seed: int = 0
    codes: tuple[str, ...] = tuple(dict.fromkeys(s.code for s in SCENARIOS))
    most_values: int = 5
    margins: tuple[float, ...] = (0.05, 0.1, 0.13, 0.16, 0.2)
    """Margins δ of the tactile-use reward whose odds are tabulated."""


def run(config: StabilityGrpoConfig, context: Context) -> Results:
    """Drive every knob, judge every seed, listen to the alarms."""
    courses = VariantRuns(config.effort, range(config.first_seed, config.first_seed + config.seeds))
    outcomes = []
    for scenario in context.each("failures", [s for s in SCENARIOS if s.code in config.codes]):
        outcomes.append(drive(scenario, config, courses, context))
        context.print(outcomes[-1].sentence)
    sound = undriven(config, courses, context)
    return Results(
        verdict=verdict(outcomes, sound),
        requirements=requirements(outcomes),
        tables=(summary(outcomes), criteria(outcomes), alarm_table(outcomes), odds_table(config.margins)),
        pictures=(
            Picture(
                name="stability_grpo",
                title="Share of seeds failed against the knob",
                caption="Each panel drives one failure, from left to right; values are not to scale.  Dotted: share of "
                "seeds that raised the failure's alarm.",
                content=failed_against_knob([_panel(o) for o in outcomes]),
            ),
        ),
        settings={
            "seeds": config.seeds,
            "updates": config.effort.steps,
            "rollouts": f"{config.effort.prompts} prompts × {config.effort.group}",
        },
        data={"failed": {o.name: counts(o) for o in outcomes}},
    )


def drive(
    scenario: FailureScenario, config: StabilityGrpoConfig, courses: VariantRuns, context: Context
) -> ScenarioOutcome:
    """Both sides at every value of the knob; a stopped run goes on with the first side that it has not finished."""
    values = scenario.values[: config.most_values]
    sides = []
    for variant in (scenario.failing, STABLE):
        stage = f"drive/{scenario.slug}/{'stable' if variant is STABLE else 'failing'}"
        if not context.done(stage):
            shown = context.each(stage, values)
            context.save_stage(stage, _drive_side(scenario, variant, shown, config, courses))
        kept = context.load_stage(stage)
        raised = [[_firsts(run) for run in runs] for runs in kept["raised"]]
        sides.append(VariantOutcome(failed=np.array(kept["failed"], bool), raised=raised))
    return ScenarioOutcome(scenario=scenario, values=values, failing=sides[0], cure=sides[1])


def _drive_side(
    scenario: FailureScenario,
    variant: GrpoVariant,
    values: Iterable[float],
    config: StabilityGrpoConfig,
    courses: VariantRuns,
) -> dict[str, list[list[object]]]:
    """Failed, and what was raised, [value][seed]; a run that the engine refuses raises nothing."""
    found = [courses.course(variant, scenario.place(variant, v), guarded=variant is STABLE) for v in values]
    raised = [[{} if c.refused else alarms_of(c, seed) for seed in range(config.seeds)] for c in found]
    return {"failed": [scenario.failed(c).tolist() for c in found], "raised": raised}


def undriven(config: StabilityGrpoConfig, courses: VariantRuns, context: Context) -> Sound:
    """What both presets raise as they are, in the plain world."""
    sound = {}
    for variant in context.each("undriven", (PAPER, STABLE)):
        stage = f"undriven/{variant.name}"
        if not context.done(stage):
            course = courses.course(variant, (PLAIN, dials_of(variant)), guarded=False)
            context.save_stage(stage, [alarms_of(course, seed) for seed in range(config.seeds)])
        sound[variant.name] = [_firsts(run) for run in context.load_stage(stage)]
    return sound


def _firsts(run: dict[str, list[float]]) -> Raised:
    """First alarms as they were before they became JSON."""
    return {code: FirstAlarm(int(step), value) for code, (step, value) in run.items()}


def _panel(o: ScenarioOutcome) -> KnobPanel:
    failed = [side.failed.mean(1).tolist() for side in (o.failing, o.cure)]
    fired = [side.fired(o.scenario.alarms).mean(1).tolist() for side in (o.failing, o.cure)]
    return KnobPanel(o.name, o.scenario.knob, o.values, *failed, *fired)


DEFAULT = StabilityGrpoConfig()
SMOKE = StabilityGrpoConfig(
    effort=TrainingBudget(pretrain_steps=4, pretrain_batch=8, steps=22, prompts=2, group=4, examined=8, answers=2),
    seeds=2,
    codes=("F3",),
    most_values=2,
)

EXPERIMENT = Experiment(name="stability_grpo", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
