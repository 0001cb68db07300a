"""Physical properties of objects, the levels they fall into, and how the material shifts their odds.

A property is a monotone function of a normal latent x = m(material) + σ ε, so the ranges of all materials overlap and
the material only shifts the odds.  Levels come from the physical value alone, by the thresholds below.  No hardness,
roughness or protrusion lies within 18 % of a threshold, where two annotators would disagree; next to that gap objects
are still hard to distinguish.  Friction and elasticity, which no hand sorts into levels, have no gap at all.
"""

import bisect
import dataclasses
import math

import numpy as np

HARDNESS_MPA = (0.5, 5.0)
"""Effective Young's modulus of the skin below which an object is soft, from which it is hard (a gel has 0.2–0.45)."""

ROUGHNESS_MM = (0.01, 0.04)
"""RMS height in the band 0.8–4 mm below which an object is smooth, from which it is rough."""

PROTRUSION_MM = (0.15, 0.5)
"""Height of the surface features below which an object is flat, from which it is protruding."""

ENERGY_RETURNED = (0.45, 0.75)
"""Share of the work of a press that the object gives back, below which it is plastic, from which it is springy."""

FRICTION = (0.4, 0.8)
"""Coefficient of friction against the gel below which an object is slippery, from which it is sticky."""

GAP = 1.4
"""Ratio between the least value above a threshold and the greatest below it."""

_TERTILE = 0.4307  # of the standard normal


@dataclasses.dataclass(frozen=True, kw_only=True)
class Property:
    """One physical property: its thresholds, its extreme values, the mean latent of each material.

    `means` follow the order of `MATERIALS`; `spread` is the standard deviation within a material; `gap` is the ratio
    between the least value above a threshold and the greatest below it.
    """

    thresholds: tuple[float, float]
    extremes: tuple[float, float]
    means: tuple[float, ...]
    spread: float
    gap: float = GAP

    def value(self, latent: float) -> float:
        """Physical value of a latent x: the thirds of Φ(x) map to the three levels, log-linear within each."""
        share = 3 * _normal_cdf(latent)
        level = min(int(share), 2)
        low = (self.extremes[0], *(t * math.sqrt(self.gap) for t in self.thresholds))[level]
        high = (*(t / math.sqrt(self.gap) for t in self.thresholds), self.extremes[1])[level]
        return low * (high / low) ** (share - level)

    def draw(self, material: int, rng: np.random.Generator) -> float:
        """A value for an object of a material."""
        return self.value(self.means[material] + self.spread * rng.standard_normal())

    def level(self, value: float) -> int:
        """0, 1 or 2: how many thresholds the value has reached."""
        return bisect.bisect_right(self.thresholds, value)


HARDNESS = Property(
    thresholds=HARDNESS_MPA,
    extremes=(0.08, 200.0),
    means=(0.35, 0.9, -0.7, -0.85, -0.2, 0.75, -0.5, 0.55, -0.3),
    spread=0.82,
)
ROUGHNESS = Property(
    thresholds=ROUGHNESS_MM,
    extremes=(0.001, 0.16),
    means=(-0.5, -0.3, 0.95, 0.3, -0.4, -1.05, 0.4, 0.7, -0.1),
    spread=0.82,
)
PROTRUSION = Property(
    thresholds=PROTRUSION_MM,
    extremes=(0.015, 1.6),
    means=(0.45, 0.1, -0.3, 0.95, -0.9, -0.7, -0.45, 0.15, 0.7),
    spread=0.82,
)
ELASTICITY = Property(
    thresholds=ENERGY_RETURNED,
    extremes=(0.1, 0.98),
    means=(0.55, 0.9, -0.5, -0.85, -0.7, 0.75, -0.2, 0.35, -0.3),
    spread=0.82,
    gap=1.0,
)
GRIP = Property(
    thresholds=FRICTION,
    extremes=(0.1, 1.6),
    means=(0.35, -0.2, -0.7, -0.5, -0.85, 0.9, 0.55, -0.3, 0.75),
    spread=0.82,
    gap=1.0,
)
"""Smooth glass, plastic and rubber stick to silicone; what is rough or dusty touches it at few places."""

PROPERTIES = {"hardness": HARDNESS, "roughness": ROUGHNESS, "protrusion": PROTRUSION}
"""Properties that a look or a press reveals; appearance agrees with or contradicts these."""

DYNAMIC = {"elasticity": ELASTICITY, "friction": GRIP}
"""Properties that only unloading or sliding reveals."""


def level_odds(prop: Property) -> np.ndarray:
    """P(level | material) of a property, [9, 3], from the normal distribution of its latent."""
    edges = np.array([-_TERTILE, _TERTILE])
    below = np.array([[_normal_cdf((e - m) / prop.spread) for e in edges] for m in prop.means])
    return np.stack([below[:, 0], below[:, 1] - below[:, 0], 1 - below[:, 1]], -1)


def _normal_cdf(x: float) -> float:
    return 0.5 * (1 + math.erf(x / math.sqrt(2)))
