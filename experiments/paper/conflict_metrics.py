"""Which modality a policy follows when picture and touch disagree, and the accuracy that it gains from touch.

A question is *deceptive* where the object was made to look like another one and the picture suggests a wrong answer.
The picture's suggestion to one seed is the majority answer of the policies without touch of the *other* seeds, so that
the policy without touch in the table does not decide by its own mistakes which questions are deceptive.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int

from experiments.core.results import Cell, Table, named_table
from experiments.core.text import bounds, interval
from experiments.paper.component_effects import pooled
from experiments.paper.eval_variants import control_name
from experiments.study.study import Study
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.grounding import CONTROLS, SHUFFLE, LeastGain, least_tactile_use, revision_rate, tactile_use_gain
from touchr1_jax.bench.metrics import BOTTOM, ORDINAL, Scores, accuracy, keep_scored
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap, student_interval
from touchr1_jax.training.evaluation import Evaluation

RESAMPLES = 2_000
"""Of each interval over objects: its ends are then good to a tenth of its width."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchQuestions:
    """N questions about single touches: attribute, label, object, whether the object looks like another one."""

    attribute: Int[np.ndarray, "N"]
    label: Int[np.ndarray, "N"]
    objects: np.ndarray
    looks_like_another: Bool[np.ndarray, "N"]

    @property
    def ordinal(self) -> Bool[np.ndarray, "N"]:
        """Questions for hardness, roughness or protrusion."""
        return np.isin(np.array(ATTRIBUTES)[self.attribute], ORDINAL)

    def of(self, attribute: str) -> Bool[np.ndarray, "N"]:
        """Questions for one attribute."""
        return self.attribute == ATTRIBUTES.index(attribute)


def touch_questions(study: Study, answers: Evaluation) -> TouchQuestions:
    """The questions that a study's policy answered about the test contacts."""
    test, n = study.data.parts["test"], np.arange(len(answers.contact))
    return TouchQuestions(
        attribute=answers.attribute,
        label=answers.label[n, answers.attribute],
        objects=study.data.object_ids[test][answers.contact],
        looks_like_another=study.data.visual_lies[test][answers.contact],
    )


def concluded(answers: Evaluation) -> Int[np.ndarray, "N"]:
    """The level that each answer concludes for the attribute in question, −1 for ⊥."""
    return np.asarray(answers.parsed.conclude)[np.arange(len(answers.contact)), answers.attribute]


def picture_prior(blind: Sequence[np.ndarray]) -> list[Int[np.ndarray, "N"]]:
    """For every seed the majority answer of the other seeds' policies without touch, the lower level on a tie.

    Args:
      blind: int [N] of every seed.

    Raises:
      ValueError: fewer than two seeds.
    """
    if len(blind) < 2:
        raise ValueError(f"blind holds {len(blind)} seeds: the prior from pictures needs two; train more")
    levels = max(1, *(int(answers.max()) + 1 for answers in blind))
    votes = np.stack([(answers[:, None] == np.arange(levels)).astype(int) for answers in blind])
    others = votes.sum(0) - votes
    return [np.where(v.sum(1) > 0, v.argmax(1), BOTTOM) for v in others]


def deceptive(questions: TouchQuestions, prior: np.ndarray) -> Bool[np.ndarray, "N"]:
    """Questions about objects that look like others where the prior from pictures is not the label."""
    return questions.looks_like_another & (prior != BOTTOM) & (prior != questions.label)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AccuracyContrast:
    """Accuracy of one policy minus that of another on some questions, percent.

    `questions` is their mean number over seeds.
    """

    questions: float
    ours: float
    theirs: float
    seeds: Interval
    objects: Interval


def contrast(
    questions: TouchQuestions, ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> AccuracyContrast:
    """Compare two policies, paired by question and seed, on the questions of each seed's mask.

    Args:
      questions: the questions.
      ours, theirs: levels int [N] of every seed.
      masks: bool [N] of every seed.

    Raises:
      ValueError: a mask without a question, or fewer than two seeds or objects.
    """
    for seed, mask in enumerate(masks):
        if not mask.any():
            raise ValueError(f"masks[{seed}] holds no question: a contrast needs one; ask about more objects")
    score = lambda levels, mask: accuracy(levels, np.where(mask, questions.label, BOTTOM))
    a, b = ([score(levels, mask) for levels, mask in zip(side, masks, strict=True)] for side in (ours, theirs))
    gaps = [x.values - y.values for x, y in zip(a, b, strict=True)]
    return AccuracyContrast(
        questions=float(np.mean([mask.sum() for mask in masks])),
        ours=float(np.mean([x.mean() for x in a])),
        theirs=float(np.mean([y.mean() for y in b])),
        seeds=student_interval(np.array([gap.mean() for gap in gaps])),
        objects=clustered_bootstrap(
            np.concatenate(gaps), np.concatenate([questions.objects[x.items] for x in a]), resamples=RESAMPLES
        ),
    )


def revision_share(questions: TouchQuestions, levels: Sequence[np.ndarray], priors: Sequence[np.ndarray]) -> float:
    """Share of answers to deceptive questions that differ from the prior from pictures: percent, mean over seeds."""
    rates = []
    for concluded_levels, prior in zip(levels, priors, strict=True):
        label = np.where(deceptive(questions, prior), questions.label, BOTTOM)
        rates.append(revision_rate(concluded_levels, label, prior).mean())
    return float(np.mean(rates))


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchGain:
    """Accuracy gained from touch over each control, with intervals, and the least of these gains."""

    over: Mapping[str, Interval]
    least: LeastGain


def touch_gain(
    questions: TouchQuestions,
    real: Sequence[Evaluation],
    controls: Mapping[str, Sequence[Evaluation]],
    ordered: np.ndarray,
    mask: np.ndarray,
) -> TouchGain | None:
    """TUG of the accuracy over hardness, roughness and protrusion, each weighing the same; seeds pooled by question.

    Args:
      questions: the questions.
      real: the answers of every seed given the touch.
      controls: each of `CONTROLS` → the answers of every seed.
      ordered: bool [N], whether the answer lies in the order of the frames.
      mask: bool [N], the questions to judge by.

    Returns:
      The gains; `None` where fewer than two objects have such a question.
    """
    if len(np.unique(questions.objects[mask & questions.ordinal])) < 2:
        return None

    def score(answers: Evaluation) -> Scores:
        levels, scored = concluded(answers), mask & questions.ordinal & (questions.label != BOTTOM)
        return keep_scored(100.0 * (levels == questions.label), scored, questions.attribute)

    own, others = pooled([score(a) for a in real]), {c: pooled([score(a) for a in controls[c]]) for c in CONTROLS}
    over = {}
    for control, other in others.items():
        gain = tactile_use_gain(own, other)
        over[control] = clustered_bootstrap(
            gain.values, questions.objects[gain.items], strata=gain.strata, resamples=RESAMPLES
        )
    return TouchGain(over=over, least=least_tactile_use(own, others, ordered, questions.objects, resamples=RESAMPLES))


def study_touch_gain(study: Study, policy: str, mask: np.ndarray | None = None) -> TouchGain | None:
    """`touch_gain` of a policy of a study that was also evaluated by `control_variants`.

    Args:
      study: whose answers.
      policy: SFT or an arm.
      mask: bool [N], the questions to judge by; all labelled ones by default.
    """
    questions = touch_questions(study, study.answers[policy][0])
    controls = {c: study.variants[control_name(policy, c)] for c in CONTROLS}
    ordered = study.policy.ordered[questions.attribute]
    return touch_gain(
        questions, study.answers[policy], controls, ordered, questions.label >= 0 if mask is None else mask
    )


def contrast_table(full: Mapping[str, AccuracyContrast], sft: Mapping[str, AccuracyContrast]) -> Table:
    """Accuracy of the policy without touch, SFT and the full model on every group, and the lead of the full model.

    Args:
      full, sft: group → the policy against the one without touch, the same groups of both.
    """
    rows: list[dict[str, Cell]] = [
        {
            "questions": group,
            "number": c.questions,
            "vision-only": c.theirs,
            "SFT": sft[group].ours,
            "full model": c.ours,
            "lead": interval(c.seeds, "+.1f"),
            "over objects": bounds(c.objects.low, c.objects.high, ".1f"),
        }
        for group, c in full.items()
    ]
    shares = ("vision-only", "SFT", "full model")
    return named_table(
        "Accuracy where the picture helps and where it deceives",
        rows,
        formats={"number": ".0f", **dict.fromkeys(shares, ".1f")},
        units={**dict.fromkeys(shares, "%"), "lead": "points"},
        meanings={
            "number": "mean over seeds",
            "vision-only": "the policy without touch",
            "lead": "full model minus vision-only, with its 95 % interval over seeds",
            "over objects": "95 % interval of the lead when whole objects are resampled",
        },
        note="All four attributes. Deceptive: the object looks like another one, and most policies without touch of "
        "other seeds answer another level than the label.",
    )


CONTROL_MEANINGS = {
    "drop": "no stream at all",
    "shuffle": "the time steps of every stream in another order",
    "noise": "encoded noise of each sensor's statistics in place of its touch",
    "swapped": "another object's touch",
}


def touch_gain_table(gains: Mapping[str, TouchGain | None]) -> Table:
    """The gain over every control, and the least of them.

    Args:
      gains: "policy, questions" → its gains, `None` where too few objects have such a question.
    """
    rows: list[dict[str, Cell]] = []
    for name, found in gains.items():
        if found is not None:
            spans = {**{c: found.over[c] for c in CONTROLS}, "least": found.least.gain}
            cells = {control: interval(gain, "+.1f") for control, gain in spans.items()}
            rows.append({"policy and questions": name, **cells, "over": found.least.control})
    return named_table(
        "Accuracy gained from touch",
        rows,
        units=dict.fromkeys((*CONTROLS, "least"), "points"),
        meanings={**CONTROL_MEANINGS, "least": f"without {SHUFFLE}, since no answer here lies in the order of frames"},
        note="Accuracy over hardness, roughness and protrusion with the touch, minus that under each control. Policies "
        "never met a prompt without any stream, and their answers to one often cannot be read: for the gain over "
        "having no touch at all, see the policy trained without it in the tables above.",
    )
