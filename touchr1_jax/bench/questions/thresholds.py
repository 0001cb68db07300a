"""Levels read from measurements: two thresholds on one quantity of one sensor, fitted on the training objects.

Rationales cite them with the level that a number suggests.  They are no policy: each reads one number of one sensor.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from touchr1_jax.bench.metrics import ORDINAL
from touchr1_jax.bench.questions.contacts import ContactError, MeasuredContact
from touchr1_jax.bench.questions.wording import LEVELS

QUANTITIES: Mapping[str, tuple[str, ...]] = {
    "hardness": ("stiffness", "indentation", "contact area", "spread", "marker displacement"),
    "roughness": ("fine texture", "coarse texture", "relief"),
    "protrusion": ("relief", "coarse texture", "indentation", "contact area", "marker displacement"),
}
"""Quantities that an attribute may be read from: effects of pressing it, or of its surface on the gel."""

CUTS = np.linspace(0.05, 0.95, 19)
"""Quantiles of the training values at which a threshold may lie."""

LEAST_CONTACTS = 6
"""Fewest training contacts to fit thresholds on: two of each level."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelThresholds:
    """Two `cuts` between the three levels of an attribute on one quantity, and whether it rises with the level.

    `accuracy` is the balanced accuracy on the training contacts.
    """

    quantity: str
    cuts: tuple[float, float]
    rising: bool
    accuracy: float

    def read(self, value: float) -> int:
        """Level 0, 1 or 2 of a value."""
        reached = sum(value >= cut for cut in self.cuts)
        return reached if self.rising else 2 - reached


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThresholdReader:
    """Thresholds by sensor and ordinal attribute, and naive Bayes from ordinal levels to the material.

    `log_odds[a][m, k]` is log P(level k of attribute a | material m) with one count added, `log_prior[m]` is log P(m).
    """

    thresholds: Mapping[tuple[str, str], LevelThresholds]
    log_odds: Mapping[str, np.ndarray]
    log_prior: np.ndarray

    def level(self, contact: MeasuredContact, sensor: str, attribute: str) -> int:
        """The level that a sensor's measurements of a contact suggest."""
        if attribute != "material":
            thresholds = self.thresholds[sensor, attribute]
            return thresholds.read(contact.measured[sensor].quantities[thresholds.quantity])
        levels = {name: self.level(contact, sensor, name) for name in ORDINAL}
        return int(np.argmax(self.log_prior + sum(self.log_odds[name][:, level] for name, level in levels.items())))

    def can_read(self, contact: MeasuredContact, sensor: str, attribute: str) -> bool:
        """True if there are thresholds for the sensor and attribute, and the sensor measured their quantities."""
        keys = [(sensor, name) for name in (ORDINAL if attribute == "material" else (attribute,))]
        return sensor in contact.measured and all(
            key in self.thresholds and self.thresholds[key].quantity in contact.measured[sensor].quantities
            for key in keys
        )


def fit_thresholds(contacts: Sequence[MeasuredContact]) -> ThresholdReader:
    """Fit thresholds for every sensor and attribute for which the training contacts suffice.

    Raises:
      ContactError: they suffice for none: too few contacts, or none whose levels differ.
    """
    sensors = sorted({sensor for contact in contacts for sensor in contact.measured})
    best = {(s, a): _best(contacts, s, a) for s, a in itertools.product(sensors, ORDINAL)}
    thresholds = {key: found for key, found in best.items() if found is not None}
    if not thresholds:
        raise ContactError(
            f"contacts holds {len(contacts)}: rationales need {LEAST_CONTACTS} training contacts with all three levels "
            "of an attribute; use more training objects"
        )
    odds = {name: np.ones((LEVELS["material"], LEVELS[name])) for name in ORDINAL}
    prior = np.ones(LEVELS["material"])
    for labels in (contact.labels for contact in contacts if "material" in contact.labels):
        prior[labels["material"]] += 1
        for name in labels.keys() & odds.keys():
            odds[name][labels["material"], labels[name]] += 1
    log_odds = {name: np.log(table / table.sum(1, keepdims=True)) for name, table in odds.items()}
    return ThresholdReader(thresholds=thresholds, log_odds=log_odds, log_prior=np.log(prior / prior.sum()))


def _best(contacts: Sequence[MeasuredContact], sensor: str, attribute: str) -> LevelThresholds | None:
    """The quantity and cuts of the best training accuracy; `None` where contacts or levels are missing."""
    best: LevelThresholds | None = None
    for quantity in QUANTITIES[attribute]:
        rows = [
            (contact.measured[sensor].quantities[quantity], contact.labels[attribute])
            for contact in contacts
            if attribute in contact.labels
            and sensor in contact.measured
            and quantity in contact.measured[sensor].quantities
        ]
        if len(rows) >= LEAST_CONTACTS and len({level for _, level in rows}) == LEVELS[attribute]:
            found = _cut(quantity, *map(np.array, zip(*rows, strict=True)))
            best = found if best is None or found.accuracy > best.accuracy else best
    return best


def _cut(quantity: str, value: np.ndarray, level: np.ndarray) -> LevelThresholds:
    """Two cuts and a direction of the greatest balanced accuracy.

    With c_k(q) the share of level k below cut q, cuts q ≤ r and a rising quantity have the balanced accuracy
    (c_0(q) + c_1(r) − c_1(q) + 1 − c_2(r)) / 3.
    """
    cuts = np.unique(np.quantile(value, CUTS))
    below = np.stack([(value[level == k][:, None] < cuts).mean(0) for k in range(3)])
    low, high = np.triu_indices(len(cuts))
    middle = below[1, high] - below[1, low]
    rising = (below[0, low] + middle + 1 - below[2, high]) / 3
    falling = (below[2, low] + middle + 1 - below[0, high]) / 3
    up = bool(rising.max() >= falling.max())
    accuracy = rising if up else falling
    at = int(np.argmax(accuracy))
    chosen = (float(cuts[low[at]]), float(cuts[high[at]]))
    return LevelThresholds(quantity=quantity, cuts=chosen, rising=up, accuracy=float(accuracy[at]))
