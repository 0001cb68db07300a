"""Features of exploratory motions by every sensor: of a slide, and of a press that is held and released.

The contacts are those of the protocol, straight from the generator.
"""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from experiments.core.concurrency import in_threads
from experiments.mechanics.identify_features import ContactData, features_of, force_of, truth
from sensors_io.live import LiveScenes
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import site_of
from sensors_io.scenes.protocol import slot
from sensors_io.schema import SENSORS, Phase, Sequence

MOTIONS = ("slide_x", "hold")
"""A slide shows friction; a press that is released shows how much work the object returns."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionData(ContactData):
    """n contacts of one motion; `touch` holds the features of each sensor, [n, D]."""

    touch: tuple[np.ndarray, ...]


def motion_data(
    config: SceneConfig, motion: str, moments: int, advance: Callable[[], object], rows: list[int] | None = None
) -> MotionData:
    """Make and summarise contacts of one of `MOTIONS`, all of the protocol's or those at `rows`.

    Of each sequence `moments` frames are used; `advance` is called after each contact.
    """
    scenes = LiveScenes(config)
    rows = contacts_of(scenes, motion) if rows is None else rows

    def summarise(row: int) -> tuple[list[np.ndarray], np.ndarray, int]:
        by_sensor = scenes.contact(row)
        made = [by_sensor[name] for name in SENSORS]
        chosen = choose_frames(made[0].phase, moments)
        touch = [_touch(sequence, chosen) for sequence in made]
        force = np.stack([force_of(_known(sequence.force_n)[chosen]) for sequence in made])
        return touch, force, made[0].key.trial

    touch, force, trials = zip(*in_threads(summarise, rows, advance), strict=True)
    slots = [slot(config, row) for row in rows]
    sites = [site_of(config, s.object_index, s.site, trial) for s, trial in zip(slots, trials, strict=True)]
    return MotionData(
        touch=tuple(np.stack(of_sensor) for of_sensor in zip(*touch, strict=True)),
        force=np.stack(force),
        **truth(config, slots, [s.skin for s in sites]),
    )


def contacts_of(scenes: LiveScenes, motion: str) -> list[int]:
    """Contacts of one motion."""
    return [i for i, key in enumerate(scenes.contacts) if key.motion == motion]


def choose_frames(phase: np.ndarray, moments: int) -> np.ndarray:
    """The untouched first frame, then frames spread evenly over those whose `Phase` [F] is one of change.

    Raises:
      ValueError: fewer than `moments` frames.
    """
    busy = np.flatnonzero(~np.isin(phase, (Phase.APPROACH, Phase.HOLD)))
    if moments - 1 > len(busy):
        raise ValueError(f"moments is {moments}: only {1 + len(busy)} frames differ; lower moments")
    return np.concatenate([[0], busy[np.round(np.linspace(0, len(busy) - 1, moments - 1)).astype(int)]])


def _touch(sequence: Sequence, chosen: np.ndarray) -> np.ndarray:
    depth = _known(sequence.depth_mm)[chosen]
    still = np.zeros((*depth.shape, 2), np.float32)
    moved = still if sequence.deformation_mm is None else sequence.deformation_mm[chosen]
    pictures = None if sequence.frames is None else sequence.frames[chosen]
    return np.asarray(_compiled(pictures, moved, depth))


_compiled = jax.jit(features_of)


def _known(array: np.ndarray | None) -> np.ndarray:
    """An array that every generated sequence has."""
    assert array is not None
    return array
