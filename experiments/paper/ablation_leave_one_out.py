"""Which component is missed when it is left out of the full objective?

    make experiment EXP=ablation_leave_one_out [ARGS="--scale smoke|gpu|paper"]

The full objective has every component that Touch-R1 names (arXiv 2605.27154): SFT, ordinal accuracy, consistency and
format rewards, tactile grounding, and the credit for the use of touch of its abstract.  Each is left out in turn:
without SFT, GRPO starts from fresh parameters; without the accuracy reward only consistency and format are paid;
without ordinal credit 0/1 credit takes its place.  All else is the same: seeds, questions, their order.  The paper has
a cumulative ladder alone, so the step of its ladder stands beside ours.

Cost: some 30 minutes of one core with five seeds after `ablation_cumulative`, whose policies it shares, 70 without;
`--scale smoke` under two.

Expected: without SFT every group earns nothing and nothing is learned (F7).  Without the accuracy reward slots agree
and are wrong (F2).  The other components matter less than seeds differ.
"""

import functools

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.paper import presets
from experiments.paper.aggregate import aggregate_table
from experiments.paper.deltas import FOUR, Step
from experiments.paper.eval_variants import without_sft
from experiments.paper.experiment import bench_experiment
from experiments.paper.ladder_arms import FULL, NO_SFT, OMISSIONS, WHOLE, omitted
from experiments.paper.ladder_tables import DIFFERS, delta_table
from experiments.paper.outcome import CURVES, Outcome, delta_picture, outcome, phrase, shown
from experiments.study import paper_numbers as paper
from experiments.study.ablation import compared_pairs
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, study_settings
from experiments.study.study import SFT, StudyConfig, Way, run_study

STEPS = tuple(
    Step(
        arm=FULL,
        against=o.name,
        adds=o.component,
        published=None
        if o.step is None
        else tuple(a - b for a, b in zip(*(paper.LADDER[row] for row in o.step), strict=True)),
        watched=o.name,
    )
    for o in OMISSIONS
)
"""The full objective against what is left without each component."""

NOTE = (
    "The full objective less what is left without the component. The paper's figure is the step of its cumulative "
    "ladder at which the component comes in, with fewer others around it. What shows is in the run without it."
)


def run(config: StudyConfig, context: Context) -> Results:
    """Train the full objective and every omission, compare."""
    weights, algorithms = omitted()
    ways = {NO_SFT: Way(of=SFT, ask=functools.partial(without_sft, PUBLISHED, WHOLE))}
    study = run_study(config, weights, context, algorithms, ways)
    with context.timed("compare"):
        result = outcome(study, STEPS, context)
    pictures, reliability = level_report(study)
    kept = [s for s in STEPS if s.against != NO_SFT]
    return Results(
        arms={**result.scored.arms, NO_SFT: shown(result.estimates[NO_SFT])},
        baselines=result.scored.baselines,
        settings=study_settings(config),
        comparisons=tuple(compared_pairs([(s.arm, s.against) for s in kept], result.estimates, config.seeds)),
        verdict=verdict(result),
        tables=(
            delta_table(result.found, result.why, "What each component is worth", NOTE),
            *aggregate_table(result.scored.arms, FULL),
            *reliability,
            differences_table(DIFFERS),
        ),
        pictures=(*delta_picture(result.found, "What each component is worth"), *pictures),
        data=study.data.summary(),
        curves=CURVES,
        examples=rollout_examples(study, FULL, PUBLISHED),
    )


def verdict(result: Outcome) -> tuple[str, ...]:
    """What is missed beyond chance, in accuracy; and what is not."""
    if not result.found:
        return ("One seed: nothing can be told from chance; train two seeds at least.",)
    by_component = {d.step.adds: d for d in result.found if d.measure.metric == FOUR}
    missed = [d for d in by_component.values() if d.seeds.low > 0]
    better = [d for d in by_component.values() if d.seeds.high < 0]
    rest = [name for name, d in by_component.items() if d not in missed and d not in better]
    said = [f"{d.step.adds} is missed: {phrase(d)}." for d in missed]
    said += [f"Without {d.step.adds} answers are better: {phrase(d)}." for d in better]
    return (*said, *([f"No difference in accuracy beyond seeds: {', '.join(rest)}."] if rest else []))


EXPERIMENT = bench_experiment("ablation_leave_one_out", presets.BENCH, presets.SCALES, run)
