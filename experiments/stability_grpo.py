"""Where does reinforcement from touch fail, does the stable preset hold there, and does an alarm say so?

    make experiment EXP=stability_grpo [ARGS="--scale smoke"]

Twelve known failures, each driven by one knob until the published objective, or a variant named in the table, fails.
Small policies are trained by the engine's own step in a world of touch whose truth is known (see
`experiments.grpo.world`): supervised on verified answers, then reinforced, ten seeds for each value of each knob.  A
seed fails by a number of that failure alone, written down before the runs (`experiments.grpo.failures`).  Beside it
stands the `stable` preset at the same knob, and the alarms of both as they would have been raised during training.
Presets, bounds and knobs were chosen on seeds 100 to 104; seeds 0 to 9 are reported.

Cost: about 25 minutes on one core; `--scale smoke` about one, most of it compilation.

Expected: every failure can be provoked, and alarms fire before anybody looks.  `stable` should fail in none of the
places; where the noise of touch is 1.5 (F1) one seed of ten has been seen to.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from experiments.grpo.courses import Courses, alarms_of
from experiments.grpo.failures import SCENARIOS, STABLE, Scenario
from experiments.grpo.stability_charts import Panel, failed_against_knob
from experiments.grpo.training import Effort, Variant
from experiments.reporting.findings import Cell, Column, Findings, Picture, Requirement, Table
from experiments.running.context import Context
from experiments.running.runner import Experiment
from touchr1_jax.rl.config import GRPOConfig, Stable
from touchr1_jax.rl.credit_odds import HELPED, HINDERED, credit_odds, false_credit


@dataclasses.dataclass(frozen=True, kw_only=True)
class StabilityConfig:
    """How long and how often; `codes` name failures, `most_values` of a knob are driven from its mild end."""

    effort: Effort = Effort()
    seeds: int = 10
    first_seed: int = 0
    codes: tuple[str, ...] = tuple(dict.fromkeys(s.code for s in SCENARIOS))
    most_values: int = 5
    margins: tuple[float, ...] = (0.05, 0.1, 0.13, 0.16, 0.2)
    """Margins δ of the tactile-use reward whose odds are tabulated."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Side:
    """One variant in one scenario, arrays [value, seed]: which seeds failed, and which raised the scenario's alarm."""

    failed: np.ndarray
    fired: np.ndarray

    def breaks_at(self, values: Sequence[float]) -> str:
        """First value at which any seed fails, and first at which the median seed does."""
        rows = list(zip(values, self.failed.mean(1), strict=True))
        any_seed, median = (next((f"{v:g}" for v, share in rows if share > bound), "–") for bound in (0.0, 0.5))
        return any_seed if any_seed == median else f"{any_seed} / {median}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """Both sides of a scenario at the values that were driven."""

    scenario: Scenario
    values: tuple[float, ...]
    failing: Side
    cure: Side

    @property
    def harmed(self) -> int:
        """Seeds that fail under `stable` at values where any of the other side does."""
        return int(self.cure.failed[self.failing.failed.any(1)].sum())

    @property
    def power(self) -> float | None:
        """Share of failed seeds, of either side, whose alarm fired; `None` where none failed."""
        return _share(self, failed=True)

    @property
    def false_alarms(self) -> float | None:
        """Share of seeds that did not fail, of either side, whose alarm fired all the same."""
        return _share(self, failed=False)


def _share(outcome: Outcome, *, failed: bool) -> float | None:
    sides = (outcome.failing, outcome.cure)
    fired = np.concatenate([side.fired[side.failed == failed] for side in sides])
    return float(fired.mean()) if len(fired) else None


def run(config: StabilityConfig, context: Context) -> Findings:
    """Drive every knob, judge every seed, listen to the alarms."""
    courses = Courses(config.effort, range(config.first_seed, config.first_seed + config.seeds))
    outcomes = []
    for scenario in SCENARIOS:
        if scenario.code in config.codes:
            outcomes.append(drive(scenario, config, courses, context))
            context.say(_sentence(outcomes[-1]))
    odds = odds_table(config.margins)
    return Findings(
        verdict=verdict(outcomes),
        requirements=requirements(outcomes),
        tables=(summary(outcomes), criteria(outcomes), odds),
        pictures=(
            Picture(
                name="stability_grpo",
                title="Share of seeds failed against the knob",
                caption="Each panel drives one failure, from left to right; values are not to scale.",
                content=failed_against_knob([_panel(o) for o in outcomes]),
            ),
        ),
        settings={
            "seeds": config.seeds,
            "updates": config.effort.steps,
            "rollouts": f"{config.effort.prompts} prompts × {config.effort.group}",
        },
        data={"failed": {f"{o.scenario.code} {o.scenario.title}": _counts(o) for o in outcomes}},
    )


def drive(scenario: Scenario, config: StabilityConfig, courses: Courses, context: Context) -> Outcome:
    """Both sides at every value of the knob; a stopped run goes on with the first side that it has not finished."""
    values = scenario.values[: config.most_values]
    sides = []
    for variant in (scenario.failing, STABLE):
        stage = f"drive/{scenario.slug}/{'stable' if variant is STABLE else 'failing'}"
        if not context.done(stage):
            side = _drive_side(scenario, variant, values, config, courses)
            context.save_stage(stage, {"failed": side.failed.tolist(), "fired": side.fired.tolist()})
        kept = context.load_stage(stage)
        sides.append(Side(failed=np.array(kept["failed"], bool), fired=np.array(kept["fired"], bool)))
    return Outcome(scenario=scenario, values=values, failing=sides[0], cure=sides[1])


def _drive_side(
    scenario: Scenario, variant: Variant, values: Sequence[float], config: StabilityConfig, courses: Courses
) -> Side:
    found = [courses.course(variant, scenario.place(variant, v), guarded=variant is STABLE) for v in values]
    raised = lambda c, s: not c.refused and bool(set(scenario.alarms) & set(alarms_of(c, s)))
    fired = [[raised(c, seed) for seed in range(config.seeds)] for c in found]
    return Side(failed=np.array([scenario.failed(c) for c in found]), fired=np.array(fired))


def summary(outcomes: Sequence[Outcome]) -> Table:
    """One line a scenario: where either side breaks, and what the alarm is worth."""
    rows: list[tuple[Cell, ...]] = [
        (
            f"{o.scenario.code} {o.scenario.title}",
            o.scenario.failing.name,
            o.scenario.knob,
            o.failing.breaks_at(o.values),
            o.cure.breaks_at(o.values),
            o.power,
            o.false_alarms,
        )
        for o in outcomes
    ]
    return Table(
        title="Where each breaks",
        columns=(
            Column(name="failure"),
            Column(name="driven"),
            Column(name="knob"),
            Column(name="breaks at", meaning="first value at which any seed fails / at which the median seed does"),
            Column(name="stable at", meaning="the same for the stable preset; – where no seed fails"),
            Column(name="alarm", format=".2f", meaning="share of failed seeds of both sides whose alarm fired"),
            Column(name="false", format=".2f", meaning="share of seeds that did not fail whose alarm fired"),
        ),
        rows=tuple(rows),
    )


def criteria(outcomes: Sequence[Outcome]) -> Table:
    """What counts as failed, and how many seeds did at each value."""
    rows: list[tuple[Cell, ...]] = [
        (
            f"{o.scenario.code} {o.scenario.title}",
            o.scenario.criterion,
            ", ".join(f"{v:g}" for v in o.values),
            ", ".join(map(str, o.failing.failed.sum(1))),
            ", ".join(map(str, o.cure.failed.sum(1))),
        )
        for o in outcomes
    ]
    names = ("failure", "a seed has failed when", "values", "failed", "failed, stable")
    return Table(title="What counts as failed", columns=tuple(Column(name=n) for n in names), rows=tuple(rows))


def odds_table(margins: Sequence[float]) -> Table:
    """What R_tu pays by chance and where touch helps, by its margin: exact, by enumeration."""
    sizes = _sizes()
    rows: list[tuple[Cell, ...]] = [
        (margin, false_credit(**sizes, margin=margin), credit_odds(HELPED, HINDERED, **sizes, margin=margin))
        for margin in margins
    ]
    return Table(
        title="The tactile-use reward by chance",
        columns=(
            Column(name="margin δ", format=".2f"),
            Column(
                name="false credit", format=".3f", meaning="largest probability that a group is paid without a lead"
            ),
            Column(name="power", format=".3f", meaning="probability that it is paid where touch helps"),
        ),
        rows=tuple(rows),
        note=(
            f"Groups of {sizes['group']}, three controls of {sizes['rollouts']} rollouts.  False credit: answers and "
            "controls alike over credits 0, .4, 1, worst over P(1) = .1 … .9 and every split of the rest.  Power: "
            f"{_percent(HELPED)} with touch against {_percent(HINDERED)} under controls."
        ),
    )


def _sizes() -> dict[str, int]:
    """Rollouts of a group and of each control, as the stable preset has them."""
    return {"group": GRPOConfig().group, "rollouts": Stable().controls}


def requirements(outcomes: Sequence[Outcome]) -> tuple[Requirement, ...]:
    """No seed of `stable` fails where the other side does, and R_tu's odds at the preset's margin."""
    sizes, margin = _sizes(), Stable().tactile_margin
    return (
        *(
            Requirement(
                name=f"{o.scenario.code} {o.scenario.title}: stable seeds failed where {o.scenario.failing.name} fails",
                measured=float(o.harmed),
                bound=0,
                better="lower",
                note=o.scenario.criterion,
            )
            for o in outcomes
        ),
        Requirement(
            name="tactile-use reward: false credit",
            measured=false_credit(**sizes, margin=margin),
            bound=0.12,
            better="lower",
        ),
        Requirement(
            name="tactile-use reward: power",
            measured=credit_odds(HELPED, HINDERED, **sizes, margin=margin),
            bound=0.5,
            better="higher",
        ),
    )


def verdict(outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """What broke, what held, what the alarms are worth."""
    driven = [o for o in outcomes if o.failing.failed.any()]
    harmed = [o for o in driven if o.harmed]
    said = [
        f"{len(driven)} of {len(outcomes)} failures were provoked; stable held in {len(driven) - len(harmed)} of them."
    ]
    if harmed:
        said.append("It failed too in " + "; ".join(f"{_name(o)} ({o.harmed} seeds)" for o in harmed) + ".")
    quiet = [o for o in outcomes if not o.failing.failed.any()]
    if quiet:
        said.append("Not provoked: " + "; ".join(map(_name, quiet)) + ".")
    said.append(_alarm_sentence(outcomes))
    return tuple(said)


def _alarm_sentence(outcomes: Sequence[Outcome]) -> str:
    pairs = [(side.failed, side.fired) for o in outcomes for side in (o.failing, o.cure)]
    failed, fired = (np.concatenate([pair[i].ravel() for pair in pairs]) for i in (0, 1))
    said = (
        f"Alarms fired in {fired[failed].mean():.0%} of {failed.sum()} failed runs" if failed.any() else "No run failed"
    )
    return f"{said} and in {fired[~failed].mean():.1%} of {(~failed).sum()} that did not fail."


def _sentence(o: Outcome) -> str:
    sides = (
        f"{o.scenario.failing.name} breaks at {o.failing.breaks_at(o.values)}, stable at {o.cure.breaks_at(o.values)}"
    )
    return f"{_name(o)}: {o.scenario.knob}: {sides}"


def _name(o: Outcome) -> str:
    return f"{o.scenario.code} {o.scenario.title}"


def _percent(p: np.ndarray) -> str:
    return " / ".join(f"{x:.0%}" for x in p)


def _counts(o: Outcome) -> dict[str, list[int]]:
    return {
        "failed": o.failing.failed.sum(1).tolist(),
        "stable failed": o.cure.failed.sum(1).tolist(),
        "alarms": o.failing.fired.sum(1).tolist(),
        "stable alarms": o.cure.fired.sum(1).tolist(),
    }


def _panel(o: Outcome) -> Panel:
    share = lambda side: side.failed.mean(1).tolist()
    return Panel(f"{o.scenario.code} {o.scenario.title}", o.scenario.knob, o.values, share(o.failing), share(o.cure))


DEFAULT = StabilityConfig()
SMOKE = StabilityConfig(
    effort=Effort(pretrain_steps=4, pretrain_batch=8, steps=22, prompts=2, group=4, examined=8, answers=2),
    seeds=2,
    codes=("F3",),
    most_values=2,
)

EXPERIMENT = Experiment(name="stability_grpo", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
