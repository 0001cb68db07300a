"""Kinds of answers that are worth reading, how common each is, and the first few of each: chosen by rule, not by hand.

The rules see what was answered and what is right, nothing else; of the answers that fit, those of the first objects in
the order of the data are shown, one of each object.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int

from experiments.bench.wording import answer_words, question
from experiments.core.results import Cell, Column, Table
from experiments.paper.conflict_metrics import Asked, spoken
from experiments.study.answers import Evaluated
from sensors_io.schema import ATTRIBUTES
from touchr1_jax.bench.items import KINDS, Ask, Touch
from touchr1_jax.bench.metrics import BOTTOM

SHOWN_KINDS = ("compose", "compare", "order")
"""Kinds of the bench's items whose answer is made of several answers."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Said:
    """What policies of one seed concluded for the same N questions, −1 for ⊥: each int [N].

    `strange` is the full model with another object's touch, `perceived` [N, S] what it says each sensor feels, −1 where
    a sensor is not there.
    """

    full: Int[np.ndarray, "N"]
    sft: Int[np.ndarray, "N"]
    blind: Int[np.ndarray, "N"]
    strange: Int[np.ndarray, "N"]
    perceived: Int[np.ndarray, "N S"]

    @staticmethod
    def of(full: Evaluated, sft: Evaluated, blind: Evaluated, strange: Evaluated) -> "Said":
        """From the answers of each."""
        n = np.arange(len(full.contact))
        slots = np.asarray(full.parsed.perceive)[n, :, full.attribute]
        return Said(
            full=spoken(full),
            sft=spoken(sft),
            blind=spoken(blind),
            strange=spoken(strange),
            perceived=np.where(full.streams, slots, BOTTOM),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A kind of answer: its name, what the paper shows of it, the answers that are of it, and those it is a share of.

    Attributes:
      title: what happens.
      paper: what its figure of examples says of it; empty where it shows none.
      rows, among: bool [N].
    """

    title: str
    paper: str
    rows: Bool[np.ndarray, "N"]
    among: Bool[np.ndarray, "N"]

    @property
    def share(self) -> float:
        """Percent; 0 where there is nothing to be a share of."""
        return 100.0 * float((self.rows & self.among).sum()) / max(int(self.among.sum()), 1)


def cases(asked: Asked, said: Said) -> tuple[Case, ...]:
    """The kinds of answers that are shown.

    Args:
      asked: the questions.
      said: the answers.
    """
    right, read = said.full == asked.label, said.full != BOTTOM
    hardness = asked.attribute == asked.names.index("hardness")
    material = asked.attribute == asked.names.index("material")
    lied_to = asked.lies & (said.blind != asked.label) & (said.blind != BOTTOM)
    known = said.perceived != BOTTOM
    least = np.where(known, said.perceived, np.iinfo(said.perceived.dtype).max).min(1)
    split = asked.ordinal & (known.sum(1) > 1) & (least < said.perceived.max(1))
    far = asked.ordinal & read & (np.abs(said.full - asked.label) > 1)
    case = lambda title, rows, among, paper="": Case(title=title, paper=paper, rows=rows & among, among=among)
    return (
        case("Hardness is right, and wrong with another object's touch", right & (said.strange != asked.label),
             hardness, "hardness, estimated from touch"),
        case("The picture lies about the material, touch overrules it", right, lied_to & material,
             "a conflict about the material, resolved"),
        case("The picture lies about a level, touch overrules it", right, lied_to & ~material),
        case("The picture lies and is believed", said.full == said.blind, lied_to),
        case("Sensors disagree, the conclusion is right", right, split),
        case("Sensors disagree, the conclusion is wrong", ~right, split),
        case("Two levels off", far, asked.ordinal),
        case("GRPO mends what SFT had wrong", right, said.sft != asked.label),
        case("GRPO spoils what SFT had right", ~right, said.sft == asked.label),
        case("Cannot be read", ~read, np.ones_like(read)),
    )  # fmt: skip


def first_of(rows: Bool[np.ndarray, "N"], objects: np.ndarray, count: int) -> list[int]:
    """Numbers of the first answers, one of each object.

    Args:
      rows: which answers fit.
      objects: [N], what each is about.
      count: how many at most.
    """
    numbers = np.flatnonzero(rows)
    _, first = np.unique(objects[numbers], return_index=True)
    return [int(n) for n in numbers[np.sort(first)[:count]]]


def case_table(found: Sequence[Case]) -> Table:
    """How common each kind of answer is: what a page of examples cannot say."""
    rows: list[tuple[Cell, ...]] = [
        (case.title, int(case.rows.sum()), int(case.among.sum()), case.share, case.paper or "–") for case in found
    ]
    return Table(
        title="How common each case is",
        columns=(
            Column(name="case"),
            Column(name="answers", format="d"),
            Column(name="of", format="d", meaning="questions that could have been of this case"),
            Column(name="share", unit="%", format=".1f"),
            Column(name="paper's examples", meaning="what its figure of examples is said to show"),
        ),
        rows=tuple(rows),
        note="Greedy answers of the full model's first seed to all questions about the test objects. The paper shows "
        "chosen examples and says of none how common it is.",
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shown:
    """One item of the bench under its heading, and the answers that its own is made of."""

    heading: str
    rows: tuple[int, ...]


def items_shown(
    asks: Sequence[Ask],
    answers: Mapping[str, tuple[int, ...]],
    places: Mapping[Touch, int],
    full: Evaluated,
) -> list[Shown]:
    """Of each of `SHOWN_KINDS` the first item that is right and the first that is wrong.

    Args:
      asks: the bench's items.
      answers: id → what the full model answers.
      places: touch → contact, as `full.contact` counts.
      full: answers about single touches.
    """
    number = {(int(c), int(a)): n for n, (c, a) in enumerate(zip(full.contact, full.attribute, strict=True))}
    found = []
    for kind in SHOWN_KINDS:
        for wanted in (True, False):
            ask = next((x for x in asks if x.kind == kind and (answers[x.id] == x.answer) == wanted), None)
            if ask is not None:
                pairs = [(places[t], ATTRIBUTES.index(a)) for t in ask.touches for a in ask.attributes]
                rows = tuple(number[pair] for pair in pairs)
                found.append(Shown(heading=_heading(ask, answers[ask.id]), rows=rows))
    return found


def _heading(ask: Ask, answer: tuple[int, ...]) -> str:
    words = "nothing that can be read"
    if BOTTOM not in answer:
        words = answer_words(dataclasses.replace(ask, answer=answer))
    verdict = "right" if answer == ask.answer else f"wrong, it is {answer_words(ask)}"
    return f"Tier {KINDS[ask.kind].tier}, {ask.kind}: {question(ask)} – {words} ({verdict})"
