"""Requirements, tables and sentences of the stability of GRPO."""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.results import Cell, Column, Requirement, Table
from experiments.engine.outcomes import Raised, ScenarioOutcome, share
from touchr1_jax.rl.alarms import RULES
from touchr1_jax.rl.config import GRPOConfig, Stable
from touchr1_jax.rl.credit_odds import HELPED, HINDERED, credit_odds, false_credit

HALF = 0.5

NOTICED, STRUCK = 0.9, 0.1
"""Least share of failed runs whose alarm fires, most of the others."""

Sound = Mapping[str, Sequence[Raised]]
"""What the seeds of a preset raise where nothing drives it, by the preset's name."""


def summary(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """One line a scenario: where either side breaks, and what the alarm is worth."""
    rows: list[tuple[Cell, ...]] = [
        (
            o.name,
            f"{o.scenario.knob} ({o.scenario.failing.name})",
            o.failing.breaks_at(o.values),
            o.failing.breaks_at(o.values, HALF),
            o.cure.breaks_at(o.values),
            o.harmed,
            o.compared,
            o.power,
            o.false_alarms,
        )
        for o in outcomes
    ]
    return Table(
        title="Where each breaks",
        columns=(
            Column(name="failure"),
            Column(name="knob", meaning="in brackets the variant that is driven beside the stable preset"),
            Column(name="breaks", format="g", meaning="first value at which any seed of that variant fails"),
            Column(name="half", format="g", meaning="first value at which more than half of them do"),
            Column(name="stable", format="g", meaning="first value at which any seed of the stable preset fails"),
            Column(name="failed", meaning="runs of the stable preset that fail at values where the variant does"),
            Column(name="of", meaning="as many runs there are"),
            Column(name="alarm", format=".2f", meaning="share of failed runs of both sides whose alarm fired"),
            Column(name="false", format=".2f", meaning="share of runs that did not fail whose alarm fired"),
        ),
        rows=tuple(rows),
    )


def criteria(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """What counts as failed, and how many seeds did at each value."""
    listed = lambda o, side: " · ".join(
        f"{v:g}:\N{NO-BREAK SPACE}{n}" for v, n in zip(o.values, side.failed.sum(1), strict=True)
    )
    rows: list[tuple[Cell, ...]] = [
        (o.name, o.scenario.criterion, listed(o, o.failing), listed(o, o.cure)) for o in outcomes
    ]
    return Table(
        title="What counts as failed",
        columns=(
            Column(name="failure"),
            Column(name="a seed has failed when"),
            Column(name="seeds failed", meaning="at each value of the knob"),
            Column(name="of stable", meaning="the same under the stable preset"),
        ),
        rows=tuple(rows),
    )


def alarm_table(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """What each failure's alarm said, when, and how often it fired where nothing had failed."""
    return Table(
        title="What the alarms said",
        columns=(
            Column(name="failure"),
            Column(name="alarm", meaning="codes of which any counts, with the bounds of their rules"),
            Column(name="failed", meaning="runs of both sides that failed"),
            Column(name="noticed", meaning="those whose alarm fired"),
            Column(name="number", format=".2g", meaning="that fired first, median over these runs"),
            Column(name="step", format=".0f", meaning="at which it fired first, median over these runs"),
            Column(name="others", meaning="runs of both sides that did not fail"),
            Column(name="struck", meaning="those whose alarm fired all the same"),
        ),
        rows=tuple(_alarm_row(o) for o in outcomes),
    )


def _alarm_row(o: ScenarioOutcome) -> tuple[Cell, ...]:
    failed, others, firsts = o.heard(failed=True), o.heard(failed=False), o.firsts()
    bounds = [f"{r.code} {'<' if r.below else '>'} {r.bound:g}" for r in RULES if r.code in o.scenario.alarms]
    middle = lambda numbers: float(np.median(numbers)) if firsts else None
    return (
        o.name,
        ", ".join(bounds),
        len(failed),
        int(failed.sum()),
        middle([f.value for f in firsts]),
        middle([f.step for f in firsts]),
        len(others),
        int(others.sum()),
    )


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


def _percent(p: np.ndarray) -> str:
    return " / ".join(f"{x:.0%}" for x in p)


def requirements(outcomes: Sequence[ScenarioOutcome]) -> tuple[Requirement, ...]:
    """No run of `stable` fails where the other side does, alarms are worth hearing, R_tu's odds at its margin."""
    sizes, margin = _sizes(), Stable().tactile_margin
    return (
        *(
            Requirement(
                name=f"{o.name}: failed runs of stable",
                measured=float(o.harmed),
                bound=0,
                better="lower",
                note=f"of {o.compared} where {o.scenario.failing.name} fails",
            )
            for o in outcomes
        ),
        *_alarm_requirements(outcomes),
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


def _alarm_requirements(outcomes: Sequence[ScenarioOutcome]) -> list[Requirement]:
    """Both shares, where there are runs to take them of."""
    noticed, struck = (share(np.concatenate([o.heard(failed=f) for o in outcomes])) for f in (True, False))
    found = []
    if noticed is not None:
        name = "failed runs whose alarm fired"
        found.append(Requirement(name=name, measured=noticed, bound=NOTICED, better="higher"))
    if struck is not None:
        found.append(Requirement(name="other runs whose alarm fired", measured=struck, bound=STRUCK, better="lower"))
    return found


def verdict(outcomes: Sequence[ScenarioOutcome], sound: Sound) -> tuple[str, ...]:
    """What broke, what held, what the alarms are worth."""
    driven = [o for o in outcomes if o.compared]
    harmed = [o for o in driven if o.harmed]
    said = [
        f"{len(driven)} of {len(outcomes)} failures were provoked; stable held in {len(driven) - len(harmed)} of them."
    ]
    if harmed:
        told = "; ".join(f"{o.name} ({o.harmed} of {o.compared} runs)" for o in harmed)
        said.append(f"It failed too in {told}.")
    quiet = [o for o in outcomes if not o.compared]
    if quiet:
        said.append("Not provoked: " + "; ".join(o.name for o in quiet) + ".")
    return (*said, *_alarm_sentences(outcomes), _sound_sentence(sound))


def _alarm_sentences(outcomes: Sequence[ScenarioOutcome]) -> list[str]:
    """How often alarms fired, and which were missed."""
    failed, others = (np.concatenate([o.heard(failed=f) for o in outcomes]) for f in (True, False))
    noticed = f"Alarms fired in {failed.mean():.0%} of {len(failed)} failed runs" if len(failed) else "No run failed"
    said = [f"{noticed} and in {others.mean():.1%} of the {len(others)} others."]
    missed = {o.name: int((~o.heard(failed=True)).sum()) for o in outcomes}
    if any(missed.values()):
        said.append("Failed in silence: " + "; ".join(f"{n} ({k})" for n, k in missed.items() if k) + ".")
    return said


def _sound_sentence(sound: Sound) -> str:
    """Which alarms the presets raise where nothing drives them."""
    told = [f"{name}: {_codes(runs)}" for name, runs in sound.items()]
    return "Where nothing is driven, all alarms together: " + "; ".join(told) + "."


def _codes(runs: Sequence[Raised]) -> str:
    counts = {code: sum(code in run for run in runs) for run in runs for code in run}
    listed = ", ".join(f"{code} in {n}" for code, n in sorted(counts.items()))
    return f"{listed} of {len(runs)} seeds" if counts else f"none in {len(runs)} seeds"


def counts(o: ScenarioOutcome) -> dict[str, list[int]]:
    """Seeds of either side that failed, and that raised the scenario's alarm, at every value."""
    return {
        "failed": o.failing.failed.sum(1).tolist(),
        "stable failed": o.cure.failed.sum(1).tolist(),
        "alarms": o.failing.fired(o.scenario.alarms).sum(1).tolist(),
        "stable alarms": o.cure.fired(o.scenario.alarms).sum(1).tolist(),
    }
