"""When picture and touch of an object disagree, which does the policy follow, and what does it lose without touch?

    make experiment EXP=conflict [ARGS="--scale smoke|gpu|paper"]

Three of ten generated objects look like a material that differs from theirs in at least two of the levels that are
typical of it; nothing else in their pictures depends on the object.  A question about one of them is deceptive where
the answer that pictures suggest, by the vote of policies without touch of other seeds, is wrong.  The full model
(published rewards and grounding) and SFT are compared with the policy without touch, and evaluated again under each
control of touch: no touch, noise of the sensors' statistics, another object's touch, the same touch in another order.

Cost: two minutes of one core after `main_table`, whose policies it evaluates, some 36 without; `--scale smoke` under
two.

Expected: the policy without touch follows the picture and is right on few deceptive questions, where it disagrees with
its fellows; the full model is right in more than half of them.  Touch is worth about 35 points over every control
but the order of the frames of a press, which carries next to no information.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Picture, Requirement, Results
from experiments.core.text import bounds, interval
from experiments.paper import presets
from experiments.paper.components import FULL
from experiments.paper.conflict_metrics import (
    AccuracyContrast,
    TouchGain,
    TouchQuestions,
    concluded,
    contrast,
    contrast_table,
    deceptive,
    picture_prior,
    revision_share,
    study_touch_gain,
    touch_gain_table,
    touch_questions,
)
from experiments.paper.eval_variants import control_name, control_variants
from experiments.study.examples import rollout_examples
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, score_study, study_settings
from experiments.study.study import BLIND, SFT, Study, StudyConfig, run_study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.grounding import CONTROLS, SHUFFLE
from touchr1_jax.rl.config import Paper

POLICIES = (FULL, SFT)

DECEPTIVE = "deceptive questions"
ORDINAL_ONLY = f"{DECEPTIVE}, all but material"
DISGUISED = "objects that look like others"

GAP, GAIN = 40.0, 10.0
"""Points by which the full model should lead on deceptive questions, and its least gain from touch."""

DIFFERENCES = (
    ("conflict", "advertised, never measured", "deceptive pictures of generated objects"),
    ("vision-only", "–", "the same policy, trained without touch for as many steps as SFT"),
)

Contrasts = Mapping[str, AccuracyContrast]
"""Group of questions → a policy against the one without touch."""


def run(config: StudyConfig, context: Context) -> Results:
    """Train, evaluate with and without touch, contrast."""
    variants = {**control_variants(FULL), **control_variants(SFT)}
    study = run_study(config, {FULL: PUBLISHED}, context, {FULL: Paper()}, variants)
    questions = touch_questions(study, study.answers[SFT][0])
    priors = picture_prior([concluded(answers) for answers in study.answers[BLIND]])
    misled = [deceptive(questions, prior) for prior in priors]
    contrasts = {name: contrasts_of(study, questions, misled, name) for name in POLICIES}
    groups = {"all": questions.label >= 0, DECEPTIVE: np.mean(misled, axis=0) > 0.5}
    gains = {f"{name}, {g}": study_touch_gain(study, name, mask) for name in POLICIES for g, mask in groups.items()}
    gain, scored = gains[f"{FULL}, all"], score_study(study)
    revised = {}
    if DECEPTIVE in contrasts[FULL]:
        levels = {name: [concluded(answers) for answers in study.answers[name]] for name in (FULL, BLIND)}
        revised = {name: revision_share(questions, seeds, priors) for name, seeds in levels.items()}
    return Results(
        arms=scored.arms,
        baselines=scored.baselines,
        settings=study_settings(config),
        verdict=verdict(contrasts[FULL], revised, gain),
        requirements=requirements(contrasts[FULL], gain),
        tables=(
            contrast_table(contrasts[FULL], contrasts[SFT]),
            touch_gain_table(gains),
            differences_table((*presets.DIFFERENCES[:3], *DIFFERENCES)),
        ),
        pictures=(
            Picture(
                name="believed",
                title="Accuracy where picture and touch disagree, and loss without touch",
                caption="Accuracy with 95 % intervals of the lead over the policy without touch (over objects), and "
                "the points lost when touch is taken away or replaced.",
                content=conflict_chart(contrasts[FULL], gain),
            ),
        ),
        data=study.data.summary(),
        curves=presets.CURVES,
        examples=rollout_examples(
            study, FULL, PUBLISHED, {c: study.variants[control_name(FULL, c)][0] for c in CONTROLS}
        ),
    )


def contrasts_of(study: Study, questions: TouchQuestions, misled: Sequence[np.ndarray], name: str) -> Contrasts:
    """A policy against the one without touch on groups of questions, those that have two objects for every seed."""
    ours, theirs = ([concluded(answers) for answers in study.answers[who]] for who in (name, BLIND))
    each = lambda mask: [mask] * len(misled)
    groups = {
        "all questions": each(questions.label >= 0),
        "objects that look like what they are": each(~questions.looks_like_another),
        DISGUISED: each(questions.looks_like_another),
        DECEPTIVE: misled,
        ORDINAL_ONLY: [mask & questions.ordinal for mask in misled],
        **{f"{DECEPTIVE}, {a}": [mask & questions.of(a) for mask in misled] for a in ATTRIBUTES},
    }
    return {
        group: contrast(questions, ours, theirs, masks)
        for group, masks in groups.items()
        if all(len(np.unique(questions.objects[mask])) > 1 for mask in masks)
    }


def requirements(contrasts: Contrasts, gain: TouchGain | None) -> tuple[Requirement, ...]:
    """The full model's lead on deceptive questions, and its least gain from touch."""
    found = []
    if DECEPTIVE in contrasts:
        lead = contrasts[DECEPTIVE]
        span = bounds(lead.seeds.low, lead.seeds.high, ".1f")
        note = f"95 % over seeds {span}; {lead.questions:.0f} questions a seed"
        found.append(_points("full model over vision-only, deceptive questions", lead.seeds.mean, GAP, note))
    if gain is not None:
        least = gain.least.gain
        note = f"over {gain.least.control}; 95 % over objects {bounds(least.low, least.high, '.1f')}"
        found.append(_points("least gain from touch, all questions", least.mean, GAIN, note))
    return tuple(found)


def _points(name: str, measured: float, bound: float, note: str) -> Requirement:
    return Requirement(name=name, measured=measured, bound=bound, better="higher", unit="points", note=note)


def verdict(contrasts: Contrasts, revised: Mapping[str, float], gain: TouchGain | None) -> tuple[str, ...]:
    """The lead where the picture deceives, how often answers differ from its suggestion, the least gain from touch."""
    sentences = []
    if DECEPTIVE in contrasts:
        lead = contrasts[DECEPTIVE]
        sentences.append(
            f"On deceptive questions the accuracy of the full model is {lead.ours:.1f} %, of vision-only "
            f"{lead.theirs:.1f}: {interval(lead.seeds, '+.1f')} points. The full model differs from the picture's "
            f"suggestion in {revised[FULL]:.0f} % of them, vision-only in {revised[BLIND]:.0f}."
        )
    if ORDINAL_ONLY in contrasts:
        sentences.append(
            "Without questions for material, which touch identifies worst, the lead on them is "
            f"{interval(contrasts[ORDINAL_ONLY].seeds, '+.1f')} points."
        )
    if DISGUISED in contrasts:
        lead = contrasts[DISGUISED]
        sentences.append(f"On all questions about {DISGUISED} it leads by {lead.seeds.mean:+.1f} points.")
    if gain is not None:
        sentences.append(
            f"Touch is worth at least {interval(gain.least.gain, '.1f')} points, over {gain.least.control}; shuffled "
            f"frames cost {gain.over[SHUFFLE].mean:.1f}."
        )
    return tuple(sentences) or ("Too few objects look like others for a contrast; use more.",)


def conflict_chart(contrasts: Contrasts, gain: TouchGain | None) -> bytes:
    """Left: accuracy of two policies on groups of questions; right: the points lost under each control of touch."""
    found = list(contrasts.values())
    ours = Series(
        "full model",
        x=[c.ours for c in found],
        low=[c.theirs + c.objects.low for c in found],
        high=[c.theirs + c.objects.high for c in found],
        bar=True,
        colour=PALETTE[0],
    )
    theirs = Series("without touch", x=[c.theirs for c in found], bar=True, colour=PALETTE[1])
    panels = [Panel([theirs, ours], rows=list(contrasts), x_label="accuracy (%)")]
    if gain is not None:
        spans = list(gain.over.values())
        low, high, mean = ([getattr(s, end) for s in spans] for end in ("low", "high", "mean"))
        panels.append(
            Panel(
                [Series(x=mean, low=low, high=high, marker="o", width=2.4)],
                rows=list(gain.over),
                x_label="gain from touch over it (points)",
                rules=[Rule(x=0, line="-", colour=SHARED)],
            )
        )
    return draw(panels)


EXPERIMENT = presets.paper_experiment("conflict", presets.BENCH, presets.SCALES, run)
