"""The effect of each component: differences of arms with intervals and corrected p-values, next to the paper's."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw, estimates
from experiments.core.context import Context
from experiments.core.look import PALETTE, SHARED
from experiments.core.loops import ALARM, fired_alarms
from experiments.core.metric_log import by_stage, read_metrics
from experiments.core.results import Estimate, Picture, Results, Table, named_table
from experiments.core.text import bounds, interval, number
from experiments.study.ablation import Ablation, run_ablation
from experiments.study.estimates import RESAMPLES, SeedScores, estimate
from experiments.study.scores import Scored, baselines, score
from experiments.study.study import Study, StudyConfig
from touchr1_jax.bench.metrics import Scores, mean_accuracy
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap, crossed_test, holm, student_interval
from touchr1_jax.rl.alarms import RULES, START, WINDOW

FOUR = "four_acc"
"""Mean accuracy over hardness, roughness, protrusion and material: what the paper's ladder prints as Avg."""

MOST = 0.5
"""Share of seeds in which an alarm fires, of groups of equal rewards, or of entropy that is left: a failure shows."""

POINTS = 2.0  # change of a share, in points, that counts: about the spread between seeds


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingHistory:
    """Metrics of an arm's training, means over seeds of the first and of the last steps, and its alarms.

    `alarms` maps a code to the share of seeds in which it fired.
    """

    start: Mapping[str, float]
    end: Mapping[str, float]
    alarms: Mapping[str, float]


def training_history(lines: Iterable[Mapping[str, Any]], arm: str) -> TrainingHistory | None:
    """The training of an arm from the lines of `metrics.jsonl`; `None` where GRPO did not train it."""
    stages = by_stage(line for line in lines if line["stage"].startswith(f"grpo/{arm}/"))
    if not stages:
        return None
    seeds = [sorted(rows, key=lambda line: line["step"]) for rows in stages.values()]
    fired = [fired_alarms(rows) for rows in seeds]
    return TrainingHistory(
        start=_means([rows[:START] for rows in seeds]),
        end=_means([rows[-WINDOW:] for rows in seeds]),
        alarms={code: sum(code in one for one in fired) / len(fired) for code in sorted(set().union(*fired))},
    )


def _means(seeds: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, float]:
    names = set.intersection(*({n for line in rows for n in line if not n.startswith(ALARM)} for rows in seeds))
    return {
        name: float(np.mean([np.mean([line[name] for line in rows if name in line]) for rows in seeds]))
        for name in sorted(names - {"stage", "step"})
    }


def diagnose(
    history: TrainingHistory | None,
    before: Mapping[str, float],
    after: Mapping[str, float],
    *,
    consistency: bool = False,
) -> Iterator[str]:
    """The known failures that an arm shows against another, each with its code and the figures.

    F1 ordinal credit favours the middle level; F2 slots copy each other for the consistency reward,
    which also drives the middle level out, since sensors disagree most about middle objects; F7 groups of equal rewards
    give no gradient; F9 entropy collapses; F13 unparsable answers are rewarded; all others by the alarms.

    Args:
      history: the arm's training, if GRPO trained it.
      before, after: means of the other and of the arm on the test questions.
      consistency: whether the arm is rewarded for consistency.
    """
    history, both = history or TrainingHistory(start={}, end={}, alarms={}), before.keys() & after.keys()
    # of two rules with one code the gradual one, which comes last, gives the meaning
    meanings = {rule.code: rule.meaning for rule in sorted(RULES, key=lambda rule: not rule.at_once)}
    for code, share in history.alarms.items():
        if share >= MOST:
            yield f"{code}: {meanings[code]} (alarm in {100 * share:.0f} % of the seeds)"
    if "middle_rate" in both:
        middle = f"{before['middle_rate']:.0f} → {after['middle_rate']:.0f} %"
        if after["middle_rate"] - before["middle_rate"] > POINTS:
            yield f"F1: middle answers {middle}"
        if before["middle_rate"] - after["middle_rate"] > POINTS:
            code, why = ("F2", "the consistency reward") if consistency else ("F9", "lower entropy")
            yield f"{code}: {why} suppresses the middle level, {middle} of the answers"
    if {"csc_slot", "csc"} <= both:
        slots, right = (after[m] - before[m] for m in ("csc_slot", "csc"))
        if slots > POINTS and right < slots - POINTS:
            yield f"F2: CSC-slot {number(slots, '+.0f')} points, CSC {number(right, '+.0f')}"
    if (degenerate := history.end.get("drawn_degenerate_share", history.end.get("degenerate_share", 0.0))) > MOST:
        yield f"F7: in {100 * degenerate:.0f} % of the groups all rewards are equal, which gives no gradient"
    first, last = (steps.get("entropy", 0.0) for steps in (history.start, history.end))
    if "entropy" in history.end and first > 0 and last < MOST * first:
        yield f"F9: entropy {first:.3f} → {last:.3f} nat a token"
    if "parse_rate" in both and before["parse_rate"] - after["parse_rate"] > POINTS:
        yield f"F13: parsed answers {before['parse_rate']:.0f} → {after['parse_rate']:.0f} %"


PRIMARY = {("SFT", FOUR), ("ordinal credit", "omae"), ("consistency", "csc")}
"""Component and metric of the three claims that the paper rests on; all other effects are exploratory."""

LEVEL = 0.05  # p-value below which a sign counts

SignVerdict = Literal["reproduced", "opposite", "undecided", "not in the paper"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class LadderMetric:
    """A column of the paper's ladder: our metric, the column's title and position, its format."""

    metric: str
    title: str
    column: int
    format: str


LADDER_METRICS: tuple[LadderMetric, ...] = (
    LadderMetric(metric="omae", title="OMAE", column=0, format="+.3f"),
    LadderMetric(metric="csc", title="CSC", column=1, format="+.1f"),
    LadderMetric(metric=FOUR, title="Avg", column=2, format="+.1f"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComponentStep:
    """`arm`, which has a component, against another, and the paper's change in the columns of `LADDER_METRICS`.

    With `omission` the run of `against` is searched for failures whatever comes out; else that of `arm`, and only where
    the paper's sign does not come out.
    """

    arm: str
    against: str
    component: str
    published: tuple[float, ...] | None
    omission: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComponentEffect:
    """A step in one metric: the difference with intervals over training seeds and over objects.

    `p_value` is that of `crossed_test` over seeds and objects at once; Holm's method corrects those of `PRIMARY`.
    """

    step: ComponentStep
    metric: LadderMetric
    seeds: Interval
    objects: Interval
    p_value: float

    @property
    def primary(self) -> bool:
        """True for one of the claims in `PRIMARY`."""
        return (self.step.component, self.metric.metric) in PRIMARY

    @property
    def published(self) -> float | None:
        """The paper's difference."""
        return None if self.step.published is None else self.step.published[self.metric.column]

    @property
    def sign(self) -> SignVerdict:
        """Agreement with the paper's sign, significant over seeds and objects: reproduced, opposite, or undecided."""
        if self.published is None or self.published == 0:
            return "not in the paper"
        if self.p_value >= LEVEL:
            return "undecided"
        return "reproduced" if np.sign(self.seeds.mean) == np.sign(self.published) else "opposite"

    def __str__(self) -> str:
        spec = self.metric.format
        published = "" if self.published is None else f"; paper {number(self.published, spec)}"
        return (
            f"{self.metric.title} {number(self.seeds.mean, spec)} {bounds(self.seeds.low, self.seeds.high, spec)}, "
            f"p = {self.p_value:.2g} over seeds and objects{published} ({self.sign})"
        )


def component_effects(
    steps: Sequence[ComponentStep], rows: Mapping[str, SeedScores], objects: np.ndarray
) -> tuple[ComponentEffect, ...]:
    """Every step in every metric of the ladder that both of its arms have, two seeds at least.

    An arm of one seed, a baseline, is compared with every seed of the other; `objects` [N] is that of each question.
    """
    found = [
        _effect(step, metric, *_paired(step, metric.metric, rows), objects)
        for step in steps
        for metric in LADDER_METRICS
        if all(metric.metric in rows[name][0] for name in (step.arm, step.against))
    ]
    corrected = iter(holm(np.array([e.p_value for e in found if e.primary])).tolist())
    return tuple(dataclasses.replace(e, p_value=next(corrected)) if e.primary else e for e in found)


def _paired(step: ComponentStep, metric: str, rows: Mapping[str, SeedScores]) -> tuple[list[Scores], list[Scores]]:
    a, b = ([seed[metric] for seed in rows[name]] for name in (step.arm, step.against))
    count = max(len(a), len(b))
    if count < 2 or {len(a), len(b)} - {1, count}:
        raise ValueError(
            f"{step.arm} and {step.against} have {len(a)} and {len(b)} seeds: must have the same number, two at least, "
            "or one of a baseline; train the missing ones"
        )
    return a * (count // len(a)), b * (count // len(b))


def _effect(
    step: ComponentStep, metric: LadderMetric, a: list[Scores], b: list[Scores], objects: np.ndarray
) -> ComponentEffect:
    per_seed = np.array([x.mean() - y.mean() for x, y in zip(a, b, strict=True)])
    differences = np.stack([x.values - y.values for x, y in zip(a, b, strict=True)])
    where = {"clusters": objects[a[0].items], "strata": a[0].strata}
    return ComponentEffect(
        step=step,
        metric=metric,
        seeds=student_interval(per_seed),
        objects=clustered_bootstrap(differences.mean(axis=0), **where, resamples=RESAMPLES),
        p_value=crossed_test(differences, **where),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComponentComparison:
    """The rows of a ladder, `FOUR` among their metrics, and what its steps change; a single seed has no effects.

    `failures` are those that show in the runs behind an effect.
    """

    estimates: Mapping[str, Mapping[str, Estimate]]
    effects: tuple[ComponentEffect, ...]
    failures: Mapping[ComponentEffect, tuple[str, ...]]

    def reported(self, row: str) -> dict[str, Estimate]:
        """The metrics of a row that `Results` knows; `FOUR` stands in the ladder's own tables."""
        return {metric: value for metric, value in self.estimates[row].items() if metric != FOUR}

    def effect(self, arm: str, metric: str) -> ComponentEffect | None:
        """The effect of a step's arm on a metric."""
        return next((e for e in self.effects if e.step.arm == arm and e.metric.metric == metric), None)


def run_components(
    ablation: Ablation, steps: Sequence[ComponentStep], title: str, note: str, config: StudyConfig, context: Context
) -> tuple[ComponentComparison, Results]:
    """Train the arms and compare the steps; the results begin with the table and the chart of the effects."""
    study, scored, results = run_ablation(ablation, config, context)
    with context.timed("compare"):
        found = compare_components(study, scored, steps, context)
    tables = (effects_table(found, title, note), *results.tables)
    pictures = (*effects_picture(found.effects, title), *results.pictures)
    return found, dataclasses.replace(results, tables=tables, pictures=pictures)


def compare_components(
    study: Study, scored: Scored, steps: Sequence[ComponentStep], context: Context
) -> ComponentComparison:
    """Score all answers with `FOUR`, compare the steps, and diagnose the runs whose signs do not come out."""
    answers = {**study.answers, **{name: [one] for name, one in baselines(study).items()}, **study.variants}
    plain = {**scored.rows, **{name: [score(study, one) for one in seeds] for name, seeds in study.variants.items()}}
    rows = {
        name: [
            {**scores, FOUR: mean_accuracy(np.asarray(one.parsed.conclude), one.label)}
            for scores, one in zip(seeds, answers[name], strict=True)
        ]
        for name, seeds in plain.items()
    }
    found = {
        name: {
            metric: scored.estimates.get(name, {}).get(metric) or estimate([s[metric] for s in seeds], scored.objects)
            for metric in seeds[0]
        }
        for name, seeds in rows.items()
    }
    effects = component_effects(steps, rows, scored.objects) if study.config.seeds > 1 else ()
    means = {name: {metric: e.mean for metric, e in row.items()} for name, row in found.items()}
    lines, failures = read_metrics(context.directory), {}
    for effect in effects:
        step = effect.step
        if not step.omission and effect.sign not in ("opposite", "undecided"):
            continue
        arm, other = (step.against, step.arm) if step.omission else (step.arm, step.against)
        consistency = "consistency" in study.arms.get(arm, {})
        shown = tuple(diagnose(training_history(lines, arm), means[other], means[arm], consistency=consistency))
        failures[effect] = shown or (() if effect.sign == "reproduced" else (_no_failure(effect),))
    return ComponentComparison(estimates=found, effects=effects, failures=failures)


def _no_failure(effect: ComponentEffect) -> str:
    """Where no known failure shows: the least effect that these seeds could have detected."""
    half = (effect.seeds.high - effect.seeds.low) / 2
    published = "" if effect.published is None else f", the paper prints {number(effect.published, '+.2g')}"
    return f"no known failure shows; these seeds detect changes beyond {half:.2g}{published}"


def effects_table(found: ComponentComparison, title: str, note: str) -> Table:
    """The change that each component makes, its sign compared with the paper's, and the failures behind it."""
    return named_table(
        title,
        [
            {
                "component and metric": f"{e.step.component}: {e.metric.title}",
                "change": number(e.seeds.mean, e.metric.format),
                "95 % over seeds": bounds(e.seeds.low, e.seeds.high, e.metric.format),
                "95 % over objects": bounds(e.objects.low, e.objects.high, e.metric.format),
                "p": e.p_value,
                "hypothesis": "primary" if e.primary else "exploratory",
                "paper": number(e.published, e.metric.format),
                "sign": e.sign,
                "failures": "; ".join(found.failures.get(e, ())),
            }
            for e in found.effects
        ],
        formats={"p": ".2g"},
        meanings={
            "95 % over seeds": "Student's t over paired seeds",
            "95 % over objects": "whole objects resampled, seeds pooled",
            "p": "of Student's t over seeds and objects at once; those of the primary hypotheses are corrected (Holm)",
            "hypothesis": "primary: named before the run, the claims that the paper rests on; exploratory: uncorrected",
            "paper": "difference of the rows of its ladder",
            "sign": f"reproduced or opposite where p < {LEVEL:g}, else undecided",
            "failures": "known failures that the run shows",
        },
        note=note,
    )


def effects_picture(effects: Sequence[ComponentEffect], title: str) -> tuple[Picture, ...]:
    """The chart of all effects, one panel for each metric; none with a single seed."""
    if not effects:
        return ()
    components = list(dict.fromkeys(e.step.component for e in effects))

    def panel(metric: LadderMetric) -> Panel:
        of = [e for e in effects if e.metric == metric]
        at = [float(components.index(e.step.component)) for e in of]
        known = [(e.published, place) for e, place in zip(of, at, strict=True) if e.published is not None]
        seeds = estimates("here, 95 % over seeds", [e.seeds for e in of], colour=PALETTE[0], marker="o", width=2.4)
        low, high = ([getattr(e.objects, end) for e in of] for end in ("low", "high"))
        look: dict[str, Any] = {"colour": PALETTE[0], "marker": "", "width": 1.0, "alpha": 0.5, "shift": 0.12}
        objects = Series("95 % over objects", x=[e.seeds.mean for e in of], y=at, low=low, high=high, **look)
        x, y = ([pair[i] for pair in known] for i in (0, 1))
        published = Series("paper", x=x, y=y, colour=PALETTE[1], marker="D", hollow=True, shift=-0.2)
        return Panel(
            [dataclasses.replace(seeds, y=at), objects, published],
            rows=[f"+ {component}" for component in components],
            x_label=f"change of {metric.title}",
            rules=[Rule(x=0, line="-", colour=SHARED)],
        )

    caption = (
        "Change that each component makes. The paper prints single numbers; its Avg of the ladder is the mean of four "
        "accuracies, and so is ours here."
    )
    panels = [panel(metric) for metric in dict.fromkeys(e.metric for e in effects)]
    return (Picture(name="changes", title=title, caption=caption, content=draw(panels, share_y=True)),)


def estimate_cell(found: Estimate | None, spec: str) -> str | None:
    """A cell with an estimate and its interval; empty where the metric is not measured."""
    return None if found is None else interval(found, spec)
