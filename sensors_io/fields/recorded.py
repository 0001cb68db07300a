"""Extraction of fields from recorded pictures: the gel at rest, the size and the pitch are those of each recording."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from sensors_io.fields.extract import ExtractConfig, Extractor, joined
from sensors_io.fields.sources import SourceError, read_picture
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.importers.keep import at_height
from sensors_io.quality import after_gap
from sensors_io.remote import Place, local
from sensors_io.schema import Flag, SchemaError, Sequence

_SAME_PITCH = 0.01  # relative difference up to which a recorded pitch is that of the calibration


@dataclasses.dataclass(frozen=True, kw_only=True)
class RestGel:
    """The gel at rest and its scale, for recordings that do not have their own.

    Args:
      background: uint8 [H, W, 3] RGB, at the size of the recorded pictures or at one of the same window.
      rest_frames: frames at the start of each recording whose mean is the gel at rest; 0 takes none.
      mm_per_px: pitch of the recorded pictures.
    """

    background: np.ndarray | None = None
    rest_frames: int = 0
    mm_per_px: float | None = None

    def __post_init__(self) -> None:
        if self.rest_frames < 0 or (self.rest_frames and self.background is not None):
            raise SchemaError(
                f"rest_frames is {self.rest_frames}: must be ≥ 0, and 0 with a background; leave one of them out"
            )
        if self.mm_per_px is not None and not 0 < self.mm_per_px < 1:
            raise SchemaError(f"mm_per_px is {self.mm_per_px}: must lie in (0, 1); give millimetres per pixel")


class RecordedGels:
    """Extractors of the sequences of records; those of one gel, size and pitch share one.

    Args:
      root: of the records.
      gel: where a recording has no gel at rest or pitch of its own.
      calibration: of the colours, at the size of the pictures or at one of the same window.
      config: of the extraction.
    """

    def __init__(
        self, root: Place, gel: RestGel, calibration: Calibration | None = None, config: ExtractConfig | None = None
    ):
        self._root, self._gel, self._calibration, self._config = root, gel, calibration, config
        self._extractors: dict[tuple[str, float, tuple[int, ...]], Extractor] = {}
        self._rests: dict[tuple[str, tuple[int, ...]], np.ndarray] = {}

    def extractor(self, sequence: Sequence) -> Extractor:
        """The extractor of a sequence.

        Raises:
          CalibrationError: no pictures; no gel at rest, none of this shape, or one that cannot be read; no pitch; a
            calibration of another window.
        """
        with _named():
            rest, pitch, calibration = self._known(sequence)
            if not background_file(sequence) and self._gel.rest_frames:
                return Extractor(rest, pitch, calibration, self._config)
            key = background_file(sequence), pitch, rest.shape
            if key not in self._extractors:
                self._extractors[key] = Extractor(rest, pitch, calibration, self._config)
            return self._extractors[key]

    def require(self, sequence: Sequence) -> None:
        """Refuse what `extractor` refuses without making one, which takes seconds for a gel with markers."""
        with _named():
            self._known(sequence)

    def _known(self, sequence: Sequence) -> tuple[np.ndarray, float, Calibration | None]:
        """The gel at rest, the pitch, and the calibration at the size of the pictures."""
        if sequence.frames is None:
            raise CalibrationError("they hold no pictures")
        shape = sequence.frames.shape[1:]
        calibration = self._calibration
        if calibration is not None:
            calibration.require_sensor(sequence.sensor)
        if calibration is not None and calibration.background.shape != shape:
            calibration = calibration.at_size((shape[0], shape[1]))
        return self._rest(sequence, background_file(sequence)), self._pitch(sequence, calibration), calibration

    def _pitch(self, sequence: Sequence, calibration: Calibration | None) -> float:
        pitch = self._gel.mm_per_px if sequence.mm_per_px is None else sequence.mm_per_px
        if calibration is None:
            if pitch is None:
                raise CalibrationError(
                    "their mm per px are unknown: give --mm-per-px or --calibration, or import and record with it"
                )
            if not 0 < pitch < 1:
                raise CalibrationError(f"mm_per_px is {pitch}: must lie in (0, 1); give --mm-per-px or --calibration")
            return pitch
        if pitch is not None and abs(pitch / calibration.mm_per_px - 1) > _SAME_PITCH:
            raise CalibrationError(
                f"their pitch is {pitch:g} mm/px, that of the calibration at their size {calibration.mm_per_px:g}: "
                "must be equal; calibrate this camera, or correct --mm-per-px"
            )
        return calibration.mm_per_px

    def _rest(self, sequence: Sequence, name: str) -> np.ndarray:
        assert sequence.frames is not None
        if not name and self._gel.rest_frames:
            count = min(self._gel.rest_frames, len(sequence))
            return np.rint(sequence.frames[:count].mean(0)).astype(np.uint8)
        shape = sequence.frames.shape[1:]
        if (name, shape) in self._rests:
            return self._rests[name, shape]
        rest = read_picture(local(self._root, name)) if name else self._gel.background
        if rest is None:
            raise CalibrationError("no gel at rest was recorded with them: give --background or --rest-frames")
        rest = at_height(rest, shape[0])
        if rest.shape != shape:
            raise CalibrationError(
                f"their pictures are {shape[:2]}, the gel at rest is {rest.shape[:2]} at their height: crop them alike"
            )
        self._rests[name, shape] = rest
        return rest


@contextlib.contextmanager
def _named() -> Iterator[None]:
    try:
        yield
    except (SchemaError, SourceError) as error:
        raise CalibrationError(str(error)) from error


def recorded_fields(sequence: Sequence, extractor: Extractor) -> Fields:
    """Fields of every frame of a sequence with pictures, by the extractor that `RecordedGels` has for it."""
    assert sequence.frames is not None
    frames = zip(sequence.frames, after_gap(sequence, extractor.config.quality).tolist(), strict=True)
    return joined([extractor.read(f, gap=gap, apart=n == 0) for n, (f, gap) in enumerate(frames)])


def with_fields(sequence: Sequence, fields: Fields, calibration: str, rows: int = 0) -> Sequence:
    """The sequence with depth, deformation, shear and force added to its pictures, on one grid.

    Depth and contact are brought to `rows` rows by area means, vector fields by linear interpolation.  A field that the
    pictures cannot carry stays absent; that alone flags no frame.  A measured force stays as it was recorded.

    Args:
      sequence: N pictures.
      fields: of them.
      calibration: hash of the calibration, empty without one.
      rows: of the fields; 0, or more than the pictures have, takes those of the pictures.
    """
    assert sequence.frames is not None
    height, width = sequence.frames.shape[1:3]
    rows = min(rows or height, height)
    size = (max(1, round(width * rows / height)), rows)
    found: dict[str, Any] = {}
    for name in ("depth_mm", "deformation_mm", "shear_mm"):
        array = getattr(fields, name)
        if array is not None:
            shrinks = size[1] < array.shape[1]
            how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            found[name] = np.stack([cv2.resize(one, size, interpolation=how) for one in array])
    if not found:
        return sequence
    lost = ~np.logical_and.reduce([np.isfinite(a).reshape(*a.shape[:3], -1).all(-1) for a in found.values()])
    if lost.any():
        found = {name: np.nan_to_num(a, nan=0.0, posinf=0.0, neginf=0.0) for name, a in found.items()}
        found["valid"] = ~lost
    camera = dict(sequence.camera)
    if fields.force_n is not None and sequence.force_n is None:
        found["force_n"] = fields.force_n
        camera["force_n"] = "estimated from the fields"
    flags = sequence.flags | (fields.flags & ~np.uint32(Flag.REFUSED))
    return dataclasses.replace(sequence, calibration=calibration, camera=camera, flags=flags, **found)


def background_file(sequence: Sequence) -> str:
    """File of the gel at rest that was recorded with a sequence, empty where none was."""
    name: str = sequence.camera.get("recording", {}).get("background") or ""
    return name
