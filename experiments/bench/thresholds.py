"""What a measurement says of a level: two cuts on one quantity of one sensor, fitted on the training objects.

Rationales name them, so that a number is followed by what it means.  They are no policy: one number, one sensor.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.bench.contacts import ContactError, MeasuredContact
from sensors_io.schema import LEVELS
from touchr1_jax.bench.metrics import ORDINAL

QUANTITIES: Mapping[str, tuple[str, ...]] = {
    "hardness": ("stiffness", "indentation", "contact area", "spread", "marker displacement"),
    "roughness": ("fine texture", "coarse texture", "relief"),
    "protrusion": ("relief", "coarse texture", "indentation", "contact area", "marker displacement"),
}
"""What can speak for an attribute: what a press does to it, or what its surface does to the gel."""

CUTS = np.linspace(0.05, 0.95, 19)
"""Quantiles of the training values that a cut may lie at."""

LEAST_CONTACTS = 6
"""Training contacts by which a cut may be fitted: two of each level."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelThresholds:
    """The levels of an attribute on one quantity: `cuts` between them, and whether it rises with the level.

    `accuracy` is the balanced share of training contacts that it reads right.
    """

    quantity: str
    cuts: tuple[float, float]
    rising: bool
    accuracy: float

    def read(self, value: float) -> int:
        """0, 1 or 2."""
        reached = sum(value >= cut for cut in self.cuts)
        return reached if self.rising else 2 - reached


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThresholdReader:
    """All scales, by sensor and attribute, and the odds of the materials given the other levels.

    `log_odds[a][m, k]` is log P(level k of attribute a | material m) with one count added, `log_prior[m]` log P(m).
    """

    scales: Mapping[tuple[str, str], LevelThresholds]
    log_odds: Mapping[str, np.ndarray]
    log_prior: np.ndarray

    def knows(self, sensor: str, attribute: str) -> bool:
        """Whether the sensor says something of the attribute."""
        names = ORDINAL if attribute == "material" else (attribute,)
        return all((sensor, name) in self.scales for name in names)

    def level(self, contact: MeasuredContact, sensor: str, attribute: str) -> int:
        """What a sensor's measurements of a contact say."""
        if attribute != "material":
            scale = self.scales[sensor, attribute]
            return scale.read(contact.measured[sensor].quantities[scale.quantity])
        said = {name: self.level(contact, sensor, name) for name in ORDINAL}
        return int(np.argmax(self.log_prior + sum(self.log_odds[name][:, level] for name, level in said.items())))

    def can_read(self, contact: MeasuredContact, sensor: str, attribute: str) -> bool:
        """Whether the sensor measured what its scales need."""
        if sensor not in contact.measured or not self.knows(sensor, attribute):
            return False
        names = ORDINAL if attribute == "material" else (attribute,)
        return all(self.scales[sensor, name].quantity in contact.measured[sensor].quantities for name in names)


def fit_thresholds(contacts: Sequence[MeasuredContact]) -> ThresholdReader:
    """Fit every scale that the training contacts allow.

    Raises:
      FactsError: no scale at all: too few contacts, or none whose levels differ.
    """
    sensors = sorted({sensor for contact in contacts for sensor in contact.measured})
    found = {(s, a): _best(contacts, s, a) for s, a in itertools.product(sensors, ORDINAL)}
    scales = {key: scale for key, scale in found.items() if scale is not None}
    if not scales:
        raise ContactError(
            f"contacts holds {len(contacts)}: rationales need {LEAST_CONTACTS} training contacts with all three levels "
            "of an attribute; use more training objects"
        )
    count = LEVELS["material"]
    odds = {name: np.ones((count, LEVELS[name])) for name in ORDINAL}
    prior = np.ones(count)
    for contact in contacts:
        if "material" in contact.labels:
            prior[contact.labels["material"]] += 1
            for name in ORDINAL:
                if name in contact.labels:
                    odds[name][contact.labels["material"], contact.labels[name]] += 1
    log_odds = {name: np.log(table / table.sum(1, keepdims=True)) for name, table in odds.items()}
    return ThresholdReader(scales=scales, log_odds=log_odds, log_prior=np.log(prior / prior.sum()))


def _best(contacts: Sequence[MeasuredContact], sensor: str, attribute: str) -> LevelThresholds | None:
    """The quantity and the cuts that read most training contacts right; `None` where the levels are not all there."""
    best: LevelThresholds | None = None
    for quantity in QUANTITIES[attribute]:
        rows = [
            (contact.measured[sensor].quantities[quantity], contact.labels[attribute])
            for contact in contacts
            if attribute in contact.labels
            and sensor in contact.measured
            and quantity in contact.measured[sensor].quantities
        ]
        if len(rows) < LEAST_CONTACTS or len({level for _, level in rows}) < LEVELS[attribute]:
            continue
        scale = _cut(quantity, np.array([v for v, _ in rows]), np.array([level for _, level in rows]))
        if best is None or scale.accuracy > best.accuracy:
            best = scale
    return best


def _cut(quantity: str, value: np.ndarray, level: np.ndarray) -> LevelThresholds:
    """Two cuts and a direction of the greatest balanced accuracy.

    With c_k(q) the share of level k below cut q, cuts q ≤ r and a rising quantity are right in
    (c_0(q) + c_1(r) − c_1(q) + 1 − c_2(r)) / 3 of the contacts, levels weighing alike.
    """
    cuts = np.unique(np.quantile(value, CUTS))
    below = np.stack([(value[level == k][:, None] < cuts).mean(0) for k in range(3)])
    low, high = np.triu_indices(len(cuts))
    middle = below[1, high] - below[1, low]
    rising = (below[0, low] + middle + 1 - below[2, high]) / 3
    falling = (below[2, low] + middle + 1 - below[0, high]) / 3
    up = float(rising.max()) >= float(falling.max())
    at = int(np.argmax(rising if up else falling))
    return LevelThresholds(
        quantity=quantity,
        cuts=(float(cuts[low[at]]), float(cuts[high[at]])),
        rising=up,
        accuracy=float((rising if up else falling)[at]),
    )
