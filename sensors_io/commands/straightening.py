"""Pictures as a measured lens shows them, made straight before anything is read from them."""

import dataclasses
import pathlib
from typing import Self

import numpy as np

from sensors_io.calibration.geometry import CameraGeometry, Rectifier
from sensors_io.fields.types import Calibration, CalibrationError

_MADE_FROM = "geometry"  # entry of a calibration's `made_from` that names the geometry of its pictures


@dataclasses.dataclass(frozen=True, kw_only=True)
class Straightening:
    """Rectification of every picture of a camera: none, or a view from directly above.

    Args:
      view: of a measured geometry, if there is one.
      geometry: its hash, empty without one.
      mm_per_px: pitch of the pixels afterwards.
    """

    view: Rectifier | None
    geometry: str
    mm_per_px: float

    @classmethod
    def of(cls, path: pathlib.Path | None, mm_per_px: float | None, size_px: tuple[int, int]) -> Self:
        """By a file that `geometry` wrote, at the pitch of its centre unless one is given.

        Args:
          path: the file; `None` leaves pictures as they are.
          mm_per_px: pitch; `None` takes the geometry's.
          size_px: rows and columns of the pictures, before and after.

        Raises:
          CalibrationError: neither a geometry nor a pitch.
        """
        if path is None:
            if mm_per_px is None:
                raise CalibrationError(
                    "mm_per_px is not given: must be known without a geometry or a calibration; set --mm-per-px"
                )
            return cls(view=None, geometry="", mm_per_px=mm_per_px)
        geometry = CameraGeometry.load(path)
        pitch = geometry.mm_per_px if mm_per_px is None else mm_per_px
        return cls(view=geometry.view(mm_per_px=pitch, size_px=size_px), geometry=geometry.hash, mm_per_px=pitch)

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """One picture, [H, W, 3]."""
        return picture if self.view is None else self.view(picture)

    def signed(self, calibration: Calibration) -> Calibration:
        """The calibration, which says by which geometry its pictures were made straight."""
        if self.view is None:
            return calibration
        return dataclasses.replace(calibration, made_from={**calibration.made_from, _MADE_FROM: self.geometry})

    def check(self, calibration: Calibration) -> None:
        """Check that pictures are rectified in the same way as those of the calibration.

        Raises:
          CalibrationError: by another geometry, or only one of the two.
        """
        before = calibration.made_from.get(_MADE_FROM, "")
        if before != self.geometry:
            raise CalibrationError(
                f"geometry is {self.geometry or 'none'}: must be {before or 'none'}, which the pictures of the "
                "calibration were made straight by; give --geometry that file, or calibrate with this one"
            )
