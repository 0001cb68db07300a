"""Labels by two annotators: blank sheets, agreement, adjudication, and labels that the measurements contradict.

Each annotator fills in a sheet without seeing the other's, the objects in an order of its own; a third person decides
where they differ.  A label is doubtful if for most sensors the object's measurement is nearer to the median of the
opposite level than to that of its own.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.people.sheets import SheetError, kappa_unless_constant, read_sheet, write_sheet
from touchr1_jax.bench.questions.contacts import MeasuredContact
from touchr1_jax.bench.questions.wording import LEVELS, level_words

KEY, CASE, DECISION = "object", "case", "decision"

PHYSICAL: Mapping[str, str] = {"hardness": "stiffness", "roughness": "fine texture", "protrusion": "coarse texture"}
"""The measured quantity that an ordinal label is compared with: force over deformation, energies of the relief."""

LEAST_RHO = 0.3
"""Least |Spearman's ρ| between labels and quantity for a sensor to have a vote on a label."""

WORDS: Mapping[str, tuple[str, ...]] = {name: tuple(level_words(name)) for name in LEVELS}
"""Words for the levels on a sheet."""

Labels = Mapping[str, Mapping[str, int]]
"""Object → attribute → level."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnnotatorAgreement:
    """Agreement of two annotators on one attribute: κ, κ with quadratic weights if ordinal, share of equal labels.

    κ is `None` where both gave one and the same label throughout.
    """

    attribute: str
    objects: int
    kappa: float | None
    weighted: float | None
    exact: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class DoubtfulLabel:
    """A label that the measurements of most sensors contradict."""

    object: str
    attribute: str
    label: str
    sensors: tuple[str, ...]


def write_blank(paths: Sequence[Path], objects: Sequence[str], seed: int) -> None:
    """Write one blank sheet for each annotator, the objects in an order of its own.

    Raises:
      SheetError: a sheet exists.
    """
    for n, path in enumerate(paths):
        order = np.random.default_rng([seed, n]).permutation(len(objects))
        write_sheet(path, (KEY, *LEVELS), ({KEY: objects[i]} for i in order))


def read_labels(path: Path, objects: Sequence[str]) -> dict[str, dict[str, int]]:
    """A filled-in sheet as levels.

    Raises:
      SheetError: as `read_sheet`.
    """
    rows = read_sheet(path, KEY, WORDS, objects)
    return {name: {a: WORDS[a].index(word) for a, word in row.items()} for name, row in rows.items()}


def agreement(a: Labels, b: Labels) -> tuple[AnnotatorAgreement, ...]:
    """Agreement of two annotators on the same objects, by attribute."""
    found = []
    for name in LEVELS:
        x, y = (np.array([labels[o][name] for o in sorted(a)]) for labels in (a, b))
        kappa = kappa_unless_constant(x, y, LEVELS[name])
        weighted = kappa_unless_constant(x, y, LEVELS[name], "quadratic") if name in ORDINAL else None
        exact = float(np.mean(x == y))
        found.append(AnnotatorAgreement(attribute=name, objects=len(x), kappa=kappa, weighted=weighted, exact=exact))
    return tuple(found)


def open_cases(a: Labels, b: Labels) -> dict[str, tuple[str, str]]:
    """The disagreements: name of the case → object and attribute."""
    return {f"{o}: {name}": (o, name) for o in sorted(a) for name in LEVELS if a[o][name] != b[o][name]}


def write_open(path: Path, a: Labels, b: Labels) -> None:
    """Write the sheet of the adjudicator: one row for each disagreement, both labels, the decision blank.

    Raises:
      SheetError: the sheet exists.
    """
    both = lambda o, name: sorted(WORDS[name][labels[o][name]] for labels in (a, b))  # does not reveal the author
    rows = ({CASE: case, "labels": " or ".join(both(*where))} for case, where in open_cases(a, b).items())
    write_sheet(path, (CASE, "labels", DECISION), rows)


def read_decisions(path: Path, a: Labels, b: Labels) -> dict[tuple[str, str], int]:
    """The adjudicator's sheet: (object, attribute) → level.

    Raises:
      SheetError: as `read_sheet`, or a decision that is not a level of its attribute.
    """
    cases = open_cases(a, b)
    words = sorted({word for words in WORDS.values() for word in words})
    decided = {}
    for case, row in read_sheet(path, CASE, {DECISION: words}, cases).items():
        o, name = cases[case]
        word, choices = row[DECISION], WORDS[name]
        if word not in choices:
            must = f"must be one of {', '.join(choices)}; correct it"
            raise SheetError(f"{path}: {DECISION} for {case!r} is {word!r}: {must}")
        decided[o, name] = choices.index(word)
    return decided


def adjudicate(a: Labels, b: Labels, decided: Mapping[tuple[str, str], int]) -> dict[str, dict[str, int]]:
    """The final labels: those that both annotators gave, elsewhere the decision.

    Raises:
      KeyError: a disagreement without a decision.
    """
    final = lambda o, name: a[o][name] if a[o][name] == b[o][name] else decided[o, name]
    return {o: {name: final(o, name) for name in LEVELS} for o in sorted(a)}


def rank_correlations(labels: Labels, contacts: Sequence[MeasuredContact]) -> dict[tuple[str, str], float]:
    """Spearman's ρ between each ordinal label and its quantity over the measured objects, by attribute and sensor."""
    found = {}
    for name in ORDINAL:
        for sensor in _sensors(contacts):
            values = _means(labels, contacts, sensor, name)
            levels = [labels[o][name] for o in values]
            if len(set(levels)) > 1 and len(set(values.values())) > 1:
                found[name, sensor] = float(stats.spearmanr(list(values.values()), levels).statistic)
    return found


def doubtful_labels(labels: Labels, contacts: Sequence[MeasuredContact]) -> tuple[DoubtfulLabel, ...]:
    """Labels of the lowest or highest level whose measurement is nearer to the median of the opposite level.

    A sensor that measured no object of either end, or whose quantity does not follow the labels, has no vote; of the
    others most must agree.
    """
    found, rho = [], rank_correlations(labels, contacts)
    for name in ORDINAL:
        votes: dict[str, list[tuple[str, bool]]] = {}
        ends = (0, LEVELS[name] - 1)
        for sensor in _sensors(contacts):
            values = _means(labels, contacts, sensor, name)
            of_level = [[v for o, v in values.items() if labels[o][name] == end] for end in ends]
            if not all(of_level) or abs(rho.get((name, sensor), 0.0)) < LEAST_RHO:
                continue
            medians = [float(np.median(of)) for of in of_level]
            for o in (o for o in values if labels[o][name] in ends):
                own, opposite = medians if labels[o][name] == 0 else medians[::-1]
                votes.setdefault(o, []).append((sensor, abs(values[o] - opposite) < abs(values[o] - own)))
        for o, cast in sorted(votes.items()):
            against = tuple(sensor for sensor, contradicts in cast if contradicts)
            if 2 * len(against) > len(cast):
                label = WORDS[name][labels[o][name]]
                found.append(DoubtfulLabel(object=o, attribute=name, label=label, sensors=against))
    return tuple(found)


def _sensors(contacts: Sequence[MeasuredContact]) -> list[str]:
    return sorted({sensor for contact in contacts for sensor in contact.measured})


def _means(labels: Labels, contacts: Sequence[MeasuredContact], sensor: str, name: str) -> dict[str, float]:
    """Mean of an attribute's quantity over the contacts of each labelled object, by one sensor."""
    quantity, found = PHYSICAL[name], dict[str, list[float]]()
    for contact in contacts:
        measured = contact.measured.get(sensor)
        if measured is not None and contact.touch.object in labels and quantity in measured.quantities:
            found.setdefault(contact.touch.object, []).append(measured.quantities[quantity])
    return {o: float(np.mean(values)) for o, values in found.items()}
