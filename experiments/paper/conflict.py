"""When the picture of an object lies about its touch, what is believed, and what do answers lose without touch?

    make experiment EXP=conflict [ARGS="--scale smoke|gpu|paper"]

Three of ten generated objects look like a material that differs from theirs in at least two of the levels that are
typical of it; nothing else in their pictures depends on the object.  A question about one of them is deceptive where
what pictures suggest, by the vote of policies without touch of other seeds, is not the answer.  The full model
(published rewards and grounding) and SFT are held against the policy without touch, and asked again with each control
of touch in place: no touch, noise of the sensors' statistics, another object's touch, the same touch in another order.

Cost: two minutes of one core after `main_table`, whose policies it asks, some 36 without; `--scale smoke` under two.

Expected: the policy without touch follows the picture and is right on few deceptive questions, where it disagrees with
its fellows; the full model is right in more than half of them.  Touch is worth about 35 points over every control
but the order of the frames of a press, which says next to nothing.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Picture, Requirement, Results
from experiments.paper import presets
from experiments.paper.conflict_metrics import (
    Asked,
    Contrast,
    Use,
    asked_of,
    contrast,
    deceptive,
    revised,
    spoken,
    suggested,
    touch_use,
)
from experiments.paper.conflict_tables import contrast_table, use_table
from experiments.paper.eval_variants import control_name, under_controls
from experiments.paper.experiment import bench_experiment
from experiments.paper.ladder_arms import FULL
from experiments.paper.ladder_charts import believed_chart
from experiments.paper.ladder_tables import DIFFERS
from experiments.paper.outcome import CURVES
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

GAP, USE = 40.0, 10.0
"""Points that the full model should lead by on deceptive questions, and least gain from touch."""


def run(config: StudyConfig, context: Context) -> Results:
    """Train, ask with and without touch, contrast."""
    ways = {**under_controls(FULL), **under_controls(SFT)}
    study = run_study(config, {FULL: PUBLISHED}, context, {FULL: Paper()}, ways)
    scored = score_study(study)
    asked = questions(study)
    prior = suggested([spoken(said) for said in study.answers[BLIND]])
    contrasts = {name: contrasted(study, asked, prior, name) for name in POLICIES}
    uses = {(name, where): use(study, asked, prior, name, where) for name in POLICIES for where in ("all", DECEPTIVE)}
    whole = uses[FULL, "all"]
    return Results(
        arms=scored.arms,
        baselines=scored.baselines,
        settings=study_settings(config),
        verdict=verdict(asked, study, prior, contrasts, uses),
        requirements=requirements(contrasts, uses),
        tables=(
            contrast_table(contrasts[FULL], contrasts[SFT]),
            use_table(uses),
            differences_table((*DIFFERS[:3], *HERE)),
        ),
        pictures=(
            Picture(
                name="believed",
                title="Where sight and touch differ",
                caption="Share of right answers with 95 % intervals of the lead over the policy without touch (over "
                "objects), and what is lost when touch is taken away or replaced.",
                content=believed_chart(contrasts[FULL], {} if whole is None else whole.gains),
            ),
        ),
        data=study.data.summary(),
        curves=CURVES,
        examples=rollout_examples(
            study, FULL, PUBLISHED, {c: study.further[control_name(FULL, c)][0] for c in CONTROLS}
        ),
    )


HERE = (
    ("conflict", "advertised, never measured", "deceptive pictures of generated objects"),
    ("vision-only", "–", "the same policy, trained without touch for as many steps as SFT"),
)


def questions(study: Study) -> Asked:
    """The questions about the test contacts."""
    test = study.data.parts["test"]
    return asked_of(study.answers[SFT][0], study.data.object_ids[test], study.data.visual_lies[test], ATTRIBUTES)


def contrasted(study: Study, asked: Asked, prior: Sequence[np.ndarray], name: str) -> dict[str, Contrast]:
    """A policy against the one without touch on groups of questions, those that have a question for every seed."""
    ours, theirs = ([spoken(said) for said in study.answers[who]] for who in (name, BLIND))
    misled = [deceptive(asked, seen) for seen in prior]
    each = lambda mask: [mask] * len(prior)
    groups = {
        "all questions": each(asked.label >= 0),
        "objects that look like what they are": each(~asked.lies),
        "objects that look like others": each(asked.lies),
        DECEPTIVE: misled,
        ORDINAL_ONLY: [mask & asked.ordinal for mask in misled],
        **{f"{DECEPTIVE}, {a}": [m & (asked.attribute == i) for m in misled] for i, a in enumerate(asked.names)},
    }
    return {
        group: contrast(asked, ours, theirs, where)
        for group, where in groups.items()
        if all(len(np.unique(asked.objects[mask])) > 1 for mask in where)
    }


def use(study: Study, asked: Asked, prior: Sequence[np.ndarray], name: str, where: str) -> Use | None:
    """What touch is worth to a policy, on all questions or on those that are deceptive to most seeds.

    `None` where fewer than two objects have such a question.
    """
    mask = asked.label >= 0
    if where == DECEPTIVE:
        mask = np.mean([deceptive(asked, seen) for seen in prior], axis=0) > 0.5
    if len(np.unique(asked.objects[mask & asked.ordinal])) < 2:
        return None
    controls = {c: study.further[control_name(name, c)] for c in CONTROLS}
    return touch_use(asked, study.answers[name], controls, study.assembly.ordered[asked.attribute], mask)


def requirements(
    contrasts: Mapping[str, Mapping[str, Contrast]], uses: Mapping[tuple[str, str], Use | None]
) -> tuple[Requirement, ...]:
    """The lead on deceptive questions, and the least gain from touch."""
    found = []
    if DECEPTIVE in contrasts[FULL]:
        lead = contrasts[FULL][DECEPTIVE]
        note = f"95 % over seeds [{lead.seeds.low:.1f}, {lead.seeds.high:.1f}]; {lead.questions:.0f} questions a seed"
        found.append(_points("full model over vision-only, deceptive questions", lead.seeds.mean, GAP, note))
    whole = uses[FULL, "all"]
    if whole is not None:
        span = whole.least.gain
        note = f"over {whole.least.control}; 95 % over objects [{span.low:.1f}, {span.high:.1f}]"
        found.append(_points("least gain from touch, all questions", span.mean, USE, note))
    return tuple(found)


def _points(name: str, measured: float, bound: float, note: str) -> Requirement:
    return Requirement(name=name, measured=measured, bound=bound, better="higher", unit="points", note=note)


def verdict(
    asked: Asked,
    study: Study,
    prior: Sequence[np.ndarray],
    contrasts: Mapping[str, Mapping[str, Contrast]],
    uses: Mapping[tuple[str, str], Use | None],
) -> tuple[str, ...]:
    """The lead where sight lies, how often answers leave what sight suggests, the least gain from touch."""
    said = []
    lead = contrasts[FULL].get(DECEPTIVE)
    if lead is not None:
        rates = {who: revised(asked, [spoken(x) for x in study.answers[who]], prior) for who in (FULL, BLIND)}
        said.append(
            f"On deceptive questions the full model is right in {lead.ours:.1f} %, vision-only in {lead.theirs:.1f}: "
            f"{lead.seeds.mean:+.1f} points [{lead.seeds.low:.1f}, {lead.seeds.high:.1f}]. It leaves what sight "
            f"suggests in {rates[FULL]:.0f} % of them, vision-only in {rates[BLIND]:.0f}."
        )
    scales = contrasts[FULL].get(ORDINAL_ONLY)
    if scales is not None:
        said.append(
            f"Without material, which touch tells worst, the lead on them is {scales.seeds.mean:+.1f} points "
            f"[{scales.seeds.low:.1f}, {scales.seeds.high:.1f}]."
        )
    looks = contrasts[FULL].get("objects that look like others")
    if looks is not None:
        said.append(f"On all questions about objects that look like others it leads by {looks.seeds.mean:+.1f} points.")
    whole = uses[FULL, "all"]
    if whole is not None:
        span = whole.least.gain
        said.append(
            f"Touch is worth {span.mean:.1f} points [{span.low:.1f}, {span.high:.1f}] at least, over "
            f"{whole.least.control}; shuffled frames cost {whole.gains[SHUFFLE].mean:.1f}."
        )
    return tuple(said) or ("Too few objects look like others to say anything; use more.",)


EXPERIMENT = bench_experiment("conflict", presets.BENCH, presets.SCALES, run)
