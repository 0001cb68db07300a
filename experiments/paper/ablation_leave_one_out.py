"""Which component of the full objective lowers the score when it is removed?

    make experiment EXP=ablation_leave_one_out [ARGS="--scale smoke|gpu|paper"]

The full objective has every component that Touch-R1 names (arXiv 2605.27154): SFT, ordinal accuracy, consistency and
format rewards, tactile grounding, and credit for the use of touch.  Each component is removed in turn: without SFT,
GRPO starts from random parameters; without the accuracy reward, only consistency and format earn reward; 0/1 credit
replaces ordinal credit.  Seeds, questions and their order are the same.  The paper has only a cumulative ablation, so
the report shows each effect with the corresponding step of that ablation.

Cost: with five seeds, 32 minutes of one core if `ablation_cumulative` has run, whose policies it shares; otherwise
some 70, not measured; `--scale smoke` under two.

Expected: without SFT, every group earns nothing and the policy learns nothing (F7).  The effects of all other
components are smaller than the differences between seeds, that of the accuracy reward too: the objective includes the
likelihood of verified answers.  Under the published recipe, slots agree and are wrong without the accuracy reward (F2).
"""

import dataclasses

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.paper import presets
from experiments.paper.bench_scores import pooled_table
from experiments.paper.component_effects import FOUR, LEVEL, ComponentComparison, ComponentStep, run_components
from experiments.paper.components import (
    COMPONENTS,
    FULL,
    NO_SFT,
    WITH_TACTILE_USE,
    omitted,
    published_steps,
    reinforced,
)
from experiments.study.ablation import Ablation
from experiments.study.controls import control_sentences
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED
from experiments.study.seed import TrainedPolicy
from experiments.study.stages import untrained
from experiments.study.study import SFT, EvalVariant, StudyConfig, make_study_arm
from touchr1_jax.training.evaluation import Evaluation

STEPS = tuple(
    ComponentStep(
        arm=FULL, against=c.omitted.name, component=c.name, published=published_steps()[c.name], omission=True
    )
    for c in COMPONENTS
)

FROM_SFT = [c.omitted for c in COMPONENTS if c.omitted.name != NO_SFT]

WEIGHTS, ALGORITHMS = reinforced([omitted(FULL), *FROM_SFT])


def without_sft(trained: TrainedPolicy) -> Evaluation:
    """GRPO from fresh parameters, with the questions and steps of the arms that start from SFT."""
    params = untrained(trained.policy, trained.data, trained.seed)
    config = dataclasses.replace(trained.config, anchor=0.0)  # the anchor is SFT
    arm = make_study_arm(config, trained.policy, PUBLISHED, trained.data.prior(), WITH_TACTILE_USE)
    tuned = trained.run_grpo(arm, f"grpo/{NO_SFT}", trained.contacts(params), params)
    return trained.ask(tuned, trained.encode(params, "test"))


ABLATION = Ablation(
    arms=WEIGHTS,
    algorithms=ALGORITHMS,
    pairs=tuple((FULL, arm.name) for arm in FROM_SFT),
    variants={NO_SFT: EvalVariant(of=SFT, evaluate=without_sft)},
    curves=presets.GRPO_CURVES,
    example=FULL,
)

TITLE = "Effect of each component on the full objective"

NOTE = (
    "The full objective minus what is left without the component. The paper's figure is the step of its cumulative "
    "ladder at which the component comes in, with fewer others around it. The failures are those of the run without it."
)


def run(config: StudyConfig, context: Context) -> Results:
    """Train the full objective and every omission, compare."""
    found, results = run_components(ABLATION, STEPS, TITLE, NOTE, config, context)
    effects, *further = results.tables
    return dataclasses.replace(
        results,
        arms={**results.arms, NO_SFT: found.reported(NO_SFT)},
        verdict=(*verdict(found), *control_sentences(results.comparisons, WEIGHTS)),
        tables=(effects, *pooled_table(results.arms, FULL), *further, differences_table(presets.DIFFERENCES)),
    )


def verdict(found: ComponentComparison) -> tuple[str, ...]:
    """The components whose omission changes accuracy significantly, and those without such an effect."""
    if not found.effects:
        return ("One seed: no effect can be distinguished from chance; train two seeds at least.",)
    effects = [e for e in found.effects if e.metric.metric == FOUR]
    clear = [e for e in effects if e.p_value < LEVEL]
    missed = [f"{e.step.component} raises accuracy: {e}." for e in clear if e.seeds.mean > 0]
    better = [f"{e.step.component} lowers accuracy: {e}." for e in clear if e.seeds.mean < 0]
    rest = ", ".join(e.step.component for e in effects if e not in clear)
    return (*missed, *better, *([f"No significant effect on accuracy: {rest}."] if rest else []))


EXPERIMENT = presets.paper_experiment("ablation_leave_one_out", presets.BENCH, presets.SCALES, run)
