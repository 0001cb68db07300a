"""Labels by two people who do not see each other's: agreement, adjudication, and what force and deformation say.

Each annotator fills in a sheet of their own, in an order of its own; where they differ a third decides.  A label is
doubted where, for most sensors, the object's own measurement lies nearer to the opposite level's than to its level's.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

from experiments.bench.contacts import MeasuredContact
from experiments.bench.sheets import SheetError, read_sheet, write_sheet
from sensors_io.schema import ATTRIBUTES, LEVELS
from touchr1_jax.bench.agreement import cohens_kappa
from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.text.language import TOUCH_LANGUAGE

KEY, CASE, DECISION = "object", "case", "decision"

PHYSICAL: Mapping[str, str] = {"hardness": "stiffness", "roughness": "fine texture", "protrusion": "coarse texture"}
"""The measured quantity that an ordinal label is held against: force over deformation, energies of the relief."""

LEAST_RHO = 0.3
"""Spearman's ρ, of either sign, between labels and quantity below which a sensor has no say about a label."""

WORDS: Mapping[str, tuple[str, ...]] = {
    name: tuple(words[0] for words in TOUCH_LANGUAGE.attributes[TOUCH_LANGUAGE.attribute_index(name)].levels)
    for name in ATTRIBUTES
}
"""How the levels are called on a sheet."""

Labels = Mapping[str, Mapping[str, int]]
"""Object → attribute → level."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnnotatorAgreement:
    """Of two annotators about one attribute: κ, κ with quadratic weights where it is ordinal, share of equal labels.

    κ is `None` where both gave one and the same label throughout.
    """

    attribute: str
    objects: int
    kappa: float | None
    weighted: float | None
    exact: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class DoubtfulLabel:
    """A label that most sensors' measurements contradict."""

    object: str
    attribute: str
    label: str
    sensors: tuple[str, ...]


def write_blank(paths: Sequence[str], objects: Sequence[str], seed: int) -> None:
    """One blank sheet for each annotator, the objects in an order of its own.

    Raises:
      SheetError: a sheet that exists.
    """
    for n, path in enumerate(paths):
        order = np.random.default_rng([seed, n]).permutation(len(objects))
        write_sheet(path, (KEY, *ATTRIBUTES), ({KEY: objects[i]} for i in order))


def read_labels(path: str, objects: Sequence[str]) -> dict[str, dict[str, int]]:
    """A filled-in sheet, as levels.

    Raises:
      SheetError: as `read_sheet`.
    """
    rows = read_sheet(path, KEY, WORDS, objects)
    return {name: {a: WORDS[a].index(word) for a, word in row.items()} for name, row in rows.items()}


def agreement(a: Labels, b: Labels) -> tuple[AnnotatorAgreement, ...]:
    """How far two annotators agree about the same objects, attribute by attribute."""
    found = []
    for name in ATTRIBUTES:
        x, y = (np.array([labels[o][name] for o in sorted(a)]) for labels in (a, b))
        varied = len({*x.tolist(), *y.tolist()}) > 1
        found.append(
            AnnotatorAgreement(
                attribute=name,
                objects=len(x),
                kappa=cohens_kappa(x, y, LEVELS[name]) if varied else None,
                weighted=cohens_kappa(x, y, LEVELS[name], weights="quadratic") if varied and name in ORDINAL else None,
                exact=float(np.mean(x == y)),
            )
        )
    return tuple(found)


def open_cells(a: Labels, b: Labels) -> dict[str, list[str]]:
    """Object → attributes in which the two differ, for the adjudicator."""
    differing = {o: [name for name in ATTRIBUTES if a[o][name] != b[o][name]] for o in sorted(a)}
    return {o: names for o, names in differing.items() if names}


def write_open(path: str, a: Labels, b: Labels) -> None:
    """The sheet of the adjudicator: one row per disagreement, what was said in a drawn order, the decision blank.

    Raises:
      SheetError: the sheet exists.
    """
    rows = []
    for case, (o, name) in _cases(a, b).items():
        said = sorted(WORDS[name][labels[o][name]] for labels in (a, b))  # sorted, so that nobody knows whose
        rows.append({CASE: case, "said": " or ".join(said)})
    write_sheet(path, (CASE, "said", DECISION), rows)


def adjudicate(a: Labels, b: Labels, decided: Mapping[tuple[str, str], int]) -> dict[str, dict[str, int]]:
    """The final labels: where both agree, theirs, elsewhere the decision.

    Raises:
      KeyError: a disagreement that nobody decided.
    """
    return {
        o: {name: a[o][name] if a[o][name] == b[o][name] else decided[o, name] for name in ATTRIBUTES}
        for o in sorted(a)
    }


def read_decisions(path: str, a: Labels, b: Labels) -> dict[tuple[str, str], int]:
    """The adjudicator's sheet: (object, attribute) → level.

    Raises:
      SheetError: as `read_sheet`, or a decision that is no level of its attribute.
    """
    cases = _cases(a, b)
    every = sorted({word for words in WORDS.values() for word in words})
    decided = {}
    for case, row in read_sheet(path, CASE, {DECISION: every}, cases).items():
        o, name = cases[case]
        if row[DECISION] not in WORDS[name]:
            raise SheetError(
                f"{path}: {DECISION} for {case!r} is {row[DECISION]!r}: must be one of {', '.join(WORDS[name])}; "
                "correct it"
            )
        decided[o, name] = WORDS[name].index(row[DECISION])
    return decided


def _cases(a: Labels, b: Labels) -> dict[str, tuple[str, str]]:
    """What the adjudicator's rows are called → object and attribute."""
    return {f"{o}: {name}": (o, name) for o, names in open_cells(a, b).items() for name in names}


def rank_correlations(labels: Labels, contacts: Sequence[MeasuredContact]) -> dict[tuple[str, str], float]:
    """Spearman's ρ of each ordinal label and its quantity, by attribute and sensor, over the objects measured."""
    found = {}
    for name in ORDINAL:
        for sensor in _sensors(contacts):
            values = _values(labels, contacts, sensor, name)
            levels = [labels[o][name] for o in values]
            if len(set(levels)) > 1 and len(set(values.values())) > 1:
                found[name, sensor] = float(stats.spearmanr(list(values.values()), levels).statistic)
    return found


def doubts(labels: Labels, contacts: Sequence[MeasuredContact]) -> tuple[DoubtfulLabel, ...]:
    """Labels of the lowest or highest level whose measurement lies nearer to the median of the opposite one.

    A sensor that measured no object of either end, or whose quantity does not follow the labels, has no say; most of
    the others must agree.
    """
    found, follows = [], rank_correlations(labels, contacts)
    for name in ORDINAL:
        says: dict[str, list[tuple[str, bool]]] = {}
        for sensor in _sensors(contacts):
            values = _values(labels, contacts, sensor, name)
            ends = (0, LEVELS[name] - 1)
            of_level = [[v for o, v in values.items() if labels[o][name] == end] for end in ends]
            if not all(of_level) or abs(follows.get((name, sensor), 0.0)) < LEAST_RHO:
                continue
            medians = [float(np.median(of)) for of in of_level]
            for o in (o for o in values if labels[o][name] in ends):
                own, opposite = medians if labels[o][name] == 0 else medians[::-1]
                says.setdefault(o, []).append((sensor, abs(values[o] - opposite) < abs(values[o] - own)))
        for o, votes in sorted(says.items()):
            against = tuple(sensor for sensor, beyond in votes if beyond)
            if 2 * len(against) > len(votes):
                found.append(
                    DoubtfulLabel(object=o, attribute=name, label=WORDS[name][labels[o][name]], sensors=against)
                )
    return tuple(found)


def _sensors(contacts: Sequence[MeasuredContact]) -> list[str]:
    return sorted({sensor for contact in contacts for sensor in contact.measured})


def _values(labels: Labels, contacts: Sequence[MeasuredContact], sensor: str, name: str) -> dict[str, float]:
    """Mean of an attribute's quantity over the contacts of each labelled object, by one sensor."""
    quantity, found = PHYSICAL[name], dict[str, list[float]]()
    for contact in contacts:
        measured = contact.measured.get(sensor)
        if measured is not None and contact.touch.object in labels and quantity in measured.quantities:
            found.setdefault(contact.touch.object, []).append(measured.quantities[quantity])
    return {o: float(np.mean(values)) for o, values in found.items()}
