"""Input and output of field extraction: `Calibration` and `Fields`.

Frames of reference, units and the meaning of every field are those of `sensors_io.schema`.
"""

import dataclasses
import hashlib
import io
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, Self

import cv2
import numpy as np

from sensors_io.arrays import load_arrays
from sensors_io.errors import MALFORMED, UserError
from sensors_io.fields.slopes import ColourMap
from sensors_io.json_files import write_whole
from sensors_io.schema import SchemaError, Spec, check_arrays

FIELD_ARRAYS: Mapping[str, Spec] = {
    "depth_mm": Spec(np.float32, ("N", "H", "W"), optional=True),
    "contact": Spec(np.bool_, ("N", "H", "W")),
    "deformation_mm": Spec(np.float32, ("N", "h", "w", "2"), optional=True),
    "shear_mm": Spec(np.float32, ("N", "h", "w", "2"), optional=True),
    "traction_mpa": Spec(np.float32, ("N", "h", "w", "3"), optional=True),  # on the gel: pressing is z < 0
    "force_n": Spec(np.float32, ("N", "3"), optional=True),
    "flags": Spec(np.uint32, ("N",)),  # bits of `schema.Flag`
}
"""Per-frame arrays of `Fields`: depth and contact at every pixel, vector fields on their own grid."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fields:
    """Fields of N frames; `None` where the input cannot carry one, which a flag of every frame then says.

    Arrays are those of `FIELD_ARRAYS`.  The vector fields lie on a grid that covers the same window as the pixels.

    Args:
      mm_per_px: pitch of depth and contact.
      grid_mm: pitch of the vector fields along x and y; `None` where there is none.
    """

    depth_mm: np.ndarray | None = None
    contact: np.ndarray
    deformation_mm: np.ndarray | None = None
    shear_mm: np.ndarray | None = None
    traction_mpa: np.ndarray | None = None
    force_n: np.ndarray | None = None
    flags: np.ndarray
    mm_per_px: float
    grid_mm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_arrays(FIELD_ARRAYS, self.arrays(), where="fields")
        vectors = [self.deformation_mm, self.shear_mm, self.traction_mpa]
        if any(v is not None for v in vectors) and self.grid_mm is None:
            raise SchemaError("fields: grid_mm is None: vector fields need their pitch; give (x, y) in mm")

    def __len__(self) -> int:
        return len(self.flags)

    def arrays(self) -> dict[str, np.ndarray | None]:
        """The arrays alone, keyed as in `FIELD_ARRAYS`."""
        return {name: getattr(self, name) for name in FIELD_ARRAYS}


class CalibrationError(UserError, ValueError):
    """A calibration that cannot be made, read or used; the message says why and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibration:
    """Map from one sensor's pictures to slopes: made once from presses of a ball, saved as one file.

    Args:
      sensor: canonical name.
      background: uint8 [H, W, 3] RGB, the gel at rest.
      mm_per_px: pitch of the pixels.
      colours: the colour → slope map.
      made_from: numbers that say where it comes from: ball diameter, presses, held-out errors.
    """

    sensor: str
    background: np.ndarray
    mm_per_px: float
    colours: ColourMap
    made_from: Mapping[str, Any]

    def __post_init__(self) -> None:
        check_arrays({"background": Spec(np.uint8, ("H", "W", "3"))}, {"background": self.background}, "calibration")
        if not 0 < self.mm_per_px < 1:
            raise CalibrationError(f"mm_per_px is {self.mm_per_px}: must lie in (0, 1); give millimetres per pixel")

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of everything that decides the fields; `Sequence.calibration`."""
        degrees = [self.colours.degree, self.colours.position_degree]
        digest = hashlib.sha256(json.dumps([self.sensor, self.mm_per_px, degrees]).encode())
        for array in (self.colours.weights, self.background):
            digest.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]

    def require_sensor(self, sensor: str) -> None:
        """Refuse pictures of another sensor.

        Raises:
          CalibrationError: it is for another one.
        """
        if self.sensor != sensor:
            raise CalibrationError(
                f"calibration is for {self.sensor!r}, the pictures are of {sensor!r}: must be equal; name the sensor, "
                "or give its calibration"
            )

    def at_size(self, size_px: tuple[int, int]) -> Self:
        """The calibration for pictures of the same window at another size: the map depends on the place in the window.

        Args:
          size_px: rows and columns.

        Raises:
          CalibrationError: a window of another shape.
        """
        rows, columns = self.background.shape[:2]
        if round(columns * size_px[0] / rows) != size_px[1]:
            raise CalibrationError(
                f"calibration is for pictures of {rows} × {columns} px, these are {size_px[0]} × {size_px[1]}: both "
                "must show the same window; crop them alike, or calibrate this camera"
            )
        background = cv2.resize(self.background, size_px[::-1], interpolation=cv2.INTER_AREA)
        return dataclasses.replace(self, background=background, mm_per_px=self.mm_per_px * rows / size_px[0])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it as one npz, whole or not at all."""
        plain = {
            "sensor": self.sensor,
            "mm_per_px": self.mm_per_px,
            "degree": self.colours.degree,
            "position_degree": self.colours.position_degree,
            "made_from": dict(self.made_from),
            "hash": self.hash,
        }
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer, background=self.background, weights=self.colours.weights, plain=np.array(json.dumps(plain))
        )
        write_whole(pathlib.Path(path), buffer.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read what `save` wrote.

        Raises:
          CalibrationError: no such file, no calibration, or one whose hash does not hold.
        """
        try:
            file = load_arrays(path)
            weights, background, plain = file["weights"], file["background"], json.loads(str(file["plain"]))
            degrees = {name: plain.pop(name) for name in ("degree", "position_degree")}
            stated = plain.pop("hash")
            found = cls(background=background, colours=ColourMap(weights=weights, **degrees), **plain)
        except MALFORMED as error:
            raise CalibrationError(
                f"{path} is no calibration ({error}); make one with `python -m sensors_io calibrate`"
            ) from error
        if found.hash != stated:
            raise CalibrationError(f"{path} was changed: its hash is {found.hash}, not {stated}; make it anew")
        return found
