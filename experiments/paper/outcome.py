"""From a study of rungs to its results: rows, differences with their diagnoses, report."""

import dataclasses
from collections.abc import Mapping, Sequence

from experiments.core.context import Context, read_metrics
from experiments.core.results import Estimate, Picture
from experiments.paper.deltas import FOUR, Delta, Step, deltas, with_four
from experiments.paper.diagnosis import Case, course_of, diagnose
from experiments.paper.ladder_charts import delta_chart
from experiments.study.baselines import baselines
from experiments.study.estimates import estimate
from experiments.study.scores import Scored, score, score_study
from experiments.study.study import Study
from touchr1_jax.bench.metrics import Scores

CURVES: Mapping[str, tuple[str, ...]] = {
    "sft": ("loss", "token_accuracy"),
    "blind": ("loss",),
    "grpo": (
        "reward",
        "accuracy",
        "middle_rate",
        "echo_share",
        "entropy",
        "grounding",
        "degenerate_share",
        "parse_rate",
        "kl",
    ),
}
"""Of each phase the scalars that are drawn."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the tables are made of.

    Attributes:
      scored: rows and estimates of all policies and baselines.
      rows: row → seed → metric, `FOUR` and the further policies among them.
      estimates: row → metric of the same.
      found: differences of the steps.
      why: failures that show where a sign of the paper does not come out.
    """

    scored: Scored
    rows: Mapping[str, Sequence[Mapping[str, Scores]]]
    estimates: Mapping[str, Mapping[str, Estimate]]
    found: tuple[Delta, ...]
    why: Mapping[Delta, tuple[str, ...]]


def outcome(study: Study, steps: Sequence[Step], context: Context) -> Outcome:
    """Score everything that was asked, compare the steps, and look why signs do not come out."""
    scored = score_study(study)
    said = {**study.answers, **{name: [one] for name, one in baselines(study).items()}, **study.further}
    plain = {**scored.rows, **{name: [score(study, one) for one in seeds] for name, seeds in study.further.items()}}
    rows = {
        name: [with_four(scores, one) for scores, one in zip(seeds, said[name], strict=True)]
        for name, seeds in plain.items()
    }
    estimates = {name: _estimates(name, seeds, scored) for name, seeds in rows.items()}
    found = deltas(steps, rows, scored.objects) if study.config.seeds > 1 else ()
    return Outcome(
        scored=scored, rows=rows, estimates=estimates, found=found, why=_reasons(study, found, estimates, context)
    )


def find(found: Sequence[Delta], arm: str, metric: str) -> Delta | None:
    """The difference that an arm makes in a measure."""
    return next((d for d in found if d.step.arm == arm and d.measure.metric == metric), None)


def delta_picture(found: Sequence[Delta], title: str) -> tuple[Picture, ...]:
    """The chart of all differences; none with a single seed."""
    if not found:
        return ()
    caption = (
        "Change that each component makes. The paper prints single numbers; its Avg of the ladder is the mean of four "
        "accuracies, and so is ours here."
    )
    return (Picture(name="changes", title=title, caption=caption, content=delta_chart(found)),)


def phrase(delta: Delta) -> str:
    """A difference in words."""
    spec = delta.measure.format
    number = lambda x: format(x, spec).replace("-", "−")
    published = "" if delta.published is None else f"; paper {number(delta.published)}"
    return (
        f"{delta.measure.title} {number(delta.seeds.mean)} [{number(delta.seeds.low)}, {number(delta.seeds.high)}], "
        f"p = {delta.p_seeds:.2f} over seeds and {delta.p_objects:.3f} over objects{published} ({delta.sign})"
    )


def _estimates(name: str, seeds: Sequence[Mapping[str, Scores]], scored: Scored) -> dict[str, Estimate]:
    """Those of a row that are known already, and the others."""
    known = scored.estimates.get(name, {})
    return {
        metric: known[metric] if metric in known else estimate([seed[metric] for seed in seeds], scored.objects)
        for metric in seeds[0]
    }


def _reasons(
    study: Study, found: Sequence[Delta], estimates: Mapping[str, Mapping[str, Estimate]], context: Context
) -> dict[Delta, tuple[str, ...]]:
    lines = read_metrics(context.directory)
    means = {name: {metric: e.mean for metric, e in row.items()} for name, row in estimates.items()}
    why = {}
    for delta in found:
        step = delta.step
        watched, other = (step.arm, step.against) if step.watched != step.against else (step.against, step.arm)
        if step.watched is not None or delta.sign in ("opposite", "undecided"):
            case = Case(
                course=course_of(lines, watched),
                after=means[watched],
                before=means[other],
                consistency="consistency" in study.arms.get(watched, {}),
            )
            why[delta] = diagnose(case) or (() if delta.sign == "reproduced" else (_noise(delta),))
    return why


def _noise(delta: Delta) -> str:
    """What is left to say where no known failure shows: how large an effect these seeds could have told."""
    half = (delta.seeds.high - delta.seeds.low) / 2
    published = "" if delta.published is None else f", the paper prints {delta.published:+.2g}".replace("-", "−")
    return f"no known failure shows; these seeds tell changes beyond {half:.2g}{published}"


def shown(estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """The metrics of a row that a report knows; the mean over four attributes stands in its own tables."""
    return {metric: value for metric, value in estimates.items() if metric != FOUR}
