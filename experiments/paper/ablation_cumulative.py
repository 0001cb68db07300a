"""Does each step of the paper's ladder help what it helps there: ordinal credit OMAE, consistency CSC, SFT most?

    make experiment EXP=ablation_cumulative [ARGS="--scale smoke|gpu|paper"]

The arms of Touch-R1's cumulative ablation (arXiv 2605.27154, tables (a) and (b)): the commonest levels, SFT, GRPO with
0/1 credit, ordinal credit, the consistency reward, the format reward, tactile grounding; and above them the credit for
the use of touch that only the abstract has.  All arms of GRPO start from the SFT checkpoint of their seed and see the
same questions in the same order.  Each step is compared with the paper's: its sign, intervals over seeds and objects,
p-values corrected over the table, and where the sign does not come out the known failures that the run shows.

Cost: some 25 minutes of one core with five seeds after `main_table`, whose policies it shares, 60 without; `--scale
smoke` under two.

Expected: SFT is by far the largest step.  Ordinal credit lowers OMAE by .02 to .05 against 0/1 credit; the consistency
reward makes slots agree and raises CSC little or not at all; format adds nothing after SFT.
"""

import collections
import dataclasses

from experiments.core.context import Context
from experiments.core.results import Requirement, Results
from experiments.paper import presets
from experiments.paper.bench_scores import pooled_table
from experiments.paper.component_effects import (
    FOUR,
    LADDER_METRICS,
    ComponentComparison,
    ComponentEffect,
    ComponentStep,
    compare_components,
    find_effect,
)
from experiments.paper.component_report import attribute_table, effects_picture, effects_table, ladder_table
from experiments.paper.components import BASE, COMPONENTS, published_steps, reinforced
from experiments.paper.eval_variants import untrained
from experiments.study.ablation import Ablation, run_ablation
from experiments.study.paper_numbers import differences_table
from experiments.study.study import SFT, EvalVariant, StudyConfig

UNTRAINED = "untrained"

BELOW = dict(zip([c.added.name for c in COMPONENTS], [BASE, *(c.added.name for c in COMPONENTS)], strict=False))
"""Arm of the ladder → the arm below it."""

STEPS = tuple(
    ComponentStep(arm=c.added.name, against=BELOW[c.added.name], component=c.name, published=published_steps()[c.name])
    for c in COMPONENTS
)

WEIGHTS, ALGORITHMS = reinforced(c.added for c in COMPONENTS)

ABLATION = Ablation(
    arms=WEIGHTS,
    algorithms=ALGORITHMS,
    pairs=tuple((arm, BELOW[arm]) for arm in WEIGHTS),
    variants={UNTRAINED: EvalVariant(of=SFT, evaluate=untrained)},
    curves=presets.GRPO_CURVES,
    example="grounding",
)

TITLE = "Change by each component of the ladder"

NOTE = (
    "Each arm minus the one below it. With five seeds p is .0625 or more before correction: over seeds judge by the "
    "interval, over objects by p. OMAE should fall, CSC and Avg rise."
)


def run(config: StudyConfig, context: Context) -> Results:
    """Train the arms, compare each with the one below it, diagnose the signs that do not come out."""
    study, scored, results = run_ablation(ABLATION, config, context)
    with context.timed("compare"):
        found = compare_components(study, scored, STEPS, context)
    return dataclasses.replace(
        results,
        baselines={**results.baselines, UNTRAINED: found.reported(UNTRAINED)},
        verdict=verdict(found),
        requirements=requirements(found.effects),
        tables=(
            ladder_table(found.estimates),
            effects_table(found, TITLE, NOTE),
            attribute_table(found.estimates),
            *pooled_table(results.arms, SFT),
            *results.tables,
            differences_table(presets.DIFFERENCES),
        ),
        pictures=(*effects_picture(found.effects, TITLE), *results.pictures),
    )


def requirements(effects: tuple[ComponentEffect, ...]) -> tuple[Requirement, ...]:
    """The three signs that the paper rests on; none where a single seed leaves no interval."""
    if not effects:
        return ()
    bounds = []
    ordinal, consistency = find_effect(effects, "ordinal", "omae"), find_effect(effects, "consistency", "csc")
    if ordinal is not None:
        name, change = "ordinal credit: change of OMAE", ordinal.seeds.mean
        bounds.append(Requirement(name=name, measured=change, bound=0.0, better="lower", note=str(ordinal)))
    if consistency is not None:
        name, change = "consistency: change of CSC", consistency.seeds.mean
        bounds.append(Requirement(name=name, measured=change, bound=0.0, better="higher", note=str(consistency)))
    return (*bounds, _sft_is_largest(effects))


def _sft_is_largest(effects: tuple[ComponentEffect, ...]) -> Requirement:
    """In how many metrics SFT changes more than any step above it."""
    count = 0
    for metric in LADDER_METRICS:
        sizes = {e.step.arm: abs(e.seeds.mean) for e in effects if e.metric == metric}
        count += sizes.get(SFT, 0.0) >= max(sizes.values())
    return Requirement(
        name="measures in which SFT is the largest step",
        measured=count,
        bound=len(LADDER_METRICS),
        better="higher",
        note="from the commonest levels, which stand for the paper's untrained base",
    )


def verdict(found: ComponentComparison) -> tuple[str, ...]:
    """A sentence for SFT and for each step that the paper rests on, whichever way the figures fall."""
    if not found.effects:
        return ("One seed: no step can be distinguished from chance; train two seeds at least.",)
    sentences = []
    for arm, metric, subject in (
        (SFT, FOUR, "SFT over the commonest levels"),
        ("ordinal", "omae", "Ordinal over 0/1 credit"),
        ("consistency", "csc", "The consistency reward"),
        ("format", FOUR, "The format reward"),
        ("grounding", FOUR, "Tactile grounding"),
    ):
        effect = find_effect(found.effects, arm, metric)
        if effect is not None:
            reasons = found.failures.get(effect, ())
            sentences.append(f"{subject}: {effect}" + (f". {'; '.join(reasons)}." if reasons else "."))
    count = collections.Counter(e.sign for e in found.effects)
    known = len(found.effects) - count["not in the paper"]
    sentences.append(
        f"Of {known} signs of the paper {count['reproduced']} come out beyond chance, {count['opposite']} come out the "
        f"other way, {count['undecided']} cannot be decided."
    )
    return tuple(sentences)


EXPERIMENT = presets.paper_experiment("ablation_cumulative", presets.BENCH, presets.SCALES, run)
