"""Procedural objects: what they are made of and how their skin is shaped; their levels follow from both.

An object may vary over its surface: of two parts with a seam, or graded from one side to the other.  What a press feels
is then what lies under it, `Solid.at`.
"""

import dataclasses
import math

import numpy as np

from sensors_io.scenes.properties import DYNAMIC, HARDNESS, PROPERTIES, PROTRUSION, ROUGHNESS
from sensors_io.schema import MATERIALS, UNKNOWN

SEAM_MM = 0.4
"""Half width of the seam between two parts."""

GRADE_MM = (8.0, 16.0)
"""Range of the half width over which a graded object changes."""

LINE_MM = 4.0
"""Largest distance of that line from the object's centre: half of the smallest window, 7.6 mm, reaches over it."""

PITCH_MM = (2.5, 6.0)
"""Range of the distance between features: two to six of them across the smallest window."""

FEATURE_WIDTH = (0.16, 0.26)
"""Range of a feature's standard width in pitches: apart from its neighbours, and no needle."""

RADIUS_1_MM, RADIUS_2_MM = (8.0, 40.0), (10.0, 80.0)
"""Ranges of the radii of curvature, even in their logarithm: from a fingertip's to a nearly flat side."""

LONGEST_WAVE_MM, ROLL_OFF_MM = 4.0, 2.0
"""Longest wave of the roughness, the upper end of `properties.ROUGHNESS_MM`'s band, and that above which it is flat."""

WAVES, HURST = 192, 0.8
"""Plane waves of a rough skin, enough that no period is seen; Hurst exponent of fracture surfaces (Bouchaud 1997)."""

LIE_DIFFERENCES = 2
"""In how many properties a lying look must mislead at the least: in one alone it hardly would."""

PATTERNS = ("bumps", "ridges", "plateaus")
"""Shapes of the surface features."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Variation:
    """Variation of an object over its surface: its values on the far side of a line, and the line.

        share of the far side at r = ½ + ½ tanh((r · (cos φ, sin φ) − offset) / width),

    r in mm from the object's centre, φ = `direction_rad`.  Properties change geometrically with the share: a narrow
    line is a seam between two parts, a wide one a gradient.
    """

    direction_rad: float
    offset_mm: float
    width_mm: float
    modulus_mpa: float
    rms_mm: float
    feature_height_mm: float

    def share(self, site_mm: np.ndarray) -> float:
        """Share of the far side at a point [2] (x, y), in 0..1."""
        along = site_mm[0] * math.cos(self.direction_rad) + site_mm[1] * math.sin(self.direction_rad)
        return 0.5 + 0.5 * math.tanh((along - self.offset_mm) / self.width_mm)


VARYING = ("modulus_mpa", "rms_mm", "feature_height_mm")
"""Fields of `Solid` that a `Variation` changes, in the order of `PROPERTIES`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solid:
    """A procedural object: a curved body with a periodic relief and a self-affine roughness.

    Curvature is R₁, R₂ along two axes, one turned by `turn_rad`.  Roughness is a sum of plane waves
    Σ a cos(k·r + φ): `wave_numbers` [K, 2] rad/mm, `wave_amplitudes_mm` [K], `wave_phases_rad` [K].
    `looks_like` is the material that the object appears to be made of.  `energy_returned` and `friction` are what
    unloading and sliding feel.  Where the object varies, modulus, rms and height are those of its near side.
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
    energy_returned: float
    friction: float
    variation: Variation | None = None

    def labels(self) -> dict[str, int]:
        """Level of every attribute of the schema; unknown where the sides of the object differ in it."""
        return {name: level for name, level in self.levels().items() if name not in DYNAMIC} | {
            "material": self.material
        }

    def levels(self) -> dict[str, int]:
        """Level of all five ordinal properties; unknown where the sides of the object differ in it."""
        near = self._levels()
        if self.variation is None:
            return near
        v = self.variation
        far = dataclasses.replace(
            self, modulus_mpa=v.modulus_mpa, rms_mm=v.rms_mm, feature_height_mm=v.feature_height_mm
        )._levels()
        return {name: level if far[name] == level else UNKNOWN for name, level in near.items()}

    def at(self, site_mm: np.ndarray) -> "Solid":
        """The object as it is at a point [2] (x, y) of its surface, everywhere."""
        if self.variation is None:
            return self
        share = self.variation.share(site_mm)
        far = _far_side(self.variation)
        modulus, rms, height = (getattr(self, name) ** (1 - share) * far[name] ** share for name in VARYING)
        amplitudes = (self.wave_amplitudes_mm * (rms / self.rms_mm)).astype(np.float32)
        return dataclasses.replace(
            self,
            modulus_mpa=modulus,
            rms_mm=rms,
            wave_amplitudes_mm=amplitudes,
            feature_height_mm=height,
            variation=None,
        )

    def truth(self) -> dict[str, float]:
        """The quantities behind the levels."""
        body = ("feature_pitch_mm", "radius_1_mm", "radius_2_mm", "energy_returned", "friction")
        found = {name: float(getattr(self, name)) for name in (*VARYING, *body)}
        if self.variation is None:
            return found
        return found | {f"far_{name}": value for name, value in _far_side(self.variation).items()}

    def _levels(self) -> dict[str, int]:
        values = (self.modulus_mpa, self.rms_mm, self.feature_height_mm, self.energy_returned, self.friction)
        return {name: p.level(v) for (name, p), v in zip((PROPERTIES | DYNAMIC).items(), values, strict=True)}


def sample(
    rng: np.random.Generator,
    lie_share: float,
    shortest_wave_mm: float,
    part_share: float = 0.0,
    graded_share: float = 0.0,
) -> Solid:
    """Draw an object.

    Args:
      rng: source of randomness; what came to the objects later is drawn from a child of it, so that it left the rest
        as it was.
      lie_share: probability that the object looks like a material that it is not made of.
      shortest_wave_mm: of the roughness, what the contact grid resolves.
      part_share, graded_share: probabilities that the object has two parts, and that it is graded.

    Raises:
      ValueError: shares that are negative or sum to more than 1.
    """
    if min(part_share, graded_share) < 0 or part_share + graded_share > 1:
        raise ValueError(
            f"part_share, graded_share are {part_share}, {graded_share}: must be ≥ 0 and sum to at most 1; lower them"
        )
    material = int(rng.integers(len(MATERIALS)))
    latent = {name: p.means[material] + p.spread * rng.standard_normal() for name, p in PROPERTIES.items()}
    rms = ROUGHNESS.value(latent["roughness"])
    lies = rng.random() < lie_share
    numbers, amplitudes, phases = rough_waves(rng, rms, shortest_wave_mm)
    later = rng.spawn(1)[0]
    dynamic = {name: p.draw(material, later) for name, p in DYNAMIC.items()}
    return Solid(
        material=material,
        looks_like=int(rng.choice(lie_materials(material))) if lies else material,
        modulus_mpa=HARDNESS.value(latent["hardness"]),
        rms_mm=rms,
        feature_height_mm=PROTRUSION.value(latent["protrusion"]),
        feature_pitch_mm=rng.uniform(*PITCH_MM),
        feature_width=rng.uniform(*FEATURE_WIDTH),
        pattern=int(rng.integers(len(PATTERNS))),
        radius_1_mm=_log_uniform(rng, *RADIUS_1_MM),
        radius_2_mm=_log_uniform(rng, *RADIUS_2_MM),
        turn_rad=rng.uniform(0, np.pi),
        wave_numbers=numbers,
        wave_amplitudes_mm=amplitudes,
        wave_phases_rad=phases,
        energy_returned=dynamic["elasticity"],
        friction=dynamic["friction"],
        variation=_variation(material, later, part_share, graded_share),
    )


def _variation(material: int, rng: np.random.Generator, part_share: float, graded_share: float) -> Variation | None:
    """Another specimen of the same material on the far side, or none."""
    kind = rng.random()
    if kind >= part_share + graded_share:
        return None
    far = {field: p.draw(material, rng) for field, p in zip(VARYING, PROPERTIES.values(), strict=True)}
    return Variation(
        direction_rad=rng.uniform(0, 2 * np.pi),
        offset_mm=rng.uniform(-LINE_MM, LINE_MM),
        width_mm=SEAM_MM if kind < part_share else rng.uniform(*GRADE_MM),
        **far,
    )


def _far_side(variation: Variation) -> dict[str, float]:
    return {name: float(getattr(variation, name)) for name in VARYING}


def rough_waves(
    rng: np.random.Generator, rms_mm: float, shortest_mm: float, waves: int = WAVES, hurst: float = HURST
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plane waves of a self-affine surface: power spectrum flat above `ROLL_OFF_MM`, ∝ q^{−2(1+H)} below it.

    Wave numbers are stratified in log q from the longest wave to the shortest, so the sum has the rms asked for.

    Returns:
      wave vectors [K, 2] rad/mm (x, y), amplitudes [K] mm, phases [K] rad.
    """
    low, roll, high = 2 * np.pi / LONGEST_WAVE_MM, 2 * np.pi / ROLL_OFF_MM, 2 * np.pi / shortest_mm
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
    """Materials whose typical levels differ from this one's in at least `LIE_DIFFERENCES` properties."""
    own = typical_levels(material)

    def differences(other: int) -> int:
        return sum(a != b for a, b in zip(own, typical_levels(other), strict=True))

    return [other for other in range(len(MATERIALS)) if differences(other) >= LIE_DIFFERENCES]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
