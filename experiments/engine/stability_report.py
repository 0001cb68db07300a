"""Outcomes of the driven failures: which seeds failed, which alarms fired; requirements, tables, chart and verdict."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from experiments.core.charts import Panel, Series, draw
from experiments.core.look import PALETTE
from experiments.core.results import Cell, Picture, Requirement, Table, named_table
from experiments.engine.failures import FailureScenario
from experiments.engine.world_training import FirstAlarm
from touchr1_jax.rl.alarms import RULES
from touchr1_jax.rl.config import GRPOConfig, Stable
from touchr1_jax.rl.credit_odds import HELPED, HINDERED, credit_odds, false_credit

LEAST_NOTICED, MOST_FALSE = 0.9, 0.1
"""Least share of failed runs whose alarm fires, most of the others."""

Alarms = Mapping[str, FirstAlarm]
"""Code of each alarm that a run raised → its first time."""


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
    def sentence(self) -> str:
        """The values at which either variant breaks."""
        text = lambda v: "nowhere" if v is None else f"at {v:g}"
        failing, stable = (text(one.breaks_at(self.values)) for one in (self.failing, self.stable))
        return f"{self.name}: {self.scenario.knob}: {self.scenario.failing.name} breaks {failing}, stable {stable}"

    @property
    def compared(self) -> np.ndarray:
        """Failures of each run of `stable` at the values where any run of the failing variant failed, bool [n]."""
        return self.stable.failed[np.any(self.failing.failed, axis=1)].ravel()

    def noticed(self, *, failed: bool) -> np.ndarray:
        """Alarms of the scenario in the runs of both variants that failed (or did not), bool [n]."""
        codes = self.scenario.alarms
        return np.concatenate([one.fired(codes)[one.failed == failed] for one in (self.failing, self.stable)])

    def firsts(self) -> list[FirstAlarm]:
        """The scenario's first alarm in each failed run that raised one."""
        found = []
        for one in (self.failing, self.stable):
            for v, seed in np.argwhere(one.failed):
                run = one.raised[v][seed]
                found += sorted(run[c] for c in self.scenario.alarms if c in run)[:1]
        return found


def _share(flags: np.ndarray) -> float | None:
    return float(flags.mean()) if len(flags) else None


def counts(o: ScenarioOutcome) -> dict[str, list[int]]:
    """Seeds of either variant that failed, and that raised the scenario's alarm, at every value."""
    return {
        "failed": o.failing.failed.sum(1).tolist(),
        "stable failed": o.stable.failed.sum(1).tolist(),
        "alarms": o.failing.fired(o.scenario.alarms).sum(1).tolist(),
        "stable alarms": o.stable.fired(o.scenario.alarms).sum(1).tolist(),
    }


def verdict(outcomes: Sequence[ScenarioOutcome], undriven: Mapping[str, Sequence[Alarms]]) -> tuple[str, ...]:
    """Count the failures provoked, those where `stable` failed too, and the alarms.

    Args:
      outcomes: of the driven scenarios.
      undriven: preset → alarms of each seed where no knob is driven.
    """
    provoked = [o for o in outcomes if len(o.compared)]
    harmed = [f"{o.name} ({o.compared.sum()} of {len(o.compared)} runs)" for o in provoked if o.compared.any()]
    sentences = [
        f"{len(provoked)} of {len(outcomes)} failures were provoked; stable held in {len(provoked) - len(harmed)} of "
        "them."
    ]
    if harmed:
        sentences.append(f"It failed too in {'; '.join(harmed)}.")
    if len(provoked) < len(outcomes):
        sentences.append("Not provoked: " + "; ".join(o.name for o in outcomes if not len(o.compared)) + ".")
    failed, others = (np.concatenate([o.noticed(failed=f) for o in outcomes]) for f in (True, False))
    noticed = f"Alarms fired in {failed.mean():.0%} of {len(failed)} failed runs" if len(failed) else "No run failed"
    sentences.append(f"{noticed} and in {others.mean():.1%} of the {len(others)} others.")
    missed = {o.name: int((~o.noticed(failed=True)).sum()) for o in outcomes}
    if any(missed.values()):
        sentences.append("Failed without an alarm: " + "; ".join(f"{n} ({k})" for n, k in missed.items() if k) + ".")
    plain = "; ".join(f"{name}: {_alarm_counts(runs)}" for name, runs in undriven.items())
    return (*sentences, f"Where nothing is driven, all alarms together: {plain}.")


def _alarm_counts(runs: Sequence[Alarms]) -> str:
    found = {code: sum(code in run for run in runs) for run in runs for code in run}
    listed = ", ".join(f"{code} in {n}" for code, n in sorted(found.items()))
    return f"{listed} of {len(runs)} seeds" if found else f"none in {len(runs)} seeds"


def requirements(outcomes: Sequence[ScenarioOutcome]) -> tuple[Requirement, ...]:
    """No run of `stable` fails where the other variant does; alarms are reliable; R_tu's odds at its margin."""
    harmed = [
        Requirement(
            name=f"{o.name}: failed runs of stable",
            measured=float(o.compared.sum()),
            bound=0,
            better="lower",
            note=f"of {len(o.compared)} where {o.scenario.failing.name} fails",
        )
        for o in outcomes
    ]
    noticed, false = (_share(np.concatenate([o.noticed(failed=f) for o in outcomes])) for f in (True, False))
    shares: tuple[tuple[str, float | None, float, Literal["lower", "higher"]], ...] = (
        ("failed runs whose alarm fired", noticed, LEAST_NOTICED, "higher"),
        ("other runs whose alarm fired", false, MOST_FALSE, "lower"),
        ("tactile-use reward: false credit", _false_credit(Stable().tactile_margin), 0.12, "lower"),
        ("tactile-use reward: power", _power(Stable().tactile_margin), 0.5, "higher"),
    )
    return (
        *harmed,
        *(
            Requirement(name=name, measured=measured, bound=bound, better=better)
            for name, measured, bound, better in shares
            if measured is not None
        ),
    )


def summary_table(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """One line a scenario: the values at which either variant breaks, and how reliable the alarm is."""
    return named_table(
        "Where each breaks",
        [
            {
                "failure": o.name,
                "knob": f"{o.scenario.knob} ({o.scenario.failing.name})",
                "breaks": o.failing.breaks_at(o.values),
                "half": o.failing.breaks_at(o.values, 0.5),
                "stable": o.stable.breaks_at(o.values),
                "failed": int(o.compared.sum()),
                "of": len(o.compared),
                "alarm": _share(o.noticed(failed=True)),
                "false": _share(o.noticed(failed=False)),
            }
            for o in outcomes
        ],
        formats={"breaks": "g", "half": "g", "stable": "g", "alarm": ".2f", "false": ".2f"},
        meanings={
            "knob": "in brackets the variant that is compared with the stable preset",
            "breaks": "first value at which any seed of that variant fails",
            "half": "first value at which more than half of them do",
            "stable": "first value at which any seed of the stable preset fails",
            "failed": "runs of the stable preset that fail at values where the variant does",
            "of": "number of runs of the stable preset at these values",
            "alarm": "share of failed runs of both variants whose alarm fired",
            "false": "share of runs that did not fail whose alarm fired",
        },
    )


def criterion_table(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """The criterion of a failed seed, and how many seeds failed at each value."""

    def listed(o: ScenarioOutcome, one: VariantOutcome) -> str:
        numbers = zip(o.values, one.failed.sum(1), strict=True)
        return " · ".join(f"{value:g}:\N{NO-BREAK SPACE}{n}" for value, n in numbers)

    return named_table(
        "What counts as failed",
        [
            {
                "failure": o.name,
                "a seed has failed when": o.scenario.criterion,
                "seeds failed": listed(o, o.failing),
                "of stable": listed(o, o.stable),
            }
            for o in outcomes
        ],
        meanings={"seeds failed": "at each value of the knob", "of stable": "the same under the stable preset"},
    )


def alarm_table(outcomes: Sequence[ScenarioOutcome]) -> Table:
    """Share and time of each failure's alarm, in failed runs and in others."""
    rows: list[dict[str, Cell]] = []
    for o in outcomes:
        failed, others, firsts = o.noticed(failed=True), o.noticed(failed=False), o.firsts()
        bounds = [f"{r.code} {'<' if r.below else '>'} {r.bound:g}" for r in RULES if r.code in o.scenario.alarms]
        rows.append(
            {
                "failure": o.name,
                "alarm": ", ".join(bounds),
                "failed": len(failed),
                "noticed": int(failed.sum()),
                "number": float(np.median([f.value for f in firsts])) if firsts else None,
                "step": float(np.median([f.step for f in firsts])) if firsts else None,
                "others": len(others),
                "struck": int(others.sum()),
            }
        )
    return named_table(
        "What the alarms said",
        rows,
        formats={"number": ".2g", "step": ".0f"},
        meanings={
            "alarm": "codes of which any counts, with the bounds of their rules",
            "failed": "runs of both variants that failed",
            "noticed": "those whose alarm fired",
            "number": "that fired first, median over these runs",
            "step": "at which it fired first, median over these runs",
            "others": "runs of both variants that did not fail",
            "struck": "those whose alarm fired all the same",
        },
    )


def odds_table(margins: Sequence[float]) -> Table:
    """Exact probabilities that R_tu pays by chance and where touch helps, by its margin."""
    percent = lambda odds: " / ".join(f"{p:.0%}" for p in odds)
    return named_table(
        "The tactile-use reward by chance",
        [{"margin δ": m, "false credit": _false_credit(m), "power": _power(m)} for m in margins],
        formats={"margin δ": ".2f", "false credit": ".3f", "power": ".3f"},
        meanings={
            "false credit": "largest probability that a group is paid without a lead",
            "power": "probability that it is paid where touch helps",
        },
        note=(
            f"Groups of {GRPOConfig().group}, three controls of {Stable().controls} rollouts.  False credit: answers "
            "and controls alike over credits 0, .4, 1, worst over P(1) = .1 … .9 and every split of the rest.  Power: "
            f"{percent(HELPED)} with touch against {percent(HINDERED)} under controls."
        ),
    )


def _false_credit(margin: float) -> float:
    return false_credit(group=GRPOConfig().group, rollouts=Stable().controls, margin=margin)


def _power(margin: float) -> float:
    return credit_odds(HELPED, HINDERED, group=GRPOConfig().group, rollouts=Stable().controls, margin=margin)


def failure_picture(outcomes: Sequence[ScenarioOutcome]) -> Picture:
    """Share of failed seeds over the knob, one panel a failure; values are evenly spaced in the order driven."""
    panels = []
    for i, o in enumerate(outcomes):
        x, series = range(len(o.values)), []
        for name, one, colour in (
            ("paper or the named variant", o.failing, PALETTE[1]),
            ("stable", o.stable, PALETTE[0]),
        ):
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
        title="Share of seeds failed against the knob",
        caption="Each panel drives one failure, from left to right; values are not to scale.  Dotted: share of seeds "
        "that raised the failure's alarm.",
        content=draw(panels, columns=4),
    )
