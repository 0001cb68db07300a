"""What do answers look like where touch decides, where the picture deceives, and where they fail?

    make experiment EXP=qualitative [ARGS="--scale smoke|gpu|paper"]

For answers to the bench's questions, the report shows frames, forces, fields at the strongest press, the trace with its
parsed slots, and each term of the reward.  It also shows the answers of the same policy without touch, with noise, with
another object's touch and with the frames in another order, and those of SFT and of a policy trained without touch.
Rules select cases from answers and labels only: the report shows the first matches in the order of the data, one per
object.  A table gives the frequency of each case.

Cost: a minute of one core if `main_table` has run, whose policy it evaluates, otherwise seven; `--scale smoke` under
one.

Expected: right answers become wrong with another object's touch.  Where a picture misleads a policy without touch,
touch corrects about half of the answers (`conflict`), least often those about material.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int

from experiments.core.context import Context
from experiments.core.results import Results, RolloutExample, Table, named_table
from experiments.paper import presets
from experiments.paper.bench_scores import bench_answers, bench_questions, touch_rows
from experiments.paper.components import FULL, run_full_model
from experiments.paper.touch_gain import (
    TouchQuestions,
    control_answers,
    control_name,
    control_variants,
    touch_questions,
)
from experiments.study.answers import concluded
from experiments.study.examples import rollouts_of
from experiments.study.paper_numbers import differences_table
from experiments.study.scores import PUBLISHED, score_study, study_results
from experiments.study.study import BLIND, SFT, Study, StudyConfig
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.items import KINDS, Ask, Touch
from touchr1_jax.bench.metrics import BOTTOM
from touchr1_jax.bench.questions.draw import Quota
from touchr1_jax.bench.questions.wording import answer_words, question
from touchr1_jax.training.evaluation import Evaluation

REPLACEMENTS = {
    "drop": "nothing",
    "noise": "noise of each sensor",
    "swapped": "another object's touch",
    "shuffle": "its frames in another order",
}
"""Control → the replacement of the touch, as the browser names it."""

OTHER_POLICIES = {SFT: "its own touch, before GRPO", BLIND: "nothing, and a policy trained so"}
"""In the same table."""

SHOWN = 2  # answers of each case that are shown, at most

SHOWN_KINDS = ("compose", "compare", "order")
"""Kinds of the bench's items whose answer consists of several answers."""

DIFFERENCES = (
    ("examples", "two kinds, chosen", "every case of the table, the first by the order of the data"),
    ("traces", "free text", "the slots of a fixed form"),
    ("counterfactual answers", "none", "five, next to every trace"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class QualitativeConfig:
    """The study, and the bench's items that are drawn."""

    study: StudyConfig = dataclasses.replace(presets.BENCH, seeds=1)
    quota: Quota = Quota()


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnswerCase:
    """A kind of answer: which are of it, which of the questions could have been, and the paper's example."""

    title: str
    rows: Bool[np.ndarray, "N"]
    among: Bool[np.ndarray, "N"]
    paper: str = "–"

    @property
    def share(self) -> float:
        """Percent; 0 where there is nothing to be a share of."""
        return 100.0 * float(self.rows.sum()) / max(int(self.among.sum()), 1)


def run(config: QualitativeConfig, context: Context) -> Results:
    """Train one seed, evaluate every variant, choose, show."""
    study = run_full_model(config.study, context, control_variants(FULL))
    first = {name: seeds[0] for name, seeds in {**study.answers, **study.variants}.items()}
    full, questions = first[FULL], touch_questions(study, first[SFT])
    slots = np.asarray(full.parsed.perceive)[np.arange(len(full.contact)), :, full.attribute]
    cases = answer_cases(
        questions,
        full=concluded(full),
        sft=concluded(first[SFT]),
        blind=concluded(first[BLIND]),
        swapped=concluded(first[control_name(FULL, "swapped")]),
        perceived=np.where(full.streams, slots, BOTTOM),
    )
    asks = bench_questions(study.data, config.quota, context)
    chosen = [(case.title, first_of(case.rows, questions.objects, SHOWN)) for case in cases]
    chosen += item_examples(asks, bench_answers(study.data, asks, [full])[0], touch_rows(study.data), full)
    return study_results(
        study,
        score_study(study),
        verdict=verdict(cases),
        tables=(case_table(cases), differences_table((*presets.DIFFERENCES[:3], *DIFFERENCES))),
        data=study.data.summary() | {"items of the bench": len(asks)},
        curves=presets.CURVES,
        examples=tuple(browser(study, chosen)),
    )


def answer_cases(
    questions: TouchQuestions,
    *,
    full: Int[np.ndarray, "N"],
    sft: Int[np.ndarray, "N"],
    blind: Int[np.ndarray, "N"],
    swapped: Int[np.ndarray, "N"],
    perceived: Int[np.ndarray, "N S"],
) -> tuple[AnswerCase, ...]:
    """The kinds of answers that are shown, from the levels that policies of one seed concluded, −1 for ⊥.

    `swapped` is the full model with another object's touch, `perceived` the level that it perceives by each sensor, −1
    where a sensor is absent.
    """
    right, read = full == questions.label, full != BOTTOM
    material = questions.of("material")
    misled = questions.looks_like_another & (blind != questions.label) & (blind != BOTTOM)
    known = perceived != BOTTOM
    least = np.where(known, perceived, np.iinfo(perceived.dtype).max).min(1)
    split = questions.ordinal & (known.sum(1) > 1) & (least < perceived.max(1))
    two_off = read & (np.abs(full - questions.label) > 1)
    case = lambda title, rows, among, **paper: AnswerCase(title=title, rows=rows & among, among=among, **paper)
    return (
        case("Hardness is right, and wrong with another object's touch", right & (swapped != questions.label),
             questions.of("hardness"), paper="hardness, estimated from touch"),
        case("The picture deceives about the material, touch overrules it", right, misled & material,
             paper="a conflict about the material, resolved"),
        case("The picture deceives about a level, touch overrules it", right, misled & ~material),
        case("The picture deceives and is followed", full == blind, misled),
        case("Sensors disagree, the conclusion is right", right, split),
        case("Sensors disagree, the conclusion is wrong", ~right, split),
        case("Two levels off", two_off, questions.ordinal),
        case("GRPO corrects a wrong answer of SFT", right, sft != questions.label),
        case("GRPO makes a right answer of SFT wrong", ~right, sft == questions.label),
        case("Cannot be read", ~read, np.ones_like(read)),
    )  # fmt: skip


def first_of(rows: Bool[np.ndarray, "N"], objects: np.ndarray, count: int) -> list[int]:
    """Indices of the first `count` answers that fit, one of each object; `objects` [N] is that of each answer."""
    numbers = np.flatnonzero(rows)
    _, first = np.unique(objects[numbers], return_index=True)
    return [int(n) for n in numbers[np.sort(first)[:count]]]


def item_examples(
    asks: Sequence[Ask], answers: Mapping[str, tuple[int, ...]], places: Mapping[Touch, int], full: Evaluation
) -> Iterator[tuple[str, list[int]]]:
    """Of each of `SHOWN_KINDS` the first item answered right and the first wrong: heading, indices in `full`."""
    index = {(int(c), int(a)): n for n, (c, a) in enumerate(zip(full.contact, full.attribute, strict=True))}
    for kind in SHOWN_KINDS:
        for wanted in (True, False):
            ask = next((x for x in asks if x.kind == kind and (answers[x.id] == x.answer) == wanted), None)
            if ask is not None:
                pairs = [(places[t], ATTRIBUTES.index(a)) for t in ask.touches for a in ask.attributes]
                words, outcome = (
                    "an answer that cannot be read",
                    "right" if wanted else f"wrong, it is {answer_words(ask)}",
                )
                if BOTTOM not in answers[ask.id]:
                    words = answer_words(dataclasses.replace(ask, answer=answers[ask.id]))
                heading = f"Tier {KINDS[kind].tier}, {kind}: {question(ask)} – {words} ({outcome})"
                yield heading, [index[pair] for pair in pairs]


def case_table(cases: Sequence[AnswerCase]) -> Table:
    """Number and share of each kind of answer."""
    return named_table(
        "How common each case is",
        [
            {
                "case": case.title,
                "answers": int(case.rows.sum()),
                "of": int(case.among.sum()),
                "share": case.share if case.among.any() else None,
                "paper's examples": case.paper,
            }
            for case in cases
        ],
        formats={"answers": "d", "of": "d", "share": ".1f"},
        units={"share": "%"},
        meanings={
            "of": "questions that could have been of this case",
            "paper's examples": "described in the caption of its figure",
        },
        note="The full model's most likely answers, of its first seed, to all questions about the test objects. The "
        "paper shows chosen examples without their frequency.",
    )


def browser(study: Study, chosen: Sequence[tuple[str, Sequence[int]]]) -> Iterator[RolloutExample]:
    """The cards of each group of answers: its heading, and indices in the full model's answers."""
    instead = {REPLACEMENTS[control]: seeds[0] for control, seeds in control_answers(study, FULL).items()}
    instead |= {title: study.answers[policy][0] for policy, title in OTHER_POLICIES.items()}
    for group, rows in chosen:
        yield from rollouts_of(study, FULL, PUBLISHED, rows, instead, group)


def verdict(cases: Sequence[AnswerCase]) -> tuple[str, ...]:
    """Frequency of the cases in the paper's figure, and of answers that follow the picture."""
    hardness, material, level, followed = cases[:4]
    misled, overruled = (int(getattr(material, f).sum() + getattr(level, f).sum()) for f in ("among", "rows"))
    return (
        f"In {hardness.share:.0f} % of its questions the answer for hardness is right and depends on touch: it is "
        "wrong with another object's touch.",
        f"Where the picture misleads a policy without touch ({misled} questions), touch overrules it in {overruled}; "
        f"in {int(followed.rows.sum())} the picture is followed. About the material, the case that the paper shows, "
        f"touch overrules it in {int(material.rows.sum())} of {int(material.among.sum())}.",
    )


EXPERIMENT = presets.paper_experiment(
    "qualitative",
    QualitativeConfig(),
    {name: QualitativeConfig(study=dataclasses.replace(study, seeds=1)) for name, study in presets.SCALES.items()}
    | {"smoke": QualitativeConfig(study=dataclasses.replace(presets.SMOKE, seeds=1), quota=presets.SMALL_QUOTA)},
    run,
)
