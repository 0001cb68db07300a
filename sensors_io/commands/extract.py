"""`python -m sensors_io extract`."""

import collections
import dataclasses
import io
import pathlib
from typing import Annotated, Any

import numpy as np
import tyro
from rich.table import Table

from sensors_io import overview
from sensors_io.commands.console import OUT, progress_bar
from sensors_io.commands.straightening import Straightening
from sensors_io.fields.extract import ExtractConfig, Extractor, joined
from sensors_io.fields.extracted_records import FieldsJob, write_extracted
from sensors_io.fields.recorded import RestGel
from sensors_io.fields.sources import SourceError, read_picture, read_pictures
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.index import INDEX
from sensors_io.json_files import write_whole
from sensors_io.records import RecordStore
from sensors_io.schema import Flag
from sensors_io.units import Launcher

_REFUSED = (("depth_mm", (1, 1)), ("deformation_mm", (1, 1, 2)), ("shear_mm", (1, 1, 2)))
"""Fields that a file always holds, and their shape in a frame that cannot carry them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Extract:
    """Extract depth, contact, deformation, shear and force from pictures, as arrays over frames in one npz file.

    A field that the input cannot carry is flagged in every frame, said so, and written as NaN on a grid of one point.
    Records become new records with both pictures and fields if `--out` names a directory; an interrupted
    extraction resumes.
    """

    inputs: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """Pictures, folders, videos or records."""
    out: pathlib.Path
    """File to write (.npz), or, from one directory of records, the directory of the new records."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest; of records, for recordings that have none of their own."""
    rest_frames: int = 0
    """Of records: frames at the start of each recording that show the gel at rest, if no picture of it was recorded."""
    sensor: str = "gelsight_mini"
    """Name of the sensor; of records, its frames are read."""
    calibration: pathlib.Path | None = None
    """Calibration from `calibrate`; without it, neither depth nor shear is computed."""
    mm_per_px: float | None = None
    """Millimetres per pixel; by default those of the recording, the calibration or the geometry."""
    geometry: pathlib.Path | None = None
    """File written by `geometry`: pictures are rectified first. Must be the file that `calibrate` was given."""
    rows: int = 0
    """Of new records: rows of the fields; 0, or more than the pictures have, takes those of the pictures."""
    launcher: Annotated[Launcher, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Launcher)
    config: Annotated[ExtractConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=ExtractConfig)

    def run(self) -> int:
        calibration = None if self.calibration is None else Calibration.load(self.calibration)
        if calibration is not None and calibration.sensor != self.sensor:
            raise CalibrationError(
                f"{self.calibration} is for {calibration.sensor!r}, not {self.sensor!r}: must be equal; set --sensor"
            )
        for records in (path for path in self.inputs if (path / INDEX).exists()):
            if self.out.resolve().is_relative_to(records.resolve()):
                raise SourceError(
                    f"--out is {self.out}: lies in the folder of the records, which holds nothing else; name a path "
                    "outside"
                )
        if self.out.suffix == ".npz":
            return self._to_file(calibration)
        return self._to_records(calibration)

    def _to_records(self, calibration: Calibration | None) -> int:
        """New records, with both pictures and fields."""
        if len(self.inputs) != 1 or not (self.inputs[0] / INDEX).exists():
            raise SourceError(
                f"--out is {self.out}: must end in .npz unless the input is one directory of records; correct it"
            )
        if self.geometry is not None:
            raise SourceError(
                f"--geometry is {self.geometry}: pictures of records are stored as they are; extract to an .npz"
            )
        background = None if self.background is None else read_picture(self.background)
        job = FieldsJob(
            records=self.inputs[0].absolute(),
            sensor=self.sensor,
            gel=RestGel(background=background, rest_frames=self.rest_frames, mm_per_px=self.mm_per_px),
            calibration=calibration,
            config=self.config,
            rows=self.rows,
        )
        with progress_bar("contacts") as progress:
            skipped = write_extracted(job, self.out, progress=progress, launcher=self.launcher)
        OUT.print(overview.summary_table(RecordStore(self.out)))
        if skipped:
            OUT.print(overview.skip_table(skipped, "not extracted"))
        return 0

    def _to_file(self, calibration: Calibration | None) -> int:
        """Arrays over all frames of all inputs."""
        if self.background is None:
            raise SourceError("--background is not given: must be a picture of the gel at rest; take one")
        if self.rest_frames or self.rows or not self.launcher.here:
            raise SourceError(
                f"--rest-frames, --rows and --launcher are of records, --out is {self.out}: must be a directory for "
                "them; leave them out"
            )
        rest = read_picture(self.background)
        straight = self._straightening(calibration, (rest.shape[0], rest.shape[1]))
        extractor = Extractor(straight(rest), straight.mm_per_px, calibration, self.config)
        pictures = read_pictures(self.inputs, self.sensor, self.config.quality)
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
