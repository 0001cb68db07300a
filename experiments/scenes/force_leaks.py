"""Frames that the protocol leaves out, and accuracy of labels predicted from the remaining forces alone."""

import dataclasses
import itertools

import numpy as np

from sensors_io.scenes import schedule
from sensors_io.scenes.cards import object_cards
from sensors_io.scenes.config import SceneConfig, stream
from sensors_io.scenes.protocol import plan
from sensors_io.schema import MATERIALS, PRESS_FORCE_N

ORDINAL = ("hardness", "roughness", "protrusion")
_BINS = 12
_FOLDS = 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceLeak:
    """Balanced accuracy, percent, of each ordinal label from the peak force of a press alone; chance is 33.3."""

    design: str
    accuracy: tuple[float, ...]
    median_n: float
    full_share: float


def leaks(config: SceneConfig) -> list[ForceLeak]:
    """Leaks of four designs: frames past the limit dropped, dropped by shape alone, all kept, and matched (default)."""
    labels = _labels(config)
    made = plan(config)
    matched = np.zeros(config.objects)
    for slot in made.slots:
        if slot.motion == "press":
            matched[slot.object_index] = slot.force_n
    designs = {
        "frames past the limit dropped": np.minimum(made.limits.actual_n, PRESS_FORCE_N),
        "dropped as if objects were rigid": np.minimum(made.limits.rigid_n, PRESS_FORCE_N),
        'all kept, flagged (past_limit="flag")': np.full(config.objects, PRESS_FORCE_N),
        "matched (the default)": matched,
    }
    rng = stream(config.seed, "schedule")
    jitter = 1 + config.force_jitter * rng.standard_normal(config.objects)
    return [_leak(name, peak * jitter, peak, labels) for name, peak in designs.items()]


def left_out_by_material(config: SceneConfig) -> tuple[tuple[str, ...], list[tuple[str | int, ...]]]:
    """Headings and rows: frames asked, past the limit and replaced by material, then the last two by force band."""
    counts = plan(config).left_out
    material = np.array([card.labels["material"] for card in object_cards(config)])
    edges = (0.0, *schedule.BANDS_N)
    bands = tuple(f"{low:g}–{high:g} N" for low, high in itertools.pairwise(edges))
    rows: list[tuple[str | int, ...]] = []
    groups = [(name, material == i) for i, name in enumerate(MATERIALS)]
    for name, chosen in [*groups, ("all", np.ones(len(material), bool))]:
        asked, past, replaced = (a[chosen].sum(0) for a in (counts.asked, counts.past_limit, counts.replaced))
        rows.append((name, int(asked.sum()), int(past.sum()), int(replaced.sum()), *(int(n) for n in past)))
    return bands, rows


def _labels(config: SceneConfig) -> np.ndarray:
    return np.array([[card.labels[name] for name in ORDINAL] for card in object_cards(config)])


def _leak(name: str, seen: np.ndarray, peak: np.ndarray, labels: np.ndarray) -> ForceLeak:
    accuracy = tuple(100 * _guess(np.log(seen), labels[:, a]) for a in range(len(ORDINAL)))
    full = float(np.mean(peak >= PRESS_FORCE_N - 1e-6))
    return ForceLeak(design=name, accuracy=accuracy, median_n=float(np.median(peak)), full_share=full)


def _guess(value: np.ndarray, label: np.ndarray) -> float:
    """Balanced accuracy of the likeliest level in each of twelve bins of equal count, cross-validated; known labels.

    Levels are weighted by the inverse of their share, so that a value without information scores a third.
    """
    value, label = value[label >= 0], label[label >= 0]
    rank = np.argsort(np.argsort(value)) * _BINS // len(value)
    fold = np.arange(len(value)) % _FOLDS
    hit = np.zeros(len(value))
    for k in range(_FOLDS):
        votes = np.zeros((_BINS, 3))
        np.add.at(votes, (rank[fold != k], label[fold != k]), 1)
        guess = (votes / np.maximum(votes.sum(0), 1)).argmax(1)
        hit[fold == k] = guess[rank[fold == k]] == label[fold == k]
    return float(np.mean([hit[label == level].mean() for level in np.unique(label)]))
