"""`python -m sensors_io geometry`."""

import dataclasses
import pathlib

import tyro

from sensors_io.calibration.geometry import find_pins, fit_geometry
from sensors_io.commands.console import OUT
from sensors_io.fields.sources import read_picture


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeasureGeometry:
    """Measure lens distortion and mm/px from one picture of a pin board pressed into the gel."""

    board: tyro.conf.Positional[pathlib.Path]
    """Picture of the pressed board."""
    background: pathlib.Path
    """Picture of the untouched gel."""
    rows: int
    """Pins from top to bottom."""
    columns: int
    """Pins from left to right."""
    pitch_mm: float
    """Distance between neighbouring pins."""
    out: pathlib.Path
    """Geometry file to write (JSON)."""

    def run(self) -> int:
        picture, rest = read_picture(self.board), read_picture(self.background)
        pins = find_pins(picture, rest, rows=self.rows, columns=self.columns)
        fitted = fit_geometry(pins, pitch_mm=self.pitch_mm, size_px=(picture.shape[0], picture.shape[1]))
        fitted.save(self.out)
        OUT.print(
            f"{fitted.mm_per_px:.5f} mm/px at the centre, pins left out are off by {1e3 * fitted.held_out_mm:.0f} µm"
        )
        return 0
