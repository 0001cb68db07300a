"""`python -m sensors_io extract`."""

import collections
import dataclasses
import io
import pathlib
from typing import Annotated, Any

import numpy as np
import tyro
from rich.table import Table

from sensors_io.commands.console import OUT, progress_bar
from sensors_io.commands.straightening import Straightening
from sensors_io.fields.extract import ExtractConfig, Extractor, joined
from sensors_io.fields.sources import SourceError, read_picture, read_pictures
from sensors_io.fields.types import Calibration, CalibrationError, Fields, write_whole
from sensors_io.schema import Flag

_REFUSED = (("depth_mm", (1, 1)), ("deformation_mm", (1, 1, 2)), ("shear_mm", (1, 1, 2)))
"""Fields that a file always holds, and their shape in a frame that cannot carry them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Extract:
    """Extract depth, contact, deformation, shear and force from pictures, as arrays over frames in one npz file.

    A field that the input cannot carry is flagged in every frame, said so, and written as NaN on a grid of one point.
    """

    inputs: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """Pictures, folders, videos or records."""
    background: pathlib.Path
    """Picture of the gel at rest."""
    out: pathlib.Path
    """File to write (.npz)."""
    sensor: str = "gelsight_mini"
    """Name of the sensor; of records, its frames are read."""
    calibration: pathlib.Path | None = None
    """Calibration from `calibrate`; without it, neither depth nor shear is computed."""
    mm_per_px: float | None = None
    """Millimetres per pixel; by default those of the calibration or the geometry."""
    geometry: pathlib.Path | None = None
    """File written by `geometry`: pictures are rectified first. Must be the file that `calibrate` was given."""
    config: Annotated[ExtractConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=ExtractConfig)

    def run(self) -> int:
        calibration = None if self.calibration is None else Calibration.load(self.calibration)
        if calibration is not None and calibration.sensor != self.sensor:
            raise CalibrationError(
                f"{self.calibration} is for {calibration.sensor!r}, not {self.sensor!r}: must be equal; set --sensor"
            )
        rest = read_picture(self.background)
        straight = self._straightening(calibration, (rest.shape[0], rest.shape[1]))
        extractor = Extractor(straight(rest), straight.mm_per_px, calibration, self.config)
        pictures = read_pictures(self.inputs, self.sensor)
        if pictures.frames.shape[1:] != rest.shape:
            sizes = f"{pictures.frames.shape[1:3]} and {rest.shape[:2]}"
            raise SourceError(f"pictures and background have sizes {sizes}: must be equal; crop them alike")
        parts = []
        with progress_bar("frames") as progress:
            for i, frame in enumerate(pictures.frames):
                gap, apart = bool(pictures.gap[i]), bool(pictures.apart[i])
                parts.append(extractor.read(straight(frame), gap=gap, apart=apart))
                progress(i + 1, len(pictures))
        fields = joined(parts)
        write_whole(self.out, encoded(fields, pictures.names, "" if calibration is None else calibration.hash))
        OUT.print(summary(fields, extractor.refused))
        OUT.print(f"wrote {self.out}", highlight=False)
        return 0

    def _straightening(self, calibration: Calibration | None, size_px: tuple[int, int]) -> Straightening:
        pitch = self.mm_per_px
        if pitch is None and calibration is not None:
            pitch = calibration.mm_per_px
        straight = Straightening.of(self.geometry, pitch, size_px)
        if calibration is not None:
            straight.check(calibration)
        return straight


def encoded(fields: Fields, names: tuple[str, ...], calibration: str) -> bytes:
    """An npz of the fields, the names of the frames, the pitches and the hash of the calibration.

    `depth_mm`, `deformation_mm` and `shear_mm` are always there, NaN [N, 1, 1] or [N, 1, 1, 2] where they were refused.
    """
    arrays: dict[str, Any] = {name: np.full((len(fields), *shape), np.nan, np.float32) for name, shape in _REFUSED}
    arrays |= {name: array for name, array in fields.arrays().items() if array is not None}
    plain: dict[str, Any] = {
        "names": np.array(names),
        "mm_per_px": np.float64(fields.mm_per_px),
        "calibration": np.array(calibration),
    }
    if fields.grid_mm is not None:
        plain["grid_mm"] = np.array(fields.grid_mm)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, **plain)
    return buffer.getvalue()


def summary(fields: Fields, refused: tuple[str, ...]) -> Table:
    """Summary of written records, refused records, and frames by flag."""
    table = Table("what", "figure or reason", title=f"{len(fields)} frames")
    for name, array in fields.arrays().items():
        if array is not None and name != "flags":
            table.add_row(name, f"{array.dtype}{list(array.shape)}")
    for reason in refused:
        table.add_row("refused", reason)
    counts = collections.Counter({flag: int(np.count_nonzero(fields.flags & np.uint32(flag))) for flag in Flag})
    for flag, count in counts.items():
        if count:
            table.add_row(f"flag {str(flag.name).lower()}", str(count))
    return table
