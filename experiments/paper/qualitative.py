"""What do answers look like where touch decides, where sight lies, and where they fail?

    make experiment EXP=qualitative [ARGS="--scale smoke|gpu|paper"]

A browser of rollouts over the bench: frames, forces, fields at the strongest press, the trace with its parsed slots,
the reward term by term, and beside it what the same policy says without its touch, with noise, with another object's
touch, with the frames in another order, and what SFT and a policy without touch say.  Cases and items are chosen by
rule, the first that fit in the order of the data; a table says how common each case is, which examples cannot.

Cost: a minute of one core after `main_table`, whose policy it asks, seven without; `--scale smoke` under one.

Expected: answers that are right become wrong with another object's touch; where a picture leads a policy without touch
astray, touch overrules it in about half of the questions (`conflict`), about the material least often.
"""

import dataclasses

import numpy as np

from experiments.bench.draw import Quota
from experiments.core.context import Context
from experiments.core.results import Results, RolloutExample
from experiments.paper import presets
from experiments.paper.cases import Case, Said, Shown, case_table, cases, first_of, items_shown
from experiments.paper.conflict_metrics import Asked, asked_of
from experiments.paper.eval_variants import control_name, under_controls
from experiments.paper.experiment import bench_experiment
from experiments.paper.ladder_arms import FULL
from experiments.paper.ladder_tables import DIFFERS
from experiments.paper.outcome import CURVES
from experiments.paper.questions import answered, questions, touch_rows
from experiments.study.answers import Evaluated
from experiments.study.examples import rollouts_of
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, score_study, study_settings
from experiments.study.study import BLIND, SFT, Study, StudyConfig, run_study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.grounding import CONTROLS
from touchr1_jax.rl.config import Paper

STRANGE = "swapped"
"""The control that shows another object's touch."""

INSTEAD = {
    "drop": "nothing",
    "noise": "noise of each sensor",
    STRANGE: "another object's touch",
    "shuffle": "its frames in another order",
}
"""Controls, as the browser calls what stands in the place of the touch."""

ALSO = {SFT: "its own touch, before GRPO", BLIND: "nothing, and a policy trained so"}
"""Other policies, in the same table."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class QualitativeConfig:
    """The study, the bench's items that are drawn, and how many answers of each case are shown."""

    study: StudyConfig = dataclasses.replace(presets.BENCH, seeds=1)
    quota: Quota = Quota()
    shown: int = 2


def run(config: QualitativeConfig, context: Context) -> Results:
    """Train one seed, ask in every way, choose, show."""
    study = run_study(config.study, {FULL: PUBLISHED}, context, {FULL: Paper()}, under_controls(FULL))
    scored = score_study(study)
    asked = asked_questions(study)
    found = cases(asked, said(study))
    asks = questions(study.data, config.quota, context)
    items = items_shown(
        asks,
        answered(study.data, asks, study.answers[FULL][:1])[0],
        touch_rows(study.data),
        study.answers[FULL][0],
    )
    return Results(
        arms=scored.arms,
        baselines=scored.baselines,
        settings=study_settings(config.study),
        verdict=verdict(found),
        tables=(case_table(found), differences_table((*DIFFERS[:3], *HERE))),
        data=study.data.summary() | {"items of the bench": len(asks)},
        curves=CURVES,
        examples=browser(study, asked, found, items, config.shown),
    )


HERE = (
    ("examples", "two kinds, chosen", "every case of the table, the first by the order of the data"),
    ("traces", "free text", "the slots of a fixed form"),
    ("counterfactual answers", "none", "five, beside every trace"),
)
"""What differs besides."""


def asked_questions(study: Study) -> Asked:
    """The questions about the test contacts."""
    test = study.data.parts["test"]
    return asked_of(study.answers[SFT][0], study.data.object_ids[test], study.data.visual_lies[test], ATTRIBUTES)


def said(study: Study) -> Said:
    """What the policies of the first seed concluded."""
    first = {name: seeds[0] for name, seeds in {**study.answers, **study.further}.items()}
    return Said.of(first[FULL], first[SFT], first[BLIND], first[control_name(FULL, STRANGE)])


def browser(
    study: Study, asked: Asked, found: tuple[Case, ...], items: list[Shown], count: int
) -> tuple[RolloutExample, ...]:
    """The cards of every case, then those of the items."""
    instead: dict[str, Evaluated] = {INSTEAD[c]: study.further[control_name(FULL, c)][0] for c in CONTROLS}
    instead |= {title: study.answers[policy][0] for policy, title in ALSO.items()}
    chosen = [(case.title, first_of(case.rows, asked.objects, count)) for case in found]
    chosen += [(item.heading, list(item.rows)) for item in items]
    return tuple(card for group, rows in chosen for card in rollouts_of(study, FULL, PUBLISHED, rows, instead, group))


def verdict(found: tuple[Case, ...]) -> tuple[str, ...]:
    """How common the cases of the paper's figure are, and how common it is that sight is believed."""
    hardness, material, level, believed = found[:4]
    lies = int(np.sum([case.among.sum() for case in (material, level)]))
    overruled = int(np.sum([case.rows.sum() for case in (material, level)]))
    return (
        f"Hardness is right in a way that hangs on touch in {hardness.share:.0f} % of its questions.",
        f"Where the picture misleads a policy without touch ({lies} questions), touch overrules it in {overruled}; "
        f"in {int(believed.rows.sum())} the picture is believed. About the material, the case that the paper shows, "
        f"touch overrules it in {int(material.rows.sum())} of {int(material.among.sum())}.",
    )


EXPERIMENT = bench_experiment(
    "qualitative",
    QualitativeConfig(),
    {name: QualitativeConfig(study=dataclasses.replace(study, seeds=1)) for name, study in presets.SCALES.items()}
    | {"smoke": QualitativeConfig(study=dataclasses.replace(presets.SMOKE, seeds=1), quota=presets.SMALL_QUOTA)},
    run,
)
