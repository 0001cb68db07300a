"""The same presses at every tier, by every sensor: features, forces, true shape and levels."""

import dataclasses
import itertools
from collections.abc import Callable
from collections.abc import Sequence as Seq

import numpy as np

from experiments.mechanics import identify_draw
from experiments.mechanics.identify_geometry import statistics
from experiments.mechanics.identify_motions import force_of
from experiments.mechanics.identify_threads import in_threads
from experiments.mechanics.identify_touch import ContactTier, PressFeatures, feel
from sensors_io.scenes import schedule
from sensors_io.scenes.cards import shortest_wave_mm, solid_of
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import SENSORS


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressData:
    """n presses: what each sensor felt at each tier, force [n, S, E], true shape [n, G], levels and objects [n]."""

    felt: dict[tuple[str, int], PressFeatures]
    force: np.ndarray
    shape: np.ndarray
    levels: dict[str, np.ndarray]
    objects: np.ndarray

    def features(self, tier: ContactTier, order: int, level: int = 0) -> np.ndarray:
        """Touch and force of sensor number `order` at one of the tier's levels of noise, [n, D]."""
        return np.concatenate([self.felt[tier.name, order].features[:, level], self.force[:, order]], 1)


def press(
    config: SceneConfig, tiers: Seq[tuple[ContactTier, tuple[float, ...]]], batch: int, advance: Callable[[], object]
) -> PressData:
    """Make every press at every tier.

    Args:
      config: scenes without `sequences`.
      tiers: tiers with the multiples of noise at which each is seen; the first one's skin is the true shape.
      batch: presses in one call of a compiled program.
      advance: called after each tier of each sensor.
    """
    draws = [identify_draw.touches(tiers[0][0].config(config), order) for order in range(len(SENSORS))]
    waves = {shortest_wave_mm(tier.config(config)): tier.config(config) for tier, _ in tiers}
    skins = {wave: identify_draw.skins(at) for wave, at in waves.items()}
    skins_of = lambda tier: skins[shortest_wave_mm(tier.config(config))]

    def work(job: tuple[tuple[ContactTier, tuple[float, ...]], int]) -> PressFeatures:
        (tier, factors), order = job
        touches = [identify_draw.on(drawn, skin) for drawn, skin in zip(draws[order], skins_of(tier), strict=True)]
        return feel(config, tier, order, touches, factors, batch)

    jobs = list(itertools.product(tiers, range(len(SENSORS))))
    felt = in_threads(work, jobs, advance)
    slots = [schedule.press_slot(config, index) for index in range(config.contact_count)]
    levels = [solid_of(config, what.object_index).levels() for what in slots]
    return PressData(
        felt={(tier.name, order): found for ((tier, _), order), found in zip(jobs, felt, strict=True)},
        force=np.stack([force_of(np.stack([np.asarray(d.measured_n) for d in drawn])) for drawn in draws], 1),
        shape=statistics(skins_of(tiers[0][0])),
        levels={name: np.array([level[name] for level in levels]) for name in levels[0]},
        objects=np.array([what.object_index for what in slots]),
    )
