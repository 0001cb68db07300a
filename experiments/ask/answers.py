"""Answers of a policy about its inputs, with the truth: for the terminal, for programs, for the page."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from experiments.ask.inputs import AskedTouch
from experiments.core.text import bounds
from touchr1_jax.asking import (
    AskablePolicy,
    ComparedTouches,
    TouchAnswer,
    compared,
)
from touchr1_jax.bench.statistics import clustered_bootstrap
from touchr1_jax.text.plain_questions import AskedAttribute, QuestionError, read_question
from touchr1_jax.training.evaluation import answer_program, evaluate_policy

COMPARATIVE: Mapping[str, str] = {"hardness": "harder", "roughness": "rougher", "protrusion": "more protruding"}
"""Of each attribute that is compared where no question is given."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class AskedPolicy:
    """One or two inputs, the answers about each, and the comparisons between two.

    Attributes:
      policy: its name.
      touches: the inputs.
      answers: for each input those that were asked for.
      comparisons: of two inputs.
    """

    policy: str
    touches: tuple[AskedTouch, ...]
    answers: tuple[tuple[TouchAnswer, ...], ...]
    comparisons: tuple[ComparedTouches, ...] = ()


def ask_policy(policy: AskablePolicy, touches: Sequence[AskedTouch], question: str = "") -> AskedPolicy:
    """Ask a question about one touch or two; without one, all that can be asked.

    Raises:
      QuestionError: a question that names no attribute, or that compares where nothing can be compared.
    """
    asked = read_question(question, policy.attributes) if question else None
    names = list(policy.attributes) if asked is None else [asked.name]
    if asked is not None and asked.compares and (len(touches) != 2 or asked.name not in _ordinal(policy)):
        raise QuestionError(
            f"question is {question!r}: it compares two objects by {', '.join(_ordinal(policy))}; give two INPUTs, or "
            f"ask about one, as in '{policy.saved.questions[asked.name]}?'"
        )
    found = policy.answers([touch.touch for touch in touches])
    comparisons: list[ComparedTouches] = []
    if len(touches) == 2:
        wanted = [AskedAttribute(name=name, sign=1, compares=True) for name in names if name in _ordinal(policy)]
        for one in [asked] if asked is not None and asked.compares else wanted:
            words = question if one is asked else f"Which is {COMPARATIVE.get(one.name, f'more of {one.name}')}?"
            comparisons.append(compared(words, one, found[0][one.name], found[1][one.name]))
    return AskedPolicy(
        policy=str(policy.saved.notes.get("name", policy.name)),
        touches=tuple(touches),
        answers=tuple(tuple(of_touch[name] for name in names) for of_touch in found),
        comparisons=tuple(comparisons),
    )


def _ordinal(policy: AskablePolicy) -> list[str]:
    return [attribute.name for attribute in policy.saved.policy.language.attributes if attribute.ordinal]


def verdict(answer: TouchAnswer, truth: Mapping[str, str]) -> str:
    """ "right", "wrong: it is soft", or nothing where the truth is unknown."""
    if answer.attribute not in truth:
        return ""
    true = truth[answer.attribute]
    return "right" if answer.word == true else f"wrong: it is {true}"


def shares(probabilities: Mapping[str, float]) -> str:
    """Probabilities in words, the first digit only where that is all: "soft 71 %, firm 20 %, hard 9 %"."""
    return ", ".join(f"{word} {100 * p:.0f} %" for word, p in probabilities.items())


def text_lines(found: AskedPolicy) -> Iterator[str]:
    """Everything as lines for a terminal."""
    yield f"policy  {found.policy}"
    for touch, answers in zip(found.touches, found.answers, strict=True):
        sensors = ", ".join(f"{name} ({len(frames)} frames)" for name, frames in touch.touch.frames.items())
        yield f"touch   {touch.name}: {sensors}"
        yield from (f"note    {remark}" for remark in touch.remarks)
        for answer in answers:
            judged = verdict(answer, touch.truth)
            yield f"\n{answer.question} {answer.word or 'no readable answer'}" + (f"  ({judged})" if judged else "")
            yield f"  with touch     {shares(answer.probabilities)}"
            if answer.untouched is not None:
                yield f"  without touch  {shares(answer.untouched.probabilities)}"
            yield f"  trace          {answer.trace}"
        yield ""
    for one in found.comparisons:
        yield f"{one.question} the {one.word} ({shares(one.probabilities)})"
        if one.untouched is not None:
            yield f"  without touch  {shares(one.untouched.probabilities)}"


def as_json(found: AskedPolicy) -> dict[str, Any]:
    """Everything but the frames, in JSON's types."""
    touches = []
    for touch, answers in zip(found.touches, found.answers, strict=True):
        each = [answer_json(answer) | {"truth": touch.truth.get(answer.attribute)} for answer in answers]
        touches.append({"name": touch.name, "remarks": list(touch.remarks), "answers": each})
    return {"policy": found.policy, "touches": touches, "comparisons": [comparison_json(c) for c in found.comparisons]}


def answer_json(answer: TouchAnswer) -> dict[str, Any]:
    """An answer in JSON's types; the one without touch is nested."""
    plain = {name: getattr(answer, name) for name in ("question", "attribute", "word", "trace")}
    without = None if answer.untouched is None else answer_json(answer.untouched)
    return plain | {"probabilities": dict(answer.probabilities), "without_touch": without}


def comparison_json(one: ComparedTouches) -> dict[str, Any]:
    """A comparison in JSON's types."""
    without = None if one.untouched is None else dict(one.untouched.probabilities)
    plain = {name: getattr(one, name) for name in ("question", "attribute", "word")}
    return plain | {"probabilities": dict(one.probabilities), "without_touch": without}


def count_right(policy: AskablePolicy, touches: Sequence[AskedTouch], objects: np.ndarray) -> Iterator[str]:
    """For each attribute the share of right answers, 95 % over objects [n], and that of the best constant answer.

    Raises:
      NoLabelsError: no label is known.
    """
    saved, features = policy.saved, policy.encode([touch.touch for touch in touches])
    levels = list(policy.attributes.items())
    label = np.array([[words.index(t.truth[a]) if a in t.truth else -1 for a, words in levels] for t in touches])
    answer = answer_program(saved.policy, constrained=True)
    asked = evaluate_policy(saved.policy, saved.params, features, label, alone=False, answer=answer)
    yield f"policy  {saved.notes.get('name', policy.name)}"
    for i, (name, _) in enumerate(levels):
        rows = np.flatnonzero(asked.attribute == i)
        true, of = label[asked.contact[rows], i], objects[asked.contact[rows]]
        if len(set(of)) < 2:
            yield f"  {name:<12} labels of fewer than two objects are known"
            continue
        share = clustered_bootstrap(100.0 * (np.asarray(asked.parsed.conclude)[rows, i] == true), of)
        constant = 100 * np.bincount(true).max() / len(true)
        shown = f"{share.mean:.1f} % {bounds(share.low, share.high, '.1f')} right of {len(rows)}"
        yield f"  {name:<12} {shown}; always the most frequent level {constant:.1f} %"
