"""Generated objects, each touched with every sensor, motion and force: the choices of a policy.

A choice is (sensor, motion, force).  Of each contact, a few frames are stored, and whether the strain of gel or object
exceeded the limit of small strains.  The generator knows the level of all five properties.
"""

import dataclasses
import functools
import hashlib
import itertools
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from experiments.core.artifacts import jsonable, write_arrays
from experiments.core.concurrency import idle_cores
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.mechanics.identify_motions import choose_frames
from sensors_io.scenes import motions
from sensors_io.scenes.cards import solid_of
from sensors_io.scenes.config import PROTOCOL_FRAMES, SceneConfig, config_hash
from sensors_io.scenes.schedule import Slot, pace
from sensors_io.scenes.sequence import make_sequence
from sensors_io.schema import EXPLORATORY, SENSORS, Flag, SchemaError, Sequence
from sensors_io.selection import choose_frames as salient_frames
from sensors_io.selection import field_images, pick_frames
from sensors_io.units import Launcher, WorkUnit, finish

PROPERTIES = ("hardness", "roughness", "protrusion", "elasticity", "friction")
"""What is asked for, in the order of the A axis; each has three levels."""

LEVELS = 3

VERSION = 1  # raised whenever the same configuration would give other contacts

_OBJECTS_A_FILE = 20
_FILES_A_WORKER = 4  # at least: a process takes seconds to start


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactsConfig:
    """The contacts of every object: all motions × forces × sensors.

    Args:
      objects: number of objects.
      motions, forces_n, sensors: what can be chosen; forces are the greatest normal force, N.
      frames: of a generated sequence.
      moments: frames that are kept of it, the untouched first one among them.
      picture_px: rows and columns of the kept pictures.
      contact_grid: side of the contact solver's grid.
      seed: of objects and contacts.
    """

    objects: int = 600
    motions: tuple[str, ...] = ("press", *EXPLORATORY)
    forces_n: tuple[float, ...] = (2.0, 10.0)
    sensors: tuple[str, ...] = SENSORS
    frames: int = 20
    moments: int = 6
    picture_px: int = 48
    contact_grid: int = 24
    seed: int = 34

    def __post_init__(self) -> None:
        for name, known in (("motions", ("press", *EXPLORATORY)), ("sensors", SENSORS)):
            given = getattr(self, name)
            if not given or len(set(given)) != len(given) or set(given) - set(known):
                raise ConfigurationError(
                    f"{name} is {given}: must be some of {', '.join(known)}, each once; correct it"
                )
        if not self.forces_n or min(self.forces_n) <= 0 or len(set(self.forces_n)) != len(self.forces_n):
            raise ConfigurationError(f"forces_n is {self.forces_n}: must be different forces above 0 N; correct it")
        if len(self.choices) < 2:
            raise ConfigurationError(
                f"motions × forces_n × sensors are {self.choices}: must be at least 2, or there is nothing to choose; "
                "add some"
            )
        if self.picture_px % 8 or self.picture_px < 16:
            raise ConfigurationError(
                f"picture_px is {self.picture_px}: must be a multiple of 8 and at least 16, for statistics of "
                "patches of half its rows; change it"
            )

    @property
    def choices(self) -> tuple[tuple[str, str, float], ...]:
        """(sensor, motion, force) of every choice."""
        return tuple(itertools.product(self.sensors, self.motions, self.forces_n))

    @property
    def seconds(self) -> Float[np.ndarray, "C"]:
        """Seconds of every choice: those of its motion in the protocol, from the first frame to the last."""
        return np.array([motions.plan(m, f, pace(PROTOCOL_FRAMES)).time_s[-1] for _, m, f in self.choices], np.float32)

    @property
    def scenes(self) -> SceneConfig:
        """The generator's configuration; frames past the strain limit are flagged."""
        contacts = self.objects * len(self.motions) * len(self.forces_n)
        return SceneConfig(
            objects=self.objects,
            sequences=len(SENSORS) * contacts,
            frames=self.frames,
            image_px=self.picture_px,
            contact_grid=self.contact_grid,
            past_limit="flag",
            seed=self.seed,
        )


@dataclasses.dataclass(frozen=True)
class ContactBank:
    """Every contact of every object.

    `frames` are the pictures with the fields below them, `harm` marks where the strain limit was passed, `label` is the
    level of each of `PROPERTIES`.
    """

    frames: UInt8[np.ndarray, "O C F H W 3"]
    harm: Bool[np.ndarray, "O C"]
    label: Int[np.ndarray, "O A"]


def generate(config: ContactsConfig, context: Context) -> ContactBank:
    """The bank of a configuration, generated or read from the cache; a stopped run resumes.

    Files of some objects are units of work, which the run's launcher computes, by default in a process for each core.
    """
    folder, rows = f"touch_bank/{contacts_hash(config)}", range(config.objects)
    parts = [rows[start : start + _OBJECTS_A_FILE] for start in rows[::_OBJECTS_A_FILE]]
    files, units = {f"{folder}/{part[0]:06d}": functools.partial(contacts_of, config, part) for part in parts}, []
    for name, make in files.items():
        path = (context.cache_dir / f"{name}.npz").absolute()
        units.append(WorkUnit(name=name, run=functools.partial(_write, path, name, make), done=path.exists))
    launcher = context.launcher
    if launcher.here:
        launcher = Launcher(workers=max(1, min(idle_cores(context), len(units) // _FILES_A_WORKER)))
    with context.progress("files of contacts", len(units)) as advance:
        for _ in finish(units, launcher, context.print):
            advance()
    read = [context.cached_arrays(name, make) for name, make in files.items()]
    return ContactBank(
        frames=np.concatenate([x.pop("frames") for x in read]),
        harm=np.concatenate([x["harm"] for x in read]),
        label=np.array(
            [[solid_of(config.scenes, i).levels()[name] for name in PROPERTIES] for i in range(config.objects)]
        ),
    )


def contacts_of(config: ContactsConfig, objects: range) -> dict[str, np.ndarray]:
    """Frames and harm of all contacts of some objects."""
    frames, harm = zip(*(object_contacts(config, i) for i in objects), strict=True)
    return {"frames": np.stack(frames), "harm": np.stack(harm)}


def _write(path: Path, name: str, make: Callable[[], dict[str, np.ndarray]]) -> None:
    write_arrays(path, make(), of=name)


def contacts_hash(config: ContactsConfig) -> str:
    """Hash of everything that decides the contacts."""
    values = {"contacts": config, "scenes": config_hash(config.scenes), "version": VERSION}
    return hashlib.sha256(json.dumps(jsonable(values), sort_keys=True).encode()).hexdigest()[:16]


def object_contacts(config: ContactsConfig, index: int) -> tuple[UInt8[np.ndarray, "C F H W 3"], Bool[np.ndarray, "C"]]:
    """Frames and harm of all choices of object number `index`; each motion and force touches a place of its own."""
    made = [one_contact(config, index, choice) for choice in config.choices]
    harm = [bool(np.any(contact.flags & np.uint32(Flag.STRAIN_LIMIT))) for contact in made]
    return np.stack([kept_frames(contact, config) for contact in made]), np.array(harm)


def one_contact(config: ContactsConfig, index: int, choice: tuple[str, str, float]) -> Sequence:
    """The contact of object number `index` by one choice."""
    tasks = list(itertools.product(config.motions, config.forces_n))
    sensor, motion, force = choice
    site = tasks.index((motion, force))
    slot = Slot(object_index=index, site=site, motion=motion, force_n=force)
    return make_sequence(config.scenes, index * len(tasks) + site, slot, SENSORS.index(sensor), 0)


def kept_frames(sequence: Sequence, config: ContactsConfig) -> UInt8[np.ndarray, "F H W 3"]:
    """The frames that are kept of a generated contact: the untouched one, and frames spread over what changes."""
    return frames_at(sequence, choose_frames(sequence.phase, config.moments), config)


def recorded_frames(sequence: Sequence, config: ContactsConfig) -> UInt8[np.ndarray, "F H W 3"]:
    """The frames that are kept of a recording, whose phases are unknown: those that stand for it."""
    chosen = salient_frames(sequence, config.moments, ())
    if len(chosen) < config.moments:
        raise SchemaError(f"{sequence.name} has {len(chosen)} frames: must have {config.moments}; record longer")
    return frames_at(sequence, chosen, config)


def frames_at(sequence: Sequence, chosen: Int[np.ndarray, "F"], config: ContactsConfig) -> UInt8[np.ndarray, "F H W 3"]:
    """Pictures at these positions, and below them the displacement and depth fields at half their rows.

    A sensor without a camera has a black picture; a field that a sensor does not measure is 128.
    """
    picked = pick_frames(sequence, chosen)
    wide, half = config.picture_px, config.picture_px // 2
    resized = lambda images, rows: np.stack([cv2.resize(x, (wide, rows), interpolation=cv2.INTER_AREA) for x in images])
    measured = picked.deformation_mm is not None or picked.depth_mm is not None
    fields = resized(field_images(picked), half) if measured else np.full((config.moments, half, wide, 3), 128.0)
    fields = np.clip(np.rint(fields), 0, 255).astype(np.uint8)
    pictures = np.zeros((config.moments, wide, wide, 3), np.uint8)
    if picked.frames is not None:
        pictures = picked.frames if picked.frames.shape[1:3] == (wide, wide) else resized(picked.frames, wide)
    return np.concatenate([pictures, fields], 1)
