"""Schema of a tactile recording: names, shapes, units and frames of reference of everything that is stored.

Frames of reference.  Image x points right, y down, z out of the gel towards the object.  `depth_mm` is the indentation
into the gel, stored positive.  `force_n` is the force *on the gel*: pressing is Fz < 0 and a press target is −Fz.
Moments are about the centre of the sensing window.  Vector fields carry (x, y) in their last axis.

Dimensions.  N frames of a sequence, H W image rows and columns, h w field rows and columns, S sensors, F frames of a
clip, A attributes.
"""

import dataclasses
import enum
import numbers
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from sensors_io.errors import UserError

SENSORS: tuple[str, ...] = ("gelsight_mini", "xense", "tac3d", "dmtac_x")
"""Canonical sensor names.  Stream s of a clip is always sensor s of the data set's sensor tuple."""

ATTRIBUTES: tuple[str, ...] = ("hardness", "roughness", "protrusion", "material")
"""Labelled attributes: three ordinal ones with levels 0, 1, 2 and the categorical material."""

MATERIALS: tuple[str, ...] = ("plastic", "metal", "fabric", "food", "paper", "glass", "leather", "wood", "other")
LEVELS: Mapping[str, int] = {"hardness": 3, "roughness": 3, "protrusion": 3, "material": len(MATERIALS)}
UNKNOWN = -1
"""Label of an attribute that nobody annotated."""

EXPLORATORY: tuple[str, ...] = ("slide_x", "slide_y", "twist", "roll", "tap", "hold")
"""The six exploratory motions (our choice: the paper lists none)."""

MOTIONS: tuple[str, ...] = ("press", *EXPLORATORY, "free")
"""The press, the exploratory motions and unguided hand motion."""

PRESS_FORCE_N = 20.0
"""Greatest force of the press."""

FORCES_N: tuple[float, ...] = (2.0, 5.0, 10.0)
"""Normal forces at which an exploratory motion is made."""

SPLITS: tuple[str, ...] = ("train", "val", "test", "unlabelled")


class Phase(enum.IntEnum):
    """Phase of the hand's motion in a frame."""

    APPROACH = 0
    LOAD = 1
    HOLD = 2
    UNLOAD = 3
    MOVE = 4


class Flag(enum.IntFlag):
    """Quality flags of one frame; a frame without flags is trusted."""

    NONE = 0
    STRAIN_LIMIT = 1  # indentation past what small-strain theory carries
    NOT_CONVERGED = 2  # the contact solver stopped at its cap
    SATURATED = 4
    BORDER_CONTACT = 8
    NO_CONTACT = 16
    UNSTABLE_FORCE = 32
    MARKER_LOSS = 64
    TIME_GAP = 128  # frames are missing before this one, or after it if it is the last
    ADHESION = 256  # touched so lightly that adhesion, which is left out, would change the contact
    SEVERAL_CONTACTS = 512  # more than one blob, where one contact was meant
    INCOMPLETE = 1024  # a measured value of this row is missing
    REFUSED = 2048  # a field was asked for that this input cannot carry
    ERROR_UNMET = 4096  # generated on the best grid there is, which does not promise the error asked for
    NO_ZERO_LEVEL = 8192  # hardly any gel looks untouched, so that absolute depth hangs on nothing


class SchemaError(UserError, ValueError):
    """A recording that breaks the schema; the message names the field, the value, the constraint and the fix."""


@dataclasses.dataclass(frozen=True)
class Spec:
    """Type of one stored array: its dtype, its dimensions by name, and whether a recording may lack it."""

    dtype: type
    dims: tuple[str, ...]
    optional: bool = False


FRAME_ARRAYS: Mapping[str, Spec] = {
    "frames": Spec(np.uint8, ("N", "H", "W", "3"), optional=True),  # lossless camera frames, RGB; Tac3D exposes none
    "deformation_mm": Spec(np.float32, ("N", "h", "w", "2"), optional=True),
    "shear_mm": Spec(np.float32, ("N", "h", "w", "2"), optional=True),
    "depth_mm": Spec(np.float32, ("N", "h", "w"), optional=True),
    "valid": Spec(np.bool_, ("N", "h", "w"), optional=True),  # where the fields may be read
    "force_n": Spec(np.float32, ("N", "3"), optional=True),
    "moment_nmm": Spec(np.float32, ("N", "3"), optional=True),
    "target_force_n": Spec(np.float32, ("N",), optional=True),
    "host_time_ns": Spec(np.int64, ("N",)),  # monotonic
    "device_time_ns": Spec(np.int64, ("N",), optional=True),
    "force_time_ns": Spec(np.int64, ("N",), optional=True),
    "phase": Spec(np.uint8, ("N",)),  # of `Phase`
    "flags": Spec(np.uint32, ("N",)),  # bits of `Flag`
    "contact_grid": Spec(np.uint16, ("N",), optional=True),  # side of the grid that a generated contact was solved on
}
"""Per-frame arrays of a `Sequence`; row n of each of them together is one tactile record."""

CLIP_ARRAYS: Mapping[str, Spec] = {
    "frames": Spec(np.uint8, ("S", "F", "H", "W", "3")),
    "force_n": Spec(np.float32, ("S", "F", "3")),
    "frame_index": Spec(np.int32, ("S", "F")),  # integer time ids: position of the frame in its sequence
    "frame_mask": Spec(np.bool_, ("S", "F")),
    "stream_mask": Spec(np.bool_, ("S",)),
    "view": Spec(np.uint8, ("Hv", "Wv", "3")),
    "view_mask": Spec(np.bool_, ()),
    "label": Spec(np.int32, ("A",)),  # `UNKNOWN` where nobody annotated
}
"""One training example, a contact seen by all sensors.  `touchr1_jax.types.TouchBatch` is this with a leading P."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]*")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactKey:
    """Identity of one contact; sequences of different sensors with equal keys are paired."""

    object_id: str
    site: int
    motion: str
    trial: int

    def __post_init__(self) -> None:
        require_name("object_id", self.object_id)
        _require(self.motion in MOTIONS, "motion", self.motion, f"must be one of {', '.join(MOTIONS)}", "rename it")
        for name in ("site", "trial"):
            number = getattr(self, name)
            _require(0 <= number < 2**32, name, number, "must lie in 0..2³² − 1", f"number each {name} from 0")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sequence:
    """N tactile records: one contact seen by one sensor, stacked on the leading axis of every array.

    Arrays are those of `FRAME_ARRAYS`, `None` where the recording lacks them.  `contact_region_px` is (x, y, width,
    height) in the RGB-D view.  `calibration` is the hash of the calibration that made the fields, empty where none did.
    """

    key: ContactKey
    sensor: str
    serial: str = ""
    calibration: str = ""
    camera: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    contact_region_px: tuple[int, int, int, int] | None = None
    mm_per_px: float | None = None
    frames: np.ndarray | None = None
    deformation_mm: np.ndarray | None = None
    shear_mm: np.ndarray | None = None
    depth_mm: np.ndarray | None = None
    valid: np.ndarray | None = None
    force_n: np.ndarray | None = None
    moment_nmm: np.ndarray | None = None
    target_force_n: np.ndarray | None = None
    host_time_ns: np.ndarray
    device_time_ns: np.ndarray | None = None
    force_time_ns: np.ndarray | None = None
    phase: np.ndarray
    flags: np.ndarray
    contact_grid: np.ndarray | None = None

    def __post_init__(self) -> None:
        require_name("sensor", self.sensor)
        check_arrays(FRAME_ARRAYS, {name: getattr(self, name) for name in FRAME_ARRAYS}, where=f"{self.name}")
        seen = self.frames is not None or self.deformation_mm is not None or self.depth_mm is not None
        _require(seen, "frames", None, "a sequence needs camera frames or fields", "store at least one of them")
        empty = [name for name in FRAME_ARRAYS if (a := getattr(self, name)) is not None and 0 in a.shape[1:]]
        _require(not empty, f"{self.name}: empty arrays", empty, "must have rows and columns", "leave them out")
        ok = self.mm_per_px is None or isinstance(self.mm_per_px, numbers.Real)
        _require(ok, f"{self.name}: mm_per_px", self.mm_per_px, "must be a number", "correct it, or leave it out")
        recording = self.camera.get("recording", {}) if isinstance(self.camera, Mapping) else None
        ok = isinstance(recording, Mapping) and isinstance(recording.get("background"), str | None)
        ok = ok and isinstance(recording.get("left_out", 0), int)
        _require(ok, f"{self.name}: camera", self.camera, "must map names, its `recording` too", "leave that out")

    @property
    def name(self) -> str:
        """Unique name of the sequence inside a data set, for messages."""
        return f"{self.key.object_id}/{self.key.site}/{self.key.motion}/{self.key.trial}/{self.sensor}"

    def __len__(self) -> int:
        return len(self.flags)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectCard:
    """Entry stored once per object: its RGB-D view, its labels with their annotator, its split.

    `view` is uint8 [Hv, Wv, 3], `view_depth_mm` float32 [Hv, Wv]; both `None` where nobody photographed the object.
    `labels` maps an attribute to its level, `UNKNOWN` or absent where nobody annotated it.  `visual_lies` says that the
    appearance was made to contradict the touch (generated objects), `None` where unknown.
    `truth` holds the physical quantities behind the labels, with units in their names.
    """

    object_id: str
    split: str
    labels: Mapping[str, int]
    annotator: str
    view: np.ndarray | None = None
    view_depth_mm: np.ndarray | None = None
    visual_lies: bool | None = None
    truth: Mapping[str, float] = dataclasses.field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        require_name("object_id", self.object_id)
        _require(self.split in SPLITS, "split", self.split, f"must be one of {', '.join(SPLITS)}", "rename it")
        for attribute, level in self.labels.items():
            _require(attribute in LEVELS, "labels", attribute, f"must be one of {', '.join(ATTRIBUTES)}", "rename it")
            top = LEVELS[attribute] - 1
            ok = level == UNKNOWN or 0 <= level <= top
            _require(ok, f"labels[{attribute}]", level, f"must lie in 0..{top} or be {UNKNOWN}", "correct the label")
        if self.view is not None:
            ok = self.view.dtype == np.uint8 and self.view.ndim == 3 and self.view.shape[-1] == 3
            got = f"{self.view.dtype}{list(self.view.shape)}"
            _require(ok, "view", got, "must be uint8 [Hv, Wv, 3]", "convert the picture to RGB")

    def label_row(self) -> np.ndarray:
        """Labels in the order of `ATTRIBUTES`, int32 [A]."""
        return np.array([self.labels.get(a, UNKNOWN) for a in ATTRIBUTES], np.int32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Clip:
    """One training example: the arrays of `CLIP_ARRAYS` for one contact, and where they come from."""

    key: ContactKey
    frames: np.ndarray
    force_n: np.ndarray
    frame_index: np.ndarray
    frame_mask: np.ndarray
    stream_mask: np.ndarray
    view: np.ndarray
    view_mask: np.ndarray
    label: np.ndarray

    def __post_init__(self) -> None:
        check_arrays(CLIP_ARRAYS, {name: getattr(self, name) for name in CLIP_ARRAYS}, where=str(self.key))

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays alone, keyed as in `CLIP_ARRAYS`."""
        return {name: getattr(self, name) for name in CLIP_ARRAYS}


def check_arrays(specs: Mapping[str, Spec], arrays: Mapping[str, np.ndarray | None], where: str) -> None:
    """Hold a group of arrays to their specs: dtype, rank, literal sizes, and equal sizes of equally named dimensions.

    Raises:
      SchemaError: naming the array, what it is, what it must be and the fix.
    """
    sizes: dict[str, tuple[int, str]] = {}
    for name, spec in specs.items():
        array = arrays[name]
        if array is None:
            _require(spec.optional, f"{where}: {name}", None, "is required", "record it")
            continue
        # the texts are written where they are wanted alone: the names of dtypes took a quarter of the reading
        refuse = lambda must, fix, name=name, a=array: _require(
            False, f"{where}: {name}", f"{a.dtype}{list(a.shape)}", must, fix
        )
        if array.dtype != spec.dtype or array.ndim != len(spec.dims):
            refuse(f"must be {np.dtype(spec.dtype)}[{', '.join(spec.dims)}]", "convert it")
        for dim, size in zip(spec.dims, array.shape, strict=True):
            want, source = (int(dim), "the schema") if dim.isdigit() else sizes.setdefault(dim, (size, name))
            if size != want:
                refuse(f"dimension {dim} must be {want} as in {source}", "align the arrays")


def _require(ok: bool, field: str, value: object, constraint: str, fix: str) -> None:
    if not ok:
        raise SchemaError(f"{field} is {value!r}: {constraint}; {fix}")


def require_name(field: str, value: str) -> None:
    """Refuse what can name neither an object nor a sensor.

    Raises:
      SchemaError: it holds other characters than letters, digits, and `_.-`.
    """
    ok = _NAME.fullmatch(value) is not None
    _require(ok, field, value, "must be letters, digits, '_', '.' or '-', starting with a letter or digit", "rename it")
