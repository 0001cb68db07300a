"""What do the full model, SFT and every baseline score on the four tiers of the bench, as in the paper's main table?

    make experiment EXP=main_table [ARGS="--scale smoke|gpu|paper"]

The bench's questions (see `dataset_card`) about the test objects of a study cover properties of a touch, several
properties at once, comparisons and orders, single sensors, and objects with misleading pictures.  The full model
(published rewards and grounding), SFT alone and SFT continued for as many seconds as GRPO takes answer them.  Baselines
are constants, the measured force, the picture alone (a probe, and a policy trained without touch), the nearest training
contacts by their fields, and linear probes on the encoder of SFT: of its touch, of touch and picture, and of another
object's touch.  Policies and baselines answer about one touch at a time; comparisons are computed from these answers
(see `experiments.paper.bench_scores`).

Cost: about 25 minutes on two cores with five seeds; the other studies of the bench reuse its policies.  `--scale
smoke` under two.

Expected: touch adds over thirty points to every baseline without it.  SFT is better than a linear probe on its touch
and about one point worse than a probe that also reads the picture.  GRPO is no better than SFT that is continued for as
long.  Baselines without touch are near chance in comparisons.  A constant has an average of 27 to 29.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.context import Context
from experiments.core.results import Comparison, Estimate, Results, at_most
from experiments.paper import bench_scores as bench
from experiments.paper import feature_baselines as features
from experiments.paper import presets
from experiments.paper.components import FULL, run_full_model
from experiments.study import paper_numbers as paper
from experiments.study.controls import against_control, control_sentences, decision_table, seconds_table
from experiments.study.estimates import changes, compare_over_seeds
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.scores import PUBLISHED, baselines, level_answers, study_settings
from experiments.study.study import BLIND, CONTINUED, SFT, SMOKE, EvalVariant, Study, StudyConfig
from touchr1_jax.bench.averages import AVERAGED
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.training.evaluation import Evaluation

ENCODER_PROBE, PICTURE_PROBE, SWAPPED = "encoder_probe", "encoder_and_picture_probe", "shuffled_touch"
PICTURE, NEAREST = "vision_only", "nearest_fields"

TOUCHLESS = ("constant", "constant_joint", "constant_middle", "force_only", PICTURE, BLIND, SWAPPED)
"""Baselines without touch of the object, or with that of another one."""

PAPER_ROWS = ("Qwen2.5-VL-7B", "GPT-4o", "Octopi-13B", "SToLa", "Touch-R1-7B")
"""Rows of the paper that stand below ours."""

DIFFERENCES = (
    ("several touches", "shown in one prompt", "answered one by one, compared by the levels"),
    ("several properties", "asked in one prompt", "asked one by one"),
    ("Avg", "of a formula that is not given", "mean of the nine columns, OMAE and ρ as shares"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MainConfig:
    """The study, and how many questions of each kind are asked about its test objects."""

    study: StudyConfig = presets.BENCH
    quota: Quota = Quota()


def run(config: MainConfig, context: Context) -> Results:
    """Train, answer, score."""
    variants = {
        ENCODER_PROBE: EvalVariant(of=SFT, evaluate=features.encoder_probe),
        PICTURE_PROBE: EvalVariant(of=SFT, evaluate=functools.partial(features.encoder_probe, picture=True)),
        SWAPPED: EvalVariant(of=SFT, evaluate=functools.partial(features.encoder_probe, swapped=True)),
    }
    study = run_full_model(config.study, context, variants)
    with context.timed("baselines"):
        untrained = {name: [answers] for name, answers in without_policy(study, context).items()}
    with context.timed("score"):
        asks = bench.bench_questions(study.data, config.quota, context)
        rows = {}
        for name, seeds in context.each("scoring", {**study.answers, **study.variants, **untrained}.items()):
            by_picture = bench.bench_answers(study.data, asks, study.answers[BLIND][: len(seeds)])
            rows[name] = bench.bench_row(asks, bench.bench_answers(study.data, asks, seeds), by_picture)
    trained = {name: rows[name] for name in study.policies}
    pictures, reliability = level_report(study)
    controlled = against_control(trained, (FULL,))
    comparisons = [*against(trained, FULL, SFT), *controlled]
    comparisons += [c for probe in (ENCODER_PROBE, PICTURE_PROBE) for c in against(rows, SFT, probe)]
    note = "policies that another study trained before cost nothing here"
    return Results(
        arms=trained,
        baselines={name: row for name, row in rows.items() if name not in trained},
        settings=study_settings(config.study),
        comparisons=tuple(comparisons),
        verdict=(*verdict(rows, comparisons), *control_sentences(controlled, (FULL,))),
        requirements=(at_most("minutes", context.elapsed_s / 60, 45.0, "min", note),),
        tables=(
            bench.comparison_table(
                "Comparison with the paper's main table",
                rows,
                {name: paper.MAIN[name] for name in PAPER_ROWS},
                "Direction, not parity: other objects, other sizes, no pretrained model. The table above has the "
                "intervals.",
            ),
            *bench.pooled_table(rows, SFT),
            *decision_table(study),
            *reliability,
            *seconds_table(study, context),
            bench.question_table(asks),
            paper.differences_table((*presets.DIFFERENCES[:4], *DIFFERENCES)),
        ),
        pictures=pictures,
        data=study.data.summary() | {"questions": len(asks)},
        curves=presets.CURVES,
        examples=rollout_examples(study, FULL, PUBLISHED),
    )


def without_policy(study: Study, context: Context) -> dict[str, Evaluation]:
    """Answers of the baselines that need no policy, to the questions that policies were asked."""
    data, levels = study.data, study.policy.levels
    train, test = data.training, data.parts["test"]
    with context.progress("reading fields", len(train) + len(test)) as advance:
        fields = [features.field_features(data.store, rows, data.clip.sensors, advance) for rows in (train, test)]
    view = lambda row: data.store.objects[data.store.contacts[int(row)].object_id].view
    pictures = [features.picture_features([view(row) for row in rows]) for rows in (train, test)]
    probe = functools.partial(features.linear_probe, levels=levels, config=study.config.probe)
    answers = baselines(study)
    for name, (known, asked), predict in context.each(
        "baselines", ((PICTURE, pictures, probe), (NEAREST, fields, functools.partial(features.nearest, levels=levels)))
    ):
        if known.present.any():
            together, alone = features.together_and_alone(predict, known, data.label[train], asked)
            single = None if name == PICTURE else alone  # of a picture the same whichever sensor is shown
            answers[name] = level_answers(study.policy, study.answers[SFT][0], together, single)
    return answers


def against(rows: Mapping[str, Mapping[str, Estimate]], one: str, other: str) -> list[Comparison]:
    """One row against another in the columns of the table, paired by seed; needs two seeds at least."""
    a, b = rows[one], rows[other]
    compared = [m for m in (*AVERAGED, "avg") if m in a and m in b and len(a[m].per_seed) > 1]
    return [compare_over_seeds(m, one, other, a[m].per_seed, b[m].per_seed) for m in compared]


def verdict(rows: Mapping[str, Mapping[str, Estimate]], comparisons: Sequence[Comparison]) -> tuple[str, ...]:
    """Touch against the best baseline without it, reinforcement against SFT, the policy against its own encoder."""
    single = [m for m in ("h_acc", "r_acc", "p_acc") if m in rows[FULL]]
    mean = lambda name: float(np.mean([rows[name][m].mean for m in single])) if single else float("nan")
    best = max((name for name in TOUCHLESS if name in rows), key=mean)
    sentences = [
        f"The full model answers {mean(FULL):.1f} % of hardness, roughness and protrusion right, SFT {mean(SFT):.1f}, "
        f"a linear probe on the encoder of SFT {mean(ENCODER_PROBE):.1f}; the best without touch, {best}, "
        f"{mean(best):.1f}."
    ]
    shown = [c for c in comparisons if c.metric in ("avg", "omae", "csc") and c.against != CONTINUED]
    for arm, against in dict.fromkeys((c.arm, c.against) for c in shown):
        of_pair = [c for c in shown if (c.arm, c.against) == (arm, against)]
        sentences.append(f"{arm} compared with {against}: {changes(of_pair)}.")
    if "avg" in rows[FULL]:
        ours, theirs = rows[FULL]["avg"].mean, paper.MAIN["Touch-R1-7B"][1]
        sentences.append(
            f"The full model's Avg is {ours:.1f}, that of a constant {rows['constant']['avg'].mean:.1f}. The paper's "
            f"{theirs} follows another formula."
        )
    return tuple(sentences)


SCALES = {name: MainConfig(study=study) for name, study in presets.SCALES.items()}

EXPERIMENT = presets.paper_experiment(
    "main_table", MainConfig(), SCALES | {"smoke": MainConfig(study=SMOKE, quota=presets.SMALL_QUOTA)}, run
)
