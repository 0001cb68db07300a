"""A blind audit of items by people: a random sample, three questions about each item, the share that passes.

The sheet shows what a judge needs and no more: question, labels, measurements, rationale, answer.  Its numbers reveal
nothing of an item's kind, author or place in the file; the key that does is a file of its own.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from touchr1_jax.bench.items import Item, Touch
from touchr1_jax.bench.people.sheets import SheetError, kappa_unless_constant, read_sheet, write_sheet
from touchr1_jax.bench.questions.contacts import MeasuredContact
from touchr1_jax.bench.questions.wording import answer_words, level_words
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap, wilson_interval

AXES = ("grounded", "fits the labels", "self-consistent")
"""Is the rationale grounded in tactile evidence, does it fit the human labels, is its reasoning consistent?"""

YES, NO = "yes", "no"
NUMBER = "number"
SHOWN = ("question", "labels", "measured", "rationale", "answer")

Judgement = Mapping[str, Mapping[str, bool]]
"""Number on the sheet → axis → passed."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PassRate:
    """Share of the sample that passed, with Wilson's interval for independent items, and with one over objects."""

    axis: str
    items: int
    rate: Interval
    by_object: Interval


def sample(items: Sequence[Item], count: int, seed: int) -> dict[str, str]:
    """The key: number on the sheet → id of the item; drawn without replacement.

    Raises:
      SheetError: the count is not between 1 and the number of items.
    """
    if not 1 <= count <= len(items):
        raise SheetError(f"count is {count}: must lie in 1..{len(items)}, the number of items; change it")
    chosen = np.random.default_rng(seed).choice(len(items), count, replace=False)
    width = len(str(count))
    return {f"{number:0{width}d}": items[i].ask.id for number, i in enumerate(chosen, 1)}


def read_key(path: Path, items: Sequence[Item]) -> dict[str, str]:
    """A key that `sample` drew from these items.

    Raises:
      SheetError: a file that is missing, is not a key, or is a key of other items.
    """
    must = "must be the .key.json next to the sheet; correct the path"
    try:
        key = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise SheetError(f"{path} cannot be read ({error}): {must}") from error
    if not isinstance(key, dict) or not all(isinstance(name, str) for name in key.values()):
        raise SheetError(f"{path} holds no key: {must}")
    unknown = sorted(set(key.values()) - {item.ask.id for item in items})
    if unknown:
        raise SheetError(f"{path} names the unknown item {unknown[0]!r}: must be of the same items; give those")
    return key


def write_blank(
    path: Path, items: Sequence[Item], key: Mapping[str, str], contacts: Mapping[Touch, MeasuredContact]
) -> None:
    """Write the sheet of a judge, the three axes blank.

    Raises:
      SheetError: the sheet exists.
    """
    by_id = {item.ask.id: item for item in items}

    def shown(item: Item) -> dict[str, str]:
        cited = (f"touch {c.touch + 1} {c.sensor}: {c.quantity} {c.value:g} {c.unit}" for c in item.evidence)
        labels = (
            ", ".join(level_words(name)[contacts[touch].labels[name]] for name in item.ask.attributes)
            for touch in item.ask.touches
        )
        cells = (item.question, " | ".join(labels), "; ".join(cited), item.rationale, answer_words(item.ask))
        return dict(zip(SHOWN, cells, strict=True))

    rows = ({NUMBER: number} | shown(by_id[name]) for number, name in key.items())
    write_sheet(path, (NUMBER, *SHOWN, *AXES), rows)


def read_judgement(path: Path, key: Mapping[str, str]) -> dict[str, dict[str, bool]]:
    """A filled-in sheet.

    Raises:
      SheetError: as `read_sheet`.
    """
    rows = read_sheet(path, NUMBER, dict.fromkeys(AXES, (YES, NO)), key)
    return {number: {axis: word == YES for axis, word in row.items()} for number, row in rows.items()}


def pass_rates(judged: Judgement, key: Mapping[str, str], items: Sequence[Item]) -> tuple[PassRate, ...]:
    """Pass rates by axis, and of all three axes together, which is the paper's pass rate.

    Raises:
      SheetError: fewer than two objects in the sample.
    """
    cluster = {item.ask.id: item.ask.cluster for item in items}
    objects = np.array([cluster[key[number]] for number in judged])
    if len({*objects.tolist()}) < 2:
        raise SheetError(f"the sample's {len(objects)} items are of one object: must be of two; draw more by --count")
    columns = {axis: [row[axis] for row in judged.values()] for axis in AXES}
    columns["all three"] = [all(row.values()) for row in judged.values()]
    return tuple(
        PassRate(
            axis=axis,
            items=len(values),
            rate=wilson_interval(sum(values), len(values)),
            by_object=clustered_bootstrap(np.array(values, float), objects),
        )
        for axis, values in columns.items()
    )


def judge_agreement(a: Judgement, b: Judgement) -> dict[str, float | None]:
    """Cohen's κ of two judges of one sample, by axis; `None` where both gave one and the same answer throughout."""
    answers = lambda judged, axis: np.array([int(judged[number][axis]) for number in sorted(a)])
    return {axis: kappa_unless_constant(answers(a, axis), answers(b, axis), 2) for axis in AXES}
