"""Does ordinal credit lower OMAE, the consistency reward raise CSC, and SFT help most, as in the paper's ablation?

    make experiment EXP=ablation_cumulative [ARGS="--scale smoke|gpu|paper"]

The arms of Touch-R1's cumulative ablation (arXiv 2605.27154, tables (a) and (b)) are the most frequent levels, SFT,
GRPO with 0/1 credit, ordinal credit, the consistency reward, the format reward and tactile grounding.  A last arm adds
the credit for the use of touch, which no equation of the paper contains.  All arms of GRPO start from the SFT
checkpoint of their seed and see the same questions in the same order.  The report compares each step with the paper's
by sign, intervals over seeds and objects, and a p-value over both, corrected for the three primary claims.  If the
sign differs, it lists the known failures of the run.

Cost: with five seeds, 50 minutes of one core; less if `main_table` has run, whose policies it shares; `--scale smoke`
under two.

Expected: SFT is by far the largest step.  No later step changes Avg by more than 1 point, CSC by more than 2 or OMAE
by more than .02, and none is better than SFT continued for the same time.  Under the published recipe, whose SFT is
weaker, ordinal credit lowers OMAE by .02 to .05, and GRPO loses accuracy on material, about which it asks no questions.
"""

import collections
import dataclasses
from collections.abc import Mapping

from experiments.core.context import Context
from experiments.core.results import Cell, Estimate, Requirement, Results, Table, at_least, at_most, named_table
from experiments.paper import presets
from experiments.paper.bench_scores import pooled_table
from experiments.paper.component_effects import (
    FOUR,
    LADDER_METRICS,
    ComponentComparison,
    ComponentStep,
    estimate_cell,
    run_components,
)
from experiments.paper.components import BASE, BASE_ROW, COMPONENTS, published_steps, reinforced
from experiments.study import paper_numbers as paper
from experiments.study.ablation import Ablation
from experiments.study.controls import control_sentences
from experiments.study.seed import TrainedPolicy
from experiments.study.stages import untrained
from experiments.study.study import SFT, EvalVariant, StudyConfig
from experiments.study.training import Recipe
from touchr1_jax.training.evaluation import Evaluation

UNTRAINED = "untrained"

BELOW = dict(zip([c.added.name for c in COMPONENTS], [BASE, *(c.added.name for c in COMPONENTS)], strict=False))
"""Arm of the ladder → the arm below it."""

STEPS = tuple(
    ComponentStep(arm=c.added.name, against=BELOW[c.added.name], component=c.name, published=published_steps()[c.name])
    for c in COMPONENTS
)

WEIGHTS, ALGORITHMS = reinforced(c.added for c in COMPONENTS)


def without_training(trained: TrainedPolicy) -> Evaluation:
    """The policy as it is before SFT."""
    params = untrained(trained.policy, trained.data, trained.seed)
    return trained.ask(params, trained.encode(params, "test"))


ABLATION = Ablation(
    arms=WEIGHTS,
    algorithms=ALGORITHMS,
    pairs=tuple((arm, BELOW[arm]) for arm in WEIGHTS),
    variants={UNTRAINED: EvalVariant(of=SFT, evaluate=without_training)},
    curves=presets.GRPO_CURVES,
    example="grounding",
)

TITLE = "Change by each component of the ladder"

NOTE = (
    "Each arm minus the one below it. Three hypotheses are primary: SFT raises Avg, ordinal credit lowers OMAE, the "
    "consistency reward raises CSC; their p-values are corrected for three, the others are exploratory."
)

ROWS: tuple[tuple[str, str | None, str], ...] = (
    (BASE, BASE_ROW, "–"),
    *((c.added.name, c.row, f"+ {c.name}") for c in COMPONENTS),
)
"""Of the ladder: arm, the paper's row, the component that the arm adds to the one above it."""

PER_ATTRIBUTE = {"h_acc": "H-Acc", "r_acc": "R-Acc", "p_acc": "P-Acc", "mat_acc": "Mat-Acc"}


def run(config: StudyConfig, context: Context) -> Results:
    """Train the arms, compare each with the one below it, diagnose the signs that do not come out."""
    found, results = run_components(ABLATION, STEPS, TITLE, NOTE, config, context)
    effects, *further = results.tables
    return dataclasses.replace(
        results,
        baselines={**results.baselines, UNTRAINED: found.reported(UNTRAINED)},
        verdict=(*verdict(found), *control_sentences(results.comparisons, WEIGHTS)),
        requirements=requirements(found),
        tables=(
            ladder_table(found.estimates),
            effects,
            attribute_table(found.estimates, config.recipe),
            *pooled_table(results.arms, SFT),
            *further,
            paper.differences_table(presets.DIFFERENCES),
        ),
    )


def ladder_table(estimates: Mapping[str, Mapping[str, Estimate]]) -> Table:
    """OMAE, CSC and the four-attribute mean of every arm of the ladder, and of the paper's rows."""
    rows: list[dict[str, Cell]] = []
    for arm, published, adds in ROWS:
        row: dict[str, Cell] = {"arm": arm, "adds": adds}
        for metric in LADDER_METRICS:
            row[metric.title] = estimate_cell(estimates[arm].get(metric.metric), metric.format.lstrip("+"))
            row[f"{metric.title}, paper"] = None if published is None else paper.LADDER[published][metric.column]
        rows.append(row)
    return named_table(
        "The ladder",
        rows,
        formats={f"{m.title}, paper": m.format.lstrip("+") for m in LADDER_METRICS},
        note="Means over seeds with 95 % intervals over objects. Avg is the mean of the four accuracies, which is what "
        "the paper's ladder prints under that name.",
    )


ASKED: Mapping[Recipe, str] = {
    "touch": "GRPO asks about all four.",
    "paper": "GRPO asks about hardness, roughness and protrusion; material is asked in the evaluation alone.",
}


def attribute_table(estimates: Mapping[str, Mapping[str, Estimate]], recipe: Recipe) -> Table:
    """Accuracy on each attribute of every arm of the ladder, and of the paper's table (b)."""
    rows: list[dict[str, Cell]] = []
    for arm, published, _ in ROWS:
        row: dict[str, Cell] = {"arm": arm}
        of_paper = paper.PER_ATTRIBUTE.get(published or "")
        for i, (metric, title) in enumerate(PER_ATTRIBUTE.items()):
            row[title] = estimate_cell(estimates[arm].get(metric), ".1f")
            row[f"{title}, paper"] = None if of_paper is None else of_paper[0][i]
        rows.append(row)
    return named_table(
        "Accuracy on each attribute",
        rows,
        formats={f"{title}, paper": ".1f" for title in PER_ATTRIBUTE.values()},
        units={column: "%" for title in PER_ATTRIBUTE.values() for column in (title, f"{title}, paper")},
        note=ASKED[recipe],
    )


def requirements(found: ComponentComparison) -> tuple[Requirement, ...]:
    """The three signs that the paper rests on, by the ends of intervals; none where a single seed leaves none."""
    if not found.effects:
        return ()
    bounds = []
    if (ordinal := found.effect("ordinal", "omae")) is not None:
        bounds.append(at_most("ordinal credit: change of OMAE, upper end", ordinal.seeds.high, 0.0, note=str(ordinal)))
    if (consistency := found.effect("consistency", "csc")) is not None:
        name = "consistency: change of CSC, lower end"
        bounds.append(at_least(name, consistency.seeds.low, 0.0, note=str(consistency)))
    largest = 0
    for metric in LADDER_METRICS:
        sizes = {e.step.arm: abs(e.seeds.mean) for e in found.effects if e.metric == metric}
        largest += sizes.get(SFT, 0.0) >= max(sizes.values())
    note = "from a constant answer, which replaces the paper's untrained base"
    name = "measures in which SFT is the largest step"
    return (*bounds, at_least(name, largest, len(LADDER_METRICS), note=note))


def verdict(found: ComponentComparison) -> tuple[str, ...]:
    """A sentence for SFT and for each step that the paper rests on, whichever way the figures fall."""
    if not found.effects:
        return ("One seed: no step can be distinguished from chance; train two seeds at least.",)
    sentences = []
    for arm, metric, subject in (
        (SFT, FOUR, "SFT compared with a constant answer"),
        ("ordinal", "omae", "Ordinal compared with 0/1 credit"),
        ("consistency", "csc", "The consistency reward"),
        ("format", FOUR, "The format reward"),
        ("grounding", FOUR, "Tactile grounding"),
    ):
        effect = found.effect(arm, metric)
        if effect is not None:
            reasons = found.failures.get(effect, ())
            sentences.append(f"{subject}: {'; '.join((str(effect), *reasons))}.")
    count = collections.Counter(e.sign for e in found.effects)
    known = len(found.effects) - count["not in the paper"]
    sentences.append(
        f"Of the signs of the paper's {known} changes {count['reproduced']} are reproduced, {count['opposite']} are "
        f"opposite, {count['undecided']} are undecided."
    )
    return tuple(sentences)


EXPERIMENT = presets.paper_experiment("ablation_cumulative", presets.BENCH, presets.SCALES, run)
