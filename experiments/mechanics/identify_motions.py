"""Features of exploratory motions by every sensor: of a slide, and of a press that is held and released.

The contacts are those of the protocol, straight from the generator.
"""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from experiments.mechanics.identify_features import features_of, field_counts, force_of, in_threads, statistics
from sensors_io.live import LiveScenes
from sensors_io.scenes.cards import solid_of
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import site_of
from sensors_io.scenes.protocol import slot
from sensors_io.schema import SENSORS, Phase, Sequence

MOTIONS = ("slide_x", "hold")
"""A slide shows friction; a press that is released shows how much work the object returns."""

_QUIET = (Phase.APPROACH, Phase.HOLD)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionData:
    """n contacts of one motion: features of each sensor [n, D], force [n, S, E], true shape [n, G].

    `levels` [n] by property; `objects` [n].
    """

    touch: tuple[np.ndarray, ...]
    force: np.ndarray
    shape: np.ndarray
    levels: dict[str, np.ndarray]
    objects: np.ndarray


def motion_data(
    config: SceneConfig, motion: str, moments: int, advance: Callable[[], object], rows: list[int] | None = None
) -> MotionData:
    """Make and summarise contacts of one motion.

    Args:
      config: the protocol.
      motion: one of `MOTIONS`.
      moments: frames of a sequence that are looked at.
      advance: called after each contact.
      rows: which contacts; all of the motion by default.
    """
    scenes = LiveScenes(config)
    rows = contacts_of(scenes, motion) if rows is None else rows
    felt = in_threads(lambda row: _contact(scenes, row, moments), rows, advance)
    slots = [slot(config, row) for row in rows]
    sites = [site_of(config, s.object_index, s.site, one.trial) for s, one in zip(slots, felt, strict=True)]
    levels = [solid_of(config, s.object_index).levels() for s in slots]
    return MotionData(
        touch=tuple(np.stack([one.touch[order] for one in felt]) for order in range(len(SENSORS))),
        force=np.stack([one.force for one in felt]),
        shape=statistics([s.skin for s in sites]),
        levels={name: np.array([level[name] for level in levels]) for name in levels[0]},
        objects=np.array([s.object_index for s in slots]),
    )


def contacts_of(scenes: LiveScenes, motion: str) -> list[int]:
    """Contacts of one motion."""
    return [i for i, key in enumerate(scenes.contacts) if key.motion == motion]


def look_at(phase: np.ndarray, moments: int) -> np.ndarray:
    """Frames that are looked at: the untouched first one, then evenly among those in which something changes.

    Args:
      phase: `Phase` of every frame [F].
      moments: how many.

    Raises:
      ValueError: fewer frames than that.
    """
    busy = np.flatnonzero(~np.isin(phase, _QUIET))
    if moments - 1 > len(busy):
        raise ValueError(f"moments is {moments}: only {1 + len(busy)} frames are there to be looked at; lower moments")
    return np.concatenate([[0], busy[np.round(np.linspace(0, len(busy) - 1, moments - 1)).astype(int)]])


@dataclasses.dataclass(frozen=True)
class _ContactFeatures:
    """Features of one contact by sensor, force, and number of the trial."""

    touch: tuple[np.ndarray, ...]
    force: np.ndarray
    trial: int


def _contact(scenes: LiveScenes, row: int, moments: int) -> _ContactFeatures:
    by_sensor = scenes.contact(row)
    made = [by_sensor[name] for name in SENSORS]
    chosen = look_at(made[0].phase, moments)
    return _ContactFeatures(
        touch=tuple(_touch(sequence, chosen) for sequence in made),
        force=np.stack([force_of(_known(sequence.force_n)[chosen]) for sequence in made]),
        trial=made[0].key.trial,
    )


def _touch(sequence: Sequence, chosen: np.ndarray) -> np.ndarray:
    depth = _known(sequence.depth_mm)[chosen]
    still = np.zeros((*depth.shape, 2), np.float32)
    moved = still if sequence.deformation_mm is None else sequence.deformation_mm[chosen]
    pictures = None if sequence.frames is None else sequence.frames[chosen]
    return np.asarray(_summarised(pictures, moved, depth))


@jax.jit
def _summarised(pictures: jax.Array | None, deformation_mm: jax.Array, depth_mm: jax.Array) -> jax.Array:
    return features_of(pictures, field_counts(deformation_mm, depth_mm))


def _known(array: np.ndarray | None) -> np.ndarray:
    """An array that every generated sequence has."""
    assert array is not None
    return array
