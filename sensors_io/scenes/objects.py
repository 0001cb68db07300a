"""Procedural objects: what they are made of, how their skin is shaped, and the levels that follow from both.

A property is a monotone function of a normal latent x = m(material) + σ ε, so the ranges of all materials overlap and
the material only shifts the odds.  Levels come from the physical value alone, by the thresholds below.  No value lies
within 18 % of a threshold, where two annotators would disagree; next to that gap objects are hard to tell apart still.
"""

import bisect
import dataclasses
import math

import numpy as np

from sensors_io.schema import MATERIALS

HARDNESS_MPA = (0.5, 5.0)
"""Effective Young's modulus of the skin below which an object is soft, from which it is hard (a gel has 0.2–0.45)."""

ROUGHNESS_MM = (0.01, 0.04)
"""RMS height in the band 0.8–4 mm below which an object is smooth, from which it is rough."""

PROTRUSION_MM = (0.15, 0.5)
"""Height of the surface features below which an object is flat, from which it is protruding."""

GAP = 1.4
"""Ratio between the least value above a threshold and the greatest below it."""

_TERTILE = 0.4307  # of the standard normal


@dataclasses.dataclass(frozen=True, kw_only=True)
class Property:
    """One physical property: its thresholds, its extreme values, the mean latent of each material.

    `means` follow the order of `MATERIALS`; `spread` is the standard deviation within a material.
    """

    thresholds: tuple[float, float]
    extremes: tuple[float, float]
    means: tuple[float, ...]
    spread: float

    def value(self, latent: float) -> float:
        """Physical value of a latent x: the thirds of Φ(x) map to the three levels, log-linear within each."""
        share = 3 * _normal_cdf(latent)
        level = min(int(share), 2)
        low = (self.extremes[0], *(t * math.sqrt(GAP) for t in self.thresholds))[level]
        high = (*(t / math.sqrt(GAP) for t in self.thresholds), self.extremes[1])[level]
        return low * (high / low) ** (share - level)

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
PROPERTIES = {"hardness": HARDNESS, "roughness": ROUGHNESS, "protrusion": PROTRUSION}

PATTERNS = ("bumps", "ridges", "plateaus")
"""Shapes of the surface features."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solid:
    """A procedural object: a curved body with a periodic relief and a self-affine roughness.

    Curvature is R₁, R₂ along two axes, one turned by `turn_rad`.  Roughness is a sum of plane waves
    Σ a cos(k·r + φ): `wave_numbers` [K, 2] rad/mm, `wave_amplitudes_mm` [K], `wave_phases_rad` [K].
    `looks_like` is the material that the object appears to be made of.
    """

    material: int
    looks_like: int
    modulus_mpa: float
    rms_mm: float
    feature_height_mm: float
    feature_pitch_mm: float
    feature_width: float
    pattern: int
    radius_1_mm: float
    radius_2_mm: float
    turn_rad: float
    wave_numbers: np.ndarray
    wave_amplitudes_mm: np.ndarray
    wave_phases_rad: np.ndarray

    def labels(self) -> dict[str, int]:
        """Level of every attribute."""
        return {
            "hardness": HARDNESS.level(self.modulus_mpa),
            "roughness": ROUGHNESS.level(self.rms_mm),
            "protrusion": PROTRUSION.level(self.feature_height_mm),
            "material": self.material,
        }

    def truth(self) -> dict[str, float]:
        """The quantities behind the labels."""
        names = ("modulus_mpa", "rms_mm", "feature_height_mm", "feature_pitch_mm", "radius_1_mm", "radius_2_mm")
        return {name: float(getattr(self, name)) for name in names}


def sample(rng: np.random.Generator, lie_share: float, shortest_wave_mm: float) -> Solid:
    """Draw an object.

    Args:
      rng: source of randomness.
      lie_share: probability that the object looks like another material, one with other typical levels.
      shortest_wave_mm: shortest wave of the roughness, what the contact grid resolves.
    """
    material = int(rng.integers(len(MATERIALS)))
    latent = {name: p.means[material] + p.spread * rng.standard_normal() for name, p in PROPERTIES.items()}
    rms = ROUGHNESS.value(latent["roughness"])
    lies = rng.random() < lie_share
    numbers, amplitudes, phases = rough_waves(rng, rms, shortest_wave_mm)
    return Solid(
        material=material,
        looks_like=int(rng.choice(lie_materials(material))) if lies else material,
        modulus_mpa=HARDNESS.value(latent["hardness"]),
        rms_mm=rms,
        feature_height_mm=PROTRUSION.value(latent["protrusion"]),
        feature_pitch_mm=rng.uniform(2.5, 6.0),
        feature_width=rng.uniform(0.16, 0.26),
        pattern=int(rng.integers(len(PATTERNS))),
        radius_1_mm=_log_uniform(rng, 8.0, 40.0),
        radius_2_mm=_log_uniform(rng, 10.0, 80.0),
        turn_rad=rng.uniform(0, np.pi),
        wave_numbers=numbers,
        wave_amplitudes_mm=amplitudes,
        wave_phases_rad=phases,
    )


def rough_waves(
    rng: np.random.Generator, rms_mm: float, shortest_mm: float, waves: int = 192, hurst: float = 0.8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plane waves of a self-affine surface: power spectrum flat above 2 mm wavelength, ∝ q^{−2(1+H)} below it.

    Wave numbers are stratified in log q between 2π/4 mm and the shortest wave, so the sum has the rms asked for.

    Returns:
      wave vectors [K, 2] rad/mm (x, y), amplitudes [K] mm, phases [K] rad.
    """
    low, roll, high = 2 * np.pi / 4.0, 2 * np.pi / 2.0, 2 * np.pi / shortest_mm
    q = low * (high / low) ** ((np.arange(waves) + rng.random(waves)) / waves)
    angle = rng.uniform(0, 2 * np.pi, waves)
    power = q**2 * np.maximum(q, roll) ** (-2 * (1 + hurst))  # per interval of log q
    amplitude = np.sqrt(power * 2 / power.sum()) * rms_mm
    vectors = q[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    return vectors.astype(np.float32), amplitude.astype(np.float32), rng.uniform(0, 2 * np.pi, waves).astype(np.float32)


def typical_levels(material: int) -> tuple[int, ...]:
    """The likeliest level of each property, given the material."""
    return tuple(p.level(p.value(p.means[material])) for p in PROPERTIES.values())


def lie_materials(material: int) -> list[int]:
    """Materials whose typical levels differ from this one's in at least two properties."""
    own = typical_levels(material)

    def differences(other: int) -> int:
        return sum(a != b for a, b in zip(own, typical_levels(other), strict=True))

    return [other for other in range(len(MATERIALS)) if differences(other) >= 2]


def level_odds(prop: Property) -> np.ndarray:
    """P(level | material) of a property, [9, 3], from the normal distribution of its latent."""
    edges = np.array([-_TERTILE, _TERTILE])
    below = np.array([[_normal_cdf((e - m) / prop.spread) for e in edges] for m in prop.means])
    return np.stack([below[:, 0], below[:, 1] - below[:, 0], 1 - below[:, 1]], -1)


def _normal_cdf(x: float) -> float:
    return 0.5 * (1 + math.erf(x / math.sqrt(2)))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
