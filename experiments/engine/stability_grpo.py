"""Where does reinforcement learning from touch fail, does the stable preset avoid the failure, and does an alarm fire?

    make experiment EXP=stability_grpo [ARGS="--scale smoke"]

For each known failure, one parameter is increased until the published objective, or a variant named in the table,
fails.  The library's own step trains small policies by SFT, then GRPO, in a simulated world of touch with known truth
(`experiments.engine.world`), with ten seeds for each value of the parameter.  Each failure has its own criterion, fixed
before the runs (`experiments.engine.failures`).  The `stable` preset is trained at the same values.  Alarms are the
same as in training.  Presets, bounds and parameters were chosen on seeds 100 to 109; seeds 0 to 9 are reported.

Cost: 23 minutes in the recorded run on one core, less once everything is compiled; `--scale smoke` about two, most of
it compilation.

Expected: every failure can be provoked, and its alarm fires in nearly all failed runs.  `stable` never fails.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.context import Context
from experiments.core.look import PALETTE
from experiments.core.results import Cell, Picture, Requirement, Results, Table, at_least, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine.answers_without_touch import adversary_picture, adversary_requirement, adversary_table
from experiments.engine.failures import PAPER, PLAIN, SCENARIOS, STABLE, FailureScenario
from experiments.engine.world_training import FirstAlarm, TrainingBudget, VariantRuns, hyperparameters_of
from touchr1_jax.rl.alarms import RULES
from touchr1_jax.rl.config import GRPOConfig, Stable
from touchr1_jax.rl.credit_odds import HELPED, HINDERED, credit_odds, false_credit
from touchr1_jax.validation import some_of

LEAST_NOTICED, MOST_FALSE = 0.9, 0.1  # least share of failed runs whose alarm fires, most of the others
MARGINS = (0.05, 0.1, 0.13, 0.16, 0.2)  # margins δ of the tactile-use reward whose odds are tabulated
CODES = tuple(dict.fromkeys(s.code for s in SCENARIOS))
"""Of all failures."""

Alarms = Mapping[str, FirstAlarm]  # code of each alarm that a run raised → its first time


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityGrpoConfig:
    """Training budget, seeds, failures by `codes`, and how many of a knob's values are driven, from the mildest on."""

    effort: TrainingBudget = TrainingBudget()
    seeds: int = 10
    first_seed: int = 0
    codes: tuple[str, ...] = CODES
    most_values: int = 5

    def __post_init__(self) -> None:
        some_of(self, "codes", CODES)


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariantOutcome:
    """One variant in one scenario: failed seeds, bool [value, seed], and the alarms of each, [value][seed]."""

    failed: np.ndarray
    raised: Sequence[Sequence[Alarms]]

    def fired(self, codes: Sequence[str]) -> np.ndarray:
        """Seeds that raised any of these alarms, bool [value, seed]."""
        return np.array([[any(c in run for c in codes) for run in runs] for runs in self.raised])

    def breaks_at(self, values: Sequence[float], share: float = 0.0) -> float | None:
        """First value at which more than this share of the seeds fail; `None` where there is none."""
        return next((v for v, failed in zip(values, self.failed.mean(1), strict=True) if failed > share), None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScenarioOutcome:
    """The scenario's variant and the stable preset at the values that were driven."""

    scenario: FailureScenario
    values: tuple[float, ...]
    failing: VariantOutcome
    stable: VariantOutcome

    @property
    def name(self) -> str:
        """The failure's code and title."""
        return f"{self.scenario.code} {self.scenario.title}"

    @property
    def compared(self) -> np.ndarray:
        """Failures of each run of `stable` at the values where any run of the failing variant failed, bool [n]."""
        return self.stable.failed[np.any(self.failing.failed, axis=1)].ravel()

    def noticed(self, *, failed: bool) -> np.ndarray:
        """Alarms of the scenario in the runs of both variants that failed (or did not), bool [n]."""
        codes = self.scenario.alarms
        return np.concatenate([one.fired(codes)[one.failed == failed] for one in (self.failing, self.stable)])

    def first_alarms(self) -> list[FirstAlarm]:
        """The scenario's first alarm in each failed run that raised one."""
        failed = [one.raised[v][seed] for one in (self.failing, self.stable) for v, seed in np.argwhere(one.failed)]
        raised = [[run[code] for code in self.scenario.alarms if code in run] for run in failed]
        return [min(alarms) for alarms in raised if alarms]

    def counts(self) -> dict[str, list[int]]:
        """Seeds of either variant that failed, and that raised the scenario's alarm, at every value."""
        codes = self.scenario.alarms
        return {
            "failed": self.failing.failed.sum(1).tolist(),
            "stable failed": self.stable.failed.sum(1).tolist(),
            "alarms": self.failing.fired(codes).sum(1).tolist(),
            "stable alarms": self.stable.fired(codes).sum(1).tolist(),
        }


def run(config: StabilityGrpoConfig, context: Context) -> Results:
    """Drive every knob, judge every seed, collect the alarms."""
    runs = VariantRuns(config.effort, range(config.first_seed, config.first_seed + config.seeds))
    outcomes = []
    for scenario in context.each("failures", [s for s in SCENARIOS if s.code in config.codes]):
        outcomes.append(o := drive(scenario, config, runs, context))
        broken = ((name, one.breaks_at(o.values)) for name, one in (("failing", o.failing), ("stable", o.stable)))
        context.print(f"{o.name}: " + ", ".join(f"{n} fails from {v if v is not None else '–'}" for n, v in broken))
    undriven = undriven_alarms(config, runs, context)
    return Results(
        verdict=verdict(outcomes, undriven),
        requirements=requirements(outcomes),
        tables=(
            summary_table(outcomes),
            criterion_table(outcomes),
            alarm_table(outcomes),
            odds_table(),
            adversary_table(),
        ),
        pictures=(failure_picture(outcomes), adversary_picture()),
        settings={
            "seeds": config.seeds,
            "updates": config.effort.steps,
            "rollouts": f"{config.effort.prompts} prompts × {config.effort.group}",
        },
        data={"failed": {o.name: o.counts() for o in outcomes}},
    )


def drive(
    scenario: FailureScenario, config: StabilityGrpoConfig, runs: VariantRuns, context: Context
) -> ScenarioOutcome:
    """Both variants at every value of the knob; an interrupted run continues with the first unfinished variant.

    A run that the check before training refuses raises no alarm.
    """
    values = scenario.values[: config.most_values]
    found = []
    for variant in (scenario.failing, STABLE):
        stage = f"drive/{scenario.slug}/{'stable' if variant is STABLE else 'failing'}"
        if not context.done(stage):
            settings = [scenario.setting(variant, value) for value in values]
            trained = [runs.run(variant, s, checked=variant is STABLE) for s in context.each(stage, settings)]
            raised = [[{} if run.refused else run.alarms(seed) for seed in range(config.seeds)] for run in trained]
            context.save_stage(stage, {"failed": [scenario.failed(run).tolist() for run in trained], "raised": raised})
        saved = context.load_stage(stage)
        alarms = [[_alarms(alarms) for alarms in seeds] for seeds in saved["raised"]]
        found.append(VariantOutcome(failed=np.array(saved["failed"], bool), raised=alarms))
    return ScenarioOutcome(scenario=scenario, values=values, failing=found[0], stable=found[1])


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


def _noticed(outcomes: Sequence[ScenarioOutcome], *, failed: bool) -> np.ndarray:
    return np.concatenate([o.noticed(failed=failed) for o in outcomes])


def verdict(outcomes: Sequence[ScenarioOutcome], undriven: Mapping[str, Sequence[Alarms]]) -> tuple[str, ...]:
    """Count the failures provoked, those where `stable` failed too, and the alarms; `undriven` as `undriven_alarms`."""
    provoked = [o for o in outcomes if len(o.compared)]
    harmed = [f"{o.name} ({o.compared.sum()} of {len(o.compared)} runs)" for o in provoked if o.compared.any()]
    failed, others = (_noticed(outcomes, failed=f) for f in (True, False))
    noticed = f"Alarms fired in {failed.mean():.0%} of {len(failed)} failed runs" if len(failed) else "No run failed"
    missed = [f"{o.name} ({n})" for o in outcomes if (n := int((~o.noticed(failed=True)).sum()))]
    plain = "; ".join(f"{name}: {_alarm_counts(runs)}" for name, runs in undriven.items())
    avoided = len(provoked) - len(harmed)
    named = (
        ("`stable` failed too in", harmed),
        ("Not provoked:", [o.name for o in outcomes if not len(o.compared)]),
        ("Failed without an alarm:", missed),
    )
    return (
        f"{len(provoked)} of {len(outcomes)} failures were provoked; the preset `stable` avoids {avoided} of them.",
        *(f"{what} {'; '.join(names)}." for what, names in named if names),
        f"{noticed} and in {others.mean():.1%} of the {len(others)} others.",
        f"Alarms without a provoked failure: {plain}.",
    )


def _alarm_counts(runs: Sequence[Alarms]) -> str:
    found = {code: sum(code in run for run in runs) for run in runs for code in run}
    listed = ", ".join(f"{code} in {n}" for code, n in sorted(found.items()))
    return f"{listed} of {len(runs)} seeds" if found else f"none in {len(runs)} seeds"


def requirements(outcomes: Sequence[ScenarioOutcome]) -> tuple[Requirement, ...]:
    """No run of `stable` fails where the other variant does; alarms are reliable; R_tu's odds at its margin."""
    harmed = (
        at_most(
            f"{o.name}: failed runs of stable",
            o.compared.sum(),
            0,
            note=f"of {len(o.compared)} where {o.scenario.failing.name} fails",
        )
        for o in outcomes
    )
    failed, others = (_noticed(outcomes, failed=f) for f in (True, False))
    chance, power = _odds(Stable().tactile_margin)
    return (
        *harmed,
        *([at_least("failed runs whose alarm fired", failed.mean(), LEAST_NOTICED)] if len(failed) else []),
        *([at_most("other runs whose alarm fired", others.mean(), MOST_FALSE)] if len(others) else []),
        at_most("tactile-use reward: false credit", chance, 0.12),
        at_least("tactile-use reward: power", power, 0.5),
        adversary_requirement(),
    )


def summary_table(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """One line a scenario: the values at which either variant breaks, and how reliable the alarm is."""
    share = lambda flags: float(flags.mean()) if len(flags) else None
    return named_table(
        "Onset of each failure",
        [
            {
                "failure": o.name,
                "parameter": f"{o.scenario.knob} ({o.scenario.failing.name})",
                "breaks": o.failing.breaks_at(o.values),
                "half": o.failing.breaks_at(o.values, 0.5),
                "stable": o.stable.breaks_at(o.values),
                "failed": int(o.compared.sum()),
                "of": len(o.compared),
                "alarm": share(o.noticed(failed=True)),
                "false": share(o.noticed(failed=False)),
            }
            for o in outcomes
        ],
        formats={"breaks": "g", "half": "g", "stable": "g", "alarm": ".2f", "false": ".2f"},
        meanings={
            "parameter": "in brackets the variant that is compared with the stable preset; controls watched: answers "
            "without touch are sampled and do not count; literal bonus: the tactile-use reward as the paper's abstract "
            "words it; KL by k1: estimated by log π/π_ref",
            "breaks": "first value at which any seed of that variant fails",
            "half": "first value at which more than half of them do",
            "failed": "runs of the stable preset that fail at values where the variant does",
            "alarm": "share of failed runs of both variants whose alarm fired",
            "false": "share of runs that did not fail whose alarm fired",
        },
    )


def criterion_table(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """The criterion of a failed seed, and how many seeds failed at each value."""
    rows = []
    for o in outcomes:
        listed = (
            " · ".join(f"{v:g}:\N{NO-BREAK SPACE}{n}" for v, n in zip(o.values, one.failed.sum(1), strict=True))
            for one in (o.failing, o.stable)
        )
        seeds = dict(zip(("seeds failed", "of stable"), listed, strict=True))
        rows.append({"failure": o.name, "a seed has failed when": o.scenario.criterion, **seeds})
    meanings = {"seeds failed": "at each value of the parameter", "of stable": "the same under the stable preset"}
    return named_table("Criteria of failure", rows, meanings=meanings)


def alarm_table(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """Share and time of each failure's alarm, in failed runs and in others."""
    rows: list[dict[str, Cell]] = []
    for o in outcomes:
        failed, others, firsts = o.noticed(failed=True), o.noticed(failed=False), o.first_alarms()
        rules = [rule for rule in RULES if rule.code in o.scenario.alarms and not rule.at_once]
        bounds = [f"{rule.code} {'<' if rule.below else '>'} {rule.bound:g}" for rule in rules]
        rows.append(
            {
                "failure": o.name,
                "alarm": ", ".join(bounds),
                "failed": len(failed),
                "alarms": int(failed.sum()),
                "number": float(np.median([f.value for f in firsts])) if firsts else None,
                "step": float(np.median([f.step for f in firsts])) if firsts else None,
                "others": len(others),
                "false alarms": int(others.sum()),
            }
        )
    return named_table(
        "Alarms",
        rows,
        formats={"number": ".2g", "step": ".0f"},
        meanings={
            "alarm": "codes of which any counts, with the bounds of their rules",
            "number": "that fired first, median over failed runs",
            "step": "at which it fired first, median over failed runs",
            "alarms": "failed runs whose alarm fired",
            "false alarms": "runs that did not fail whose alarm fired",
        },
    )


def odds_table(margins: Sequence[float] = MARGINS) -> Table:
    """Exact probabilities that R_tu pays by chance and where touch helps, by its margin."""
    helped, hindered = (" / ".join(f"{p:.0%}" for p in odds) for odds in (HELPED, HINDERED))
    odds = {margin: _odds(margin) for margin in margins}
    return named_table(
        "The tactile-use reward by chance",
        [{"margin δ": margin, "false credit": chance, "power": power} for margin, (chance, power) in odds.items()],
        formats={"margin δ": ".2f", "false credit": ".3f", "power": ".3f"},
        meanings={
            "false credit": "largest probability that a group is paid without a lead",
            "power": "probability that it is paid where touch helps",
        },
        note=(
            f"Groups of {GRPOConfig().group}, three controls of {Stable().controls} rollouts.  False credit: answers "
            "and controls alike over credits 0, .4, 1, worst over P(1) = .1 … .9 and every split of the rest.  Power: "
            f"{helped} with touch against {hindered} under controls."
        ),
    )


def _odds(margin: float) -> tuple[float, float]:
    """False credit and power of the tactile-use reward."""
    group, rollouts = GRPOConfig().group, Stable().controls
    chance = false_credit(group=group, rollouts=rollouts, margin=margin)
    return chance, credit_odds(HELPED, HINDERED, group=group, rollouts=rollouts, margin=margin)


def failure_picture(outcomes: Sequence[ScenarioOutcome]) -> Picture:
    """Share of failed seeds over the knob, one panel a failure; values are evenly spaced in the order driven."""
    panels = []
    for i, o in enumerate(outcomes):
        x, series = range(len(o.values)), []
        shown = (("paper or the named variant", o.failing, PALETTE[1]), ("stable", o.stable, PALETTE[0]))
        for name, one, colour in shown:
            fired = one.fired(o.scenario.alarms).mean(1)
            series.append(Series(f"{name}: alarm", x=x, y=fired, line=":", marker="", width=1.2, colour=colour))
            series.append(Series(name, x=x, y=one.failed.mean(1), colour=colour))
        panels.append(
            Panel(
                series,
                title=o.name,
                x_label=o.scenario.knob,
                y_label="" if i % 4 else "share of seeds failed",
                x_ticks={j: f"{value:g}" for j, value in enumerate(o.values)},
                y_ticks={0: "0", 0.5: "½", 1: "1"},
                y_limits=(-0.04, 1.04),
            )
        )
    return Picture(
        name="stability_grpo",
        title="Share of failed seeds over the parameter",
        caption="Each panel drives one failure, from left to right; values are not to scale.  Dotted: share of seeds "
        "that raised the failure's alarm.",
        content=draw(panels, columns=4),
    )


SMOKE_BUDGET = TrainingBudget(pretrain_steps=4, pretrain_batch=8, steps=22, prompts=2, group=4, examined=8, answers=2)
SMOKE = StabilityGrpoConfig(effort=SMOKE_BUDGET, seeds=2, codes=("F3",), most_values=2)

EXPERIMENT = Experiment(name="stability_grpo", config=StabilityGrpoConfig(), scales={"smoke": SMOKE}, run=run)
