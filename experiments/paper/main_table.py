"""What do the full model, SFT and every baseline score on the four tiers of the bench, beside the paper's main table?

    make experiment EXP=main_table [ARGS="--scale smoke|gpu|paper"]

The bench's questions (see `dataset_card`) about the test objects of a study: properties of a touch, several at once,
comparisons and orders, single sensors, and objects that look like what they are not.  Answered by the full model
(published rewards and grounding), by SFT alone, and by baselines: constants, the measured force, the picture alone by a
probe and by a policy that was trained without touch, the nearest training contacts by their fields, a linear probe on
the encoder of SFT, and the same probe when every contact has another object's touch.  Policies and baselines answer
about one touch at a time; comparisons follow from these answers (see `experiments.paper.questions`).

Cost: some 36 minutes of one core with five seeds; the other studies of the bench find its policies trained. `--scale
smoke` under two.

Expected: touch is worth thirty points over every baseline without it, and none over a linear probe on its own encoder.
Baselines without touch stay near chance in comparisons.  A constant already has an average of about 28.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.bench.draw import Quota
from experiments.core.context import Context
from experiments.core.results import Comparison, Estimate, Requirement, Results
from experiments.paper import presets
from experiments.paper.aggregate import aggregate_table
from experiments.paper.baselines import Known, Levels, nearest, probed
from experiments.paper.eval_variants import by_encoder
from experiments.paper.experiment import bench_experiment
from experiments.paper.features import Seen, field_features, picture_features
from experiments.paper.ladder_arms import FULL
from experiments.paper.ladder_tables import DIFFERS
from experiments.paper.outcome import CURVES
from experiments.paper.paper_comparison import beside_table, tier_table
from experiments.paper.questions import answered, questions
from experiments.paper.rows import bench_row
from experiments.study import paper_numbers as paper
from experiments.study.answers import Evaluated
from experiments.study.baselines import baselines, level_answers
from experiments.study.estimates import compare_over_seeds
from experiments.study.examples import rollout_examples
from experiments.study.levels import level_report
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, study_settings
from experiments.study.study import BLIND, SFT, SMOKE, Study, StudyConfig, Way, run_study
from touchr1_jax.bench.items import Ask
from touchr1_jax.rl.config import Paper

ENCODER_PROBE, STRANGE = "encoder_probe", "shuffled_touch"
PICTURE, NEAREST = "vision_only", "nearest_fields"

TOUCHLESS = ("constant", "constant_joint", "constant_middle", "force_only", PICTURE, BLIND, STRANGE)
"""Baselines that feel nothing of the object, or of another one."""

COMPARED = ("h_acc", "r_acc", "p_acc", "mat_acc", "omae", "l2_em", "sfd", "soi_rho", "csc", "avg")

Row = Mapping[str, Estimate]


@dataclasses.dataclass(frozen=True, kw_only=True)
class MainConfig:
    """The study, and how many questions of each kind are asked about its test objects."""

    study: StudyConfig = presets.BENCH
    quota: Quota = Quota()


def run(config: MainConfig, context: Context) -> Results:
    """Train, answer, score."""
    ways = {
        ENCODER_PROBE: Way(of=SFT, ask=functools.partial(by_encoder, False)),
        STRANGE: Way(of=SFT, ask=functools.partial(by_encoder, True)),
    }
    study = run_study(config.study, {FULL: PUBLISHED}, context, {FULL: Paper()}, ways)
    with context.timed("baselines"):
        said = {**study.answers, **study.further, **{n: [x] for n, x in without_training(study, context).items()}}
    with context.timed("score"):
        asks = questions(study.data, config.quota, context)
        rows = {
            name: bench_row(asks, answered(study.data, asks, seeds), sight(study, asks, seeds))
            for name, seeds in context.each("scoring", said.items())
        }
    trained = {name: rows[name] for name in (SFT, FULL)}
    pictures, reliability = level_report(study)
    comparisons = against_sft(trained, config.study.seeds)
    return Results(
        arms=trained,
        baselines={name: row for name, row in rows.items() if name not in trained},
        settings=study_settings(config.study),
        comparisons=tuple(comparisons),
        verdict=verdict(rows, comparisons),
        requirements=(minutes(context),),
        tables=(
            beside_table(rows),
            *aggregate_table(rows, SFT),
            *reliability,
            tier_table(asks),
            differences_table((*DIFFERS[:4], *ASKED)),
        ),
        pictures=pictures,
        data=study.data.summary() | {"questions": len(asks)},
        curves=CURVES,
        examples=rollout_examples(study, FULL, PUBLISHED),
    )


ASKED = (
    ("several touches", "shown in one prompt", "answered one by one, compared by the levels"),
    ("several properties", "asked in one prompt", "asked one by one"),
    ("Avg", "of a formula that is not given", "mean of the nine columns, OMAE and ρ as shares"),
)
"""What differs in how the bench's questions are put."""


def without_training(study: Study, context: Context) -> dict[str, Evaluated]:
    """Answers of the baselines that need no policy, to the questions that policies were asked."""
    data, levels = study.data, study.assembly.levels
    train, test = np.concatenate([data.parts["sft"], data.parts["grpo"]]), data.parts["test"]
    with context.progress("reading fields", len(train) + len(test)) as advance:
        fields = [field_features(data.store, rows, data.clip.sensors, advance) for rows in (train, test)]
    pictures = [picture_features(data.store, rows) for rows in (train, test)]
    known = lambda seen: Known(seen=seen, label=data.label[train])

    def by_picture() -> Levels:
        found = probed(known(pictures[0]), pictures[1], levels, study.config.probe)
        return Levels(together=found.together, alone=_repeated(found, fields[1]))

    ways: dict[str, Callable[[], Levels]] = {}
    if pictures[0].present.any():
        ways[PICTURE] = by_picture
    if fields[0].present.any():
        ways[NEAREST] = lambda: nearest(known(fields[0]), fields[1], levels)
    read = {name: _answers(study, make()) for name, make in context.each("baselines", ways.items())}
    return baselines(study) | read


def _answers(study: Study, levels: Levels) -> Evaluated:
    return level_answers(study.assembly, study.answers[SFT][0], levels.together, levels.alone)


def _repeated(levels: Levels, streams: Seen) -> np.ndarray:
    """Who does not feel says the same whichever sensor is shown."""
    return np.repeat(levels.together[:, None], streams.x.shape[1], 1)


def sight(study: Study, asks: Sequence[Ask], seeds: Sequence[Evaluated]) -> list[dict[str, tuple[int, ...]]]:
    """What the policy without touch answers, seed by seed; its first seed for a baseline without seeds."""
    return answered(study.data, asks, study.answers[BLIND][: len(seeds)])


def against_sft(rows: Mapping[str, Row], seeds: int) -> list[Comparison]:
    """The full model against SFT, paired by seed; needs two seeds at least."""
    if seeds < 2:
        return []
    a, b = rows[FULL], rows[SFT]
    return [compare_over_seeds(m, FULL, SFT, a[m], b[m]) for m in COMPARED if m in a and m in b]


def minutes(context: Context) -> Requirement:
    """Minutes of the run against what the whole table may take on two cores."""
    note = "policies that another study had trained before cost nothing here"
    return Requirement(
        name="minutes", measured=context.elapsed_s / 60, bound=45.0, better="lower", unit="min", note=note
    )


def verdict(rows: Mapping[str, Row], comparisons: Sequence[Comparison]) -> tuple[str, ...]:
    """Touch against the best baseline without it, reinforcement against SFT, and the policy against its own encoder."""
    single = [m for m in ("h_acc", "r_acc", "p_acc") if m in rows[FULL]]
    mean = lambda name: float(np.mean([rows[name][m].mean for m in single])) if single else float("nan")
    best = max((name for name in TOUCHLESS if name in rows), key=mean)
    said = [
        f"The full model answers {mean(FULL):.1f} % of hardness, roughness and protrusion right, SFT {mean(SFT):.1f}, "
        f"a linear probe on the encoder of SFT {mean(ENCODER_PROBE):.1f}; the best without touch, {best}, "
        f"{mean(best):.1f}."
    ]
    for c in comparisons:
        if c.metric in ("avg", "omae", "csc"):
            beyond = "0 lies outside" if c.ci95[0] > 0 or c.ci95[1] < 0 else "which may be chance"
            said.append(f"GRPO moves {c.metric} by {c.difference:+.3g} [{c.ci95[0]:.3g}, {c.ci95[1]:.3g}] ({beyond}).")
    if "avg" in rows[FULL]:
        ours, theirs = rows[FULL]["avg"].mean, paper.MAIN["Touch-R1-7B"][1]
        said.append(
            f"Its average is {ours:.1f}; a constant has {rows['constant']['avg'].mean:.1f}. The paper's {theirs} is of "
            "another formula."
        )
    return tuple(said)


SCALES = {name: MainConfig(study=study) for name, study in presets.SCALES.items()}

EXPERIMENT = bench_experiment(
    "main_table", MainConfig(), SCALES | {"smoke": MainConfig(study=SMOKE, quota=presets.SMALL_QUOTA)}, run
)
