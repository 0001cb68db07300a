"""Does each rung of the paper's ladder lift what it lifts there: ordinal credit OMAE, consistency CSC, SFT most of all?

    make experiment EXP=ablation_cumulative [ARGS="--scale smoke|gpu|paper"]

The rungs of Touch-R1's cumulative ablation (arXiv 2605.27154, tables (a) and (b)): the commonest levels, SFT, GRPO with
0/1 credit, ordinal credit, the consistency reward, the format reward, tactile grounding; and above them the credit for
the use of touch that only the abstract has.  All rungs of GRPO start from the SFT checkpoint of their seed and see the
same questions in the same order.  Each step is held against the paper's: its sign, intervals over seeds and objects,
p-values corrected over the table, and where the sign does not come out the known failures that the run shows.

Cost: some 25 minutes of one core with five seeds after `main_table`, whose policies it shares, 60 without; `--scale
smoke` under two.

Expected: SFT is by far the largest step.  Ordinal credit lowers OMAE by .02 to .05 against 0/1 credit; the consistency
reward makes slots agree and raises CSC little or not at all; format adds nothing after SFT.
"""

import itertools

from experiments.core.context import Context
from experiments.core.results import Requirement, Results
from experiments.paper import presets
from experiments.paper.aggregate import aggregate_table
from experiments.paper.deltas import FOUR, MEASURES, Delta, Step
from experiments.paper.eval_variants import untrained
from experiments.paper.experiment import bench_experiment
from experiments.paper.ladder_arms import LADDER, arms
from experiments.paper.ladder_tables import DIFFERS, attribute_table, delta_table, rung_table
from experiments.paper.outcome import CURVES, Outcome, delta_picture, find, outcome, phrase, shown
from experiments.study import paper_numbers as paper
from experiments.study.ablation import compared_pairs
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, study_settings
from experiments.study.study import SFT, StudyConfig, Way, run_study

UNTRAINED = "untrained"

STEPS = tuple(
    Step(
        arm=rung.name,
        against=below.name,
        adds=rung.adds,
        published=None
        if rung.published is None or below.published is None
        else tuple(a - b for a, b in zip(paper.LADDER[rung.published], paper.LADDER[below.published], strict=True)),
    )
    for below, rung in itertools.pairwise(LADDER)
)
"""Each rung against the one below it."""


def run(config: StudyConfig, context: Context) -> Results:
    """Train the rungs, compare each with the one below it, say why signs do not come out."""
    weights, algorithms = arms()
    ways = {UNTRAINED: Way(of=SFT, ask=untrained)}
    study = run_study(config, weights, context, algorithms, ways)
    with context.timed("compare"):
        result = outcome(study, STEPS, context)
    pictures, reliability = level_report(study)
    return Results(
        arms=result.scored.arms,
        baselines={**result.scored.baselines, UNTRAINED: shown(result.estimates[UNTRAINED])},
        settings=study_settings(config),
        comparisons=tuple(compared_pairs([(s.arm, s.against) for s in STEPS[1:]], result.estimates, config.seeds)),
        verdict=verdict(result),
        requirements=requirements(result.found),
        tables=(
            rung_table(result.estimates),
            delta_table(result.found, result.why, "What each rung changes", NOTE),
            attribute_table(result.estimates),
            *aggregate_table(result.scored.arms, SFT),
            *reliability,
            differences_table(DIFFERS),
        ),
        pictures=(*delta_picture(result.found, "What each rung changes"), *pictures),
        data=study.data.summary(),
        curves=CURVES,
        examples=rollout_examples(study, "grounding", PUBLISHED),
    )


NOTE = (
    "Each rung less the one below it. Five seeds leave p at .0625 or more before correction: over seeds the interval "
    "judges, over objects p does. OMAE should fall, CSC and Avg rise."
)


def requirements(found: tuple[Delta, ...]) -> tuple[Requirement, ...]:
    """The three signs that the paper rests on; none where a single seed leaves no interval."""
    if not found:
        return ()
    ordinal, consistency = find(found, "ordinal", "omae"), find(found, "consistency", "csc")
    bounds = []
    if ordinal is not None:
        name = "ordinal credit: change of OMAE"
        bounds.append(
            Requirement(name=name, measured=ordinal.seeds.mean, bound=0.0, better="lower", note=phrase(ordinal))
        )
    if consistency is not None:
        name, gain = "consistency: change of CSC", consistency.seeds.mean
        bounds.append(Requirement(name=name, measured=gain, bound=0.0, better="higher", note=phrase(consistency)))
    return (*bounds, _largest(found))


def _largest(found: tuple[Delta, ...]) -> Requirement:
    """In how many measures SFT changes more than any rung above it."""
    count = 0
    for measure in MEASURES:
        sizes = {d.step.arm: abs(d.seeds.mean) for d in found if d.measure == measure}
        count += sizes.get(SFT, 0.0) >= max(sizes.values())
    return Requirement(
        name="measures in which SFT is the largest step",
        measured=count,
        bound=len(MEASURES),
        better="higher",
        note="from the commonest levels, which stand for the paper's untrained base",
    )


def verdict(result: Outcome) -> tuple[str, ...]:
    """A sentence for SFT and for each step that the paper rests on, whichever way the figures fall."""
    if not result.found:
        return ("One seed: no step can be told from chance; train two seeds at least.",)
    said = []
    for arm, metric, words in (
        (SFT, FOUR, "SFT over the commonest levels"),
        ("ordinal", "omae", "Ordinal over 0/1 credit"),
        ("consistency", "csc", "The consistency reward"),
        ("format", FOUR, "The format reward"),
        ("grounding", FOUR, "Tactile grounding"),
    ):
        delta = find(result.found, arm, metric)
        if delta is not None:
            reasons = result.why.get(delta, ())
            said.append(f"{words}: {phrase(delta)}" + (f". {'; '.join(reasons)}." if reasons else "."))
    count = {sign: sum(d.sign == sign for d in result.found) for sign in ("reproduced", "opposite", "undecided")}
    said.append(
        f"Of {sum(count.values())} signs of the paper {count['reproduced']} come out beyond chance, "
        f"{count['opposite']} come out the other way, {count['undecided']} cannot be told."
    )
    return tuple(said)


EXPERIMENT = bench_experiment("ablation_cumulative", presets.BENCH, presets.SCALES, run)
