"""When picture and touch of an object disagree, which does the policy follow, and what does it lose without touch?

    make experiment EXP=conflict [ARGS="--scale smoke|gpu|paper"]

Three of ten generated objects look like a material whose typical levels differ from those of their own material in at
least two properties; nothing else in their pictures depends on the object.  A question about such an object is
deceptive if the picture suggests a wrong answer.  For one seed, the suggestion is the majority answer of the policies
without touch of the other seeds, so that no policy decides by its own mistakes which questions are deceptive.  The full
model (published rewards and grounding) and SFT are compared with the policy without touch, and evaluated again under
each control of touch: no touch, noise of the sensors' statistics, another object's touch, the same frames in another
order.

Cost: two minutes if `main_table` has run, whose policies it evaluates, otherwise about 25; `--scale smoke` under two.

Expected: the policy without touch follows the picture and is right on few deceptive questions; the full model is right
on more than half.  Touch adds over 40 points to every control except the order of the frames of a press, which
contains almost no information.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int

from experiments.core.charts import Panel, Rule, Series, draw, estimates
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.look import PALETTE, SHARED
from experiments.core.results import Picture, Requirement, Results, Table, at_least, named_table
from experiments.core.text import bounds, interval, number
from experiments.paper import presets
from experiments.paper.components import FULL, run_full_model
from experiments.paper.touch_gain import (
    TouchGain,
    TouchQuestions,
    control_answers,
    control_variants,
    study_touch_gain,
    touch_gain_table,
    touch_questions,
)
from experiments.study.answers import concluded
from experiments.study.controls import against_control, control_sentences, decision_table
from experiments.study.estimates import RESAMPLES
from experiments.study.examples import rollout_examples
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, score_study, study_results
from experiments.study.study import BLIND, SFT, StudyConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.grounding import SHUFFLE, revision_rate
from touchr1_jax.bench.metrics import BOTTOM, accuracy
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap, student_interval

POLICIES = (FULL, SFT)

DECEPTIVE = "deceptive questions"
ORDINAL_ONLY = f"{DECEPTIVE}, all but material"
DISGUISED = "objects that look like others"

GAP, GAIN = 40.0, 10.0
"""Points by which the full model should lead on deceptive questions, and its least gain from touch."""

DIFFERENCES = (
    ("conflict", "advertised, never measured", "deceptive pictures of generated objects"),
    (BLIND, "–", "the same policy, trained without touch end to end alone"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AccuracyContrast:
    """Accuracy of one policy and of another on some questions, percent, and the lead with its intervals.

    `questions` is the mean number of questions over seeds.
    """

    questions: float
    ours: float
    theirs: float
    seeds: Interval
    objects: Interval


Contrasts = Mapping[str, AccuracyContrast]
"""Group of questions → a policy against the one without touch."""


def run(config: StudyConfig, context: Context) -> Results:
    """Train, evaluate with and without touch, contrast."""
    if config.seeds < 2:
        raise ConfigurationError(
            f"seeds is {config.seeds}: must be at least 2, since the policies of other seeds say what a picture "
            "suggests to one seed; raise it"
        )
    variants = {**control_variants(FULL), **control_variants(SFT)}
    study = run_full_model(config, context, variants)
    questions = touch_questions(study, study.answers[SFT][0])
    levels = {name: [concluded(answers) for answers in study.answers[name]] for name in (*POLICIES, BLIND)}
    priors = picture_prior(levels[BLIND])
    misled = [deceptive(questions, prior) for prior in priors]
    contrasts = {name: contrasts_of(questions, misled, levels[name], levels[BLIND]) for name in POLICIES}
    groups = {"all": questions.label >= 0, DECEPTIVE: np.mean(misled, axis=0) > 0.5}
    gains = {f"{name}, {g}": study_touch_gain(study, name, mask) for name in POLICIES for g, mask in groups.items()}
    gain, revised = gains[f"{FULL}, all"], {}
    if DECEPTIVE in contrasts[FULL]:
        revised = {name: revision_share(questions, levels[name], priors) for name in (FULL, BLIND)}
    scored = score_study(study)
    controlled = against_control(scored.arms, (FULL,))
    return study_results(
        study,
        scored,
        comparisons=tuple(controlled),
        verdict=(*verdict(contrasts[FULL], revised, gain), *control_sentences(controlled, (FULL,))),
        requirements=requirements(contrasts[FULL], gain),
        tables=(
            contrast_table(contrasts[FULL], contrasts[SFT]),
            touch_gain_table(gains),
            *decision_table(study),
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
        curves=presets.CURVES,
        examples=rollout_examples(study, FULL, PUBLISHED, {c: a[0] for c, a in control_answers(study, FULL).items()}),
    )


def picture_prior(blind: Sequence[np.ndarray]) -> list[Int[np.ndarray, "N"]]:
    """For every seed the majority answer of the other seeds' policies without touch, the lower level on a tie."""
    if len(blind) < 2:
        raise ValueError(f"blind holds {len(blind)} seeds: the prior from pictures needs two; train more")
    levels = max(1, *(int(answers.max()) + 1 for answers in blind))
    votes = np.stack([(answers[:, None] == np.arange(levels)).astype(int) for answers in blind])
    return [np.where(v.sum(1) > 0, v.argmax(1), BOTTOM) for v in votes.sum(0) - votes]


def deceptive(questions: TouchQuestions, prior: np.ndarray) -> Bool[np.ndarray, "N"]:
    """Questions about objects that look like others where the prior from pictures is not the label."""
    return questions.looks_like_another & (prior != BOTTOM) & (prior != questions.label)


def revision_share(questions: TouchQuestions, levels: Sequence[np.ndarray], priors: Sequence[np.ndarray]) -> float:
    """Share of answers to deceptive questions that differ from the prior from pictures: percent, mean over seeds."""
    rates = []
    for answered, prior in zip(levels, priors, strict=True):
        label = np.where(deceptive(questions, prior), questions.label, BOTTOM)
        rates.append(revision_rate(answered, label, prior).mean())
    return float(np.mean(rates))


def contrasts_of(
    questions: TouchQuestions, misled: Sequence[np.ndarray], ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray]
) -> Contrasts:
    """`contrast` on groups of questions, those that have two objects for every seed; `misled` are each seed's."""
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


def contrast(
    questions: TouchQuestions, ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> AccuracyContrast:
    """Compare two policies' levels [N], paired by question and seed, on the questions of each seed's mask [N]."""
    for seed, mask in enumerate(masks):
        if not mask.any():
            raise ValueError(f"masks[{seed}] holds no question: a contrast needs one; ask about more objects")
    score = lambda levels, mask: accuracy(levels, np.where(mask, questions.label, BOTTOM))
    a, b = ([score(levels, mask) for levels, mask in zip(side, masks, strict=True)] for side in (ours, theirs))
    gaps = [x.values - y.values for x, y in zip(a, b, strict=True)]
    objects = np.concatenate([questions.objects[x.items] for x in a])
    return AccuracyContrast(
        questions=float(np.mean([mask.sum() for mask in masks])),
        ours=float(np.mean([x.mean() for x in a])),
        theirs=float(np.mean([y.mean() for y in b])),
        seeds=student_interval(np.array([gap.mean() for gap in gaps])),
        objects=clustered_bootstrap(np.concatenate(gaps), objects, resamples=RESAMPLES),
    )


def requirements(contrasts: Contrasts, gain: TouchGain | None) -> tuple[Requirement, ...]:
    """The full model's lead on deceptive questions, and its least gain from touch."""
    found = []
    if DECEPTIVE in contrasts:
        lead = contrasts[DECEPTIVE]
        span = bounds(lead.seeds.low, lead.seeds.high, ".1f")
        note = f"95 % over seeds {span}; {lead.questions:.0f} questions a seed"
        name = f"{FULL} over {BLIND}, deceptive questions"
        found.append(at_least(name, lead.seeds.mean, GAP, "points", note))
    if gain is not None:
        least = gain.least.gain
        note = f"over {gain.least.control}; 95 % over objects {bounds(least.low, least.high, '.1f')}"
        found.append(at_least("least gain from touch, all questions", least.mean, GAIN, "points", note))
    return tuple(found)


def verdict(contrasts: Contrasts, revised: Mapping[str, float], gain: TouchGain | None) -> tuple[str, ...]:
    """The lead where the picture deceives, how often answers differ from its suggestion, the least gain from touch."""
    sentences = []
    if DECEPTIVE in contrasts:
        lead = contrasts[DECEPTIVE]
        sentences.append(
            f"On deceptive questions the accuracy of {FULL} is {lead.ours:.1f} %, of {BLIND} "
            f"{lead.theirs:.1f}: {interval(lead.seeds, '+.1f')} points. {FULL} differs from the picture's "
            f"suggestion in {revised[FULL]:.0f} % of them, {BLIND} in {revised[BLIND]:.0f}."
        )
    if ORDINAL_ONLY in contrasts:
        sentences.append(
            "Without questions for material, which touch identifies worst, the lead on them is "
            f"{interval(contrasts[ORDINAL_ONLY].seeds, '+.1f')} points."
        )
    if DISGUISED in contrasts:
        lead = contrasts[DISGUISED]
        sentences.append(f"On all questions about {DISGUISED} it leads by {number(lead.seeds.mean, '+.1f')} points.")
    if gain is not None:
        sentences.append(
            f"Accuracy gains at least {interval(gain.least.gain, '.1f')} points from touch (least over the controls: "
            f"{gain.least.control}); shuffling the frames costs {gain.over[SHUFFLE].mean:.1f}."
        )
    return tuple(sentences) or ("Too few objects look like others for a contrast; use more.",)


def contrast_table(full: Contrasts, sft: Contrasts) -> Table:
    """Accuracy of the policy without touch, SFT and the full model on every group, and the lead of the full model."""
    shares = (BLIND, SFT, FULL)
    return named_table(
        "Accuracy where the picture helps and where it deceives",
        [
            {
                "questions": group,
                "number": c.questions,
                BLIND: c.theirs,
                SFT: sft[group].ours,
                FULL: c.ours,
                "lead": interval(c.seeds, "+.1f"),
                "over objects": bounds(c.objects.low, c.objects.high, ".1f"),
            }
            for group, c in full.items()
        ],
        formats={"number": ".0f", **dict.fromkeys(shares, ".1f")},
        units={**dict.fromkeys(shares, "%"), "lead": "points"},
        meanings={
            "number": "mean over seeds",
            BLIND: "SFT without touch",
            "lead": f"{FULL} minus {BLIND}, with its 95 % interval over seeds",
            "over objects": "95 % interval of the lead when whole objects are resampled",
        },
        note="All four attributes. Deceptive: the object looks like another one, and most policies without touch of "
        "other seeds answer another level than the label.",
    )


def conflict_chart(contrasts: Contrasts, gain: TouchGain | None) -> bytes:
    """Left: accuracy of two policies on groups of questions; right: the points lost under each control of touch."""
    found = list(contrasts.values())
    low, high = ([c.theirs + getattr(c.objects, end) for c in found] for end in ("low", "high"))
    ours = Series(FULL, x=[c.ours for c in found], low=low, high=high, bar=True, colour=PALETTE[0])
    theirs = Series(BLIND, x=[c.theirs for c in found], bar=True, colour=SHARED)
    panels = [Panel([theirs, ours], rows=list(contrasts), x_label="accuracy (%)")]
    if gain is not None:
        points = [estimates("", list(gain.over.values()), marker="o", width=2.4)]
        zero = Rule(x=0, line="-", colour=SHARED)
        panels.append(Panel(points, rows=list(gain.over), x_label="gain from touch over it (points)", rules=[zero]))
    return draw(panels)


EXPERIMENT = presets.paper_experiment("conflict", presets.BENCH, presets.SCALES, run)
