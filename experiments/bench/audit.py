"""A blind audit of items by people: a drawn sample, three questions about each, the share that passes.

The sheet shows what a judge needs and no more: question, what was measured, rationale, answer, the labels.  Its numbers
say nothing of the item's kind, author or place in the file; the key that does stays in a file of its own.
"""

import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.bench.contacts import MeasuredContact
from experiments.bench.sheets import SheetError, read_sheet, write_sheet
from experiments.bench.wording import answer_words
from touchr1_jax.bench.agreement import cohens_kappa, wilson_interval
from touchr1_jax.bench.items import Item, Touch
from touchr1_jax.bench.statistics import Interval, clustered_bootstrap
from touchr1_jax.text.language import TOUCH_LANGUAGE

AXES = ("grounded", "fits the labels", "self-consistent")
"""Is the rationale grounded in tactile evidence; does it fit the human labels; does its reasoning hold together."""

YES, NO = "yes", "no"
NUMBER = "number"
SHOWN = ("question", "labels", "measured", "rationale", "answer")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PassRate:
    """How many of the sample passed: with Wilson's interval, as if items were independent, and by whole objects."""

    axis: str
    items: int
    rate: Interval
    by_object: Interval


def sample(items: Sequence[Item], count: int, seed: int) -> dict[str, str]:
    """The key: number on the sheet → id of the item; drawn without replacement.

    Raises:
      SheetError: more than there are, or none.
    """
    if not 1 <= count <= len(items):
        raise SheetError(f"count is {count}: must lie in 1..{len(items)}, the items there are; change it")
    chosen = np.random.default_rng(seed).choice(len(items), count, replace=False)
    width = len(str(count))
    return {f"{number:0{width}d}": items[i].ask.id for number, i in enumerate(chosen, 1)}


def read_key(path: str | os.PathLike[str], items: Sequence[Item]) -> dict[str, str]:
    """A key that `sample` drew from these items.

    Raises:
      SheetError: no such file, one that holds no key, or one of other items.
    """
    try:
        key = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SheetError(f"{path} is missing: must be the .key.json that lies beside the sheet; correct it") from None
    except (OSError, ValueError) as error:
        raise SheetError(
            f"{path} cannot be read ({error}): must be the .key.json beside the sheet; correct it"
        ) from error
    if not isinstance(key, dict) or not all(isinstance(name, str) for name in key.values()):
        raise SheetError(f"{path} holds no key: must be the .key.json beside the sheet; correct the path")
    strange = sorted(set(key.values()) - {item.ask.id for item in items})
    if strange:
        raise SheetError(f"{path} names item {strange[0]!r}, which is not there: must be of the same items; give those")
    return key


def write_blank(
    path: str, items: Sequence[Item], key: Mapping[str, str], contacts: Mapping[Touch, MeasuredContact]
) -> None:
    """The sheet of a judge, the three axes blank.

    Raises:
      SheetError: the sheet exists.
    """
    by_id = {item.ask.id: item for item in items}
    rows = ({NUMBER: number} | _row(by_id[name], contacts) for number, name in key.items())
    write_sheet(path, (NUMBER, *SHOWN, *AXES), rows)


def read_judgement(path: str, key: Mapping[str, str]) -> dict[str, dict[str, bool]]:
    """A filled-in sheet: number → axis → whether it passed.

    Raises:
      SheetError: as `read_sheet`.
    """
    rows = read_sheet(path, NUMBER, dict.fromkeys(AXES, (YES, NO)), key)
    return {number: {axis: word == YES for axis, word in row.items()} for number, row in rows.items()}


def pass_rates(
    judged: Mapping[str, Mapping[str, bool]], key: Mapping[str, str], items: Sequence[Item]
) -> tuple[PassRate, ...]:
    """Each axis, and all three at once, which is the paper's pass rate.

    Raises:
      ValueError: fewer than two objects in the sample.
    """
    cluster = {item.ask.id: item.ask.cluster for item in items}
    objects = np.array([cluster[key[number]] for number in judged])
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


def judges_agree(a: Mapping[str, Mapping[str, bool]], b: Mapping[str, Mapping[str, bool]]) -> dict[str, float | None]:
    """Cohen's κ of two judges of one sample, axis by axis; `None` where both said the same of everything."""
    found: dict[str, float | None] = {}
    for axis in AXES:
        x, y = (np.array([int(judged[number][axis]) for number in sorted(a)]) for judged in (a, b))
        found[axis] = cohens_kappa(x, y, 2) if len({*x.tolist(), *y.tolist()}) > 1 else None
    return found


def _row(item: Item, contacts: Mapping[Touch, MeasuredContact]) -> dict[str, str]:
    cited = (f"touch {c.touch + 1} {c.sensor}: {c.quantity} {c.value:g} {c.unit}" for c in item.evidence)
    labels = (
        ", ".join(_word(name, contacts[touch].labels[name]) for name in item.ask.attributes)
        for touch in item.ask.touches
    )
    return {
        "question": item.question,
        "labels": " | ".join(labels),
        "measured": "; ".join(cited),
        "rationale": item.rationale,
        "answer": answer_words(item.ask),
    }


def _word(name: str, level: int) -> str:
    return TOUCH_LANGUAGE.attributes[TOUCH_LANGUAGE.attribute_index(name)].levels[level][0]
