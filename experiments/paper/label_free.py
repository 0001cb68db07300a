"""Levels that touch implies without labels: those on which sensors agree, and those that measured physics implies."""

import numpy as np
from jaxtyping import Float, Int

from sensors_io.measures import MeasureError, measure
from sensors_io.pipeline import Contacts
from sensors_io.schema import ATTRIBUTES, UNKNOWN, Phase, Sequence
from touchr1_jax.training.evaluation import Evaluation

AGREEING = 0.75  # share of the sensors that must give one level alone

BANDS = ((0.0, 0.28), (0.39, 0.61), (0.72, 1.0))
"""Ranks among all contacts that imply the levels of a property with equal shares; between them nothing is implied."""

LEAST_RANKED = 30  # contacts with a measured quantity below which its ranks imply nothing
LEAST_LOAD_N = 0.5  # normal force under which friction is not read


def agreed_levels(evaluation: Evaluation, label: Int[np.ndarray, "n A"]) -> Int[np.ndarray, "n A"]:
    """The level of each property that `AGREEING` of the shown sensors conclude alone, −1 without one; as `label`."""
    if evaluation.alone is None:
        raise ValueError("evaluation.alone is None: agreement needs the answers of single streams; ask them")
    found = np.full(label.shape, UNKNOWN)
    for n, (contact, a) in enumerate(zip(evaluation.contact, evaluation.attribute, strict=True)):
        answered = evaluation.alone[n, evaluation.streams[n], a]
        levels, counts = np.unique(answered[answered >= 0], return_counts=True)
        if len(levels) and counts.max() >= AGREEING * len(answered):
            found[contact, a] = levels[counts.argmax()]
    return found


def measured_levels(store: Contacts, rows: Int[np.ndarray, "n"]) -> Int[np.ndarray, "contact A"]:
    """Levels of hardness and roughness that the ranks of yielding and friction among the contacts imply, else −1."""
    found = np.full((len(store), len(ATTRIBUTES)), UNKNOWN)
    values = {"hardness": dict[int, dict[str, float]](), "roughness": dict[int, dict[str, float]]()}
    for i in map(int, rows):
        for sensor, sequence in store.contact(i, fields=True).items():
            for name, value in (("hardness", yielding(sequence)), ("roughness", friction(sequence))):
                if value is not None:
                    values[name].setdefault(i, {})[sensor] = value
    for name, of_contacts in values.items():
        if len(of_contacts) >= LEAST_RANKED:
            contacts = np.array(list(of_contacts))
            found[contacts, ATTRIBUTES.index(name)] = levels_of_ranks(mean_ranks(list(of_contacts.values())))
    return found


def yielding(sequence: Sequence) -> float | None:
    """Minus the slope of force over indentation, N/mm; `None` where it cannot be measured.

    The indentation is the gel's: under a soft object the contact spreads, and the slope is greater.
    """
    try:
        slope = measure(sequence).quantities.get("stiffness")
    except MeasureError:
        return None
    return None if slope is None else -slope


def friction(sequence: Sequence) -> float | None:
    """Median of tangential over normal force while the sensor slides; `None` where it does not, or has no force."""
    if sequence.force_n is None:
        return None
    normal = -sequence.force_n[:, 2]
    slides = (sequence.phase == Phase.MOVE) & (normal > LEAST_LOAD_N)
    if sequence.key.motion not in ("slide_x", "slide_y") or not slides.any():
        return None
    return float(np.median(np.hypot(*sequence.force_n[slides, :2].T) / normal[slides]))


def mean_ranks(values: list[dict[str, float]]) -> Float[np.ndarray, "n"]:
    """Rank of each contact in [0, 1], mean over its sensors, each of which ranks its own measurements."""
    ranks = np.full((len(values), 0), np.nan)
    for sensor in sorted({name for row in values for name in row}):
        column = np.array([row.get(sensor, np.nan) for row in values])
        known = np.isfinite(column)
        order = np.full(len(column), np.nan)
        order[known] = column[known].argsort().argsort() / max(known.sum() - 1, 1)
        ranks = np.concatenate([ranks, order[:, None]], 1)
    mean = np.nanmean(ranks, 1)
    return mean.argsort().argsort() / max(len(mean) - 1, 1)


def levels_of_ranks(rank: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Level of each rank by `BANDS`, −1 between them."""
    level = np.full(len(rank), UNKNOWN)
    for k, (low, high) in enumerate(BANDS):
        level[(rank >= low) & (rank <= high)] = k
    return level
