"""What do the fields look like on every sensor whose pictures are published?

    python -m experiments real_sensors --data-dir DIR [--scale smoke]

Each folder of ball presses in DIR is calibrated by itself, without labels and with one setting, and the fields of some
of its pictures are drawn: change of colour, depth, contact, and deformation where the gel has markers.  For a folder
that cannot be calibrated the report gives the reason.  Eight minutes on a shared core (`smoke` takes the first folder
only, half a minute).  Expected: the marker-less Minis calibrate to about ten micrometres, marker gels to some tens;
with too few presses, no ball or no zero level depth is refused or flagged, not guessed.
"""

import dataclasses
import pathlib
import time

import numpy as np

from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Cell, Picture, Results, named_table
from experiments.core.runner import Experiment
from experiments.fields.field_drawings import DrawnFields, field_rows
from experiments.fields.published import FOLDERS, RecordingFolder, read_folder
from sensors_io.calibration.calibrate import CalibrateConfig, calibrate
from sensors_io.calibration.presses import BallPresses
from sensors_io.fields.extract import Extractor
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.schema import Flag


@dataclasses.dataclass(frozen=True, kw_only=True)
class RealConfig:
    """Folders to read.

    Args:
      data_dir: the folder of recordings.
      folders: at most so many of them.
      shown: pictures drawn of each.
      folds: of the held-out errors.
    """

    data_dir: pathlib.Path | None = None
    folders: int = 99
    shown: int = 5
    folds: int = 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class FolderReport:
    """One folder: its row of figures, the remark of the calibration, a picture of fields."""

    row: dict[str, Cell]
    note: str
    picture: Picture


HELD_OUT = {
    "depth rmse": "depth rmse median, um",
    "radius error": "radius error median, %",
    "tip depth": "tip depth median, mm",
}
"""Column → figure of a calibration on the presses left out of it."""


def run(config: RealConfig, context: Context) -> Results:
    """Calibrate each folder, extract, draw."""
    if config.data_dir is None:
        raise ConfigurationError("data_dir is None: must be the folder of recordings; give --data-dir")
    reports = []
    there = [name for name, folder in FOLDERS.items() if (config.data_dir / folder.path).is_dir()][: config.folders]
    for name in context.each("folders", there):
        context.print(name)
        reports.append(folder_report(name, FOLDERS[name], config.data_dir, config))
    if not reports:
        known = ", ".join(folder.path for folder in FOLDERS.values())
        raise FileNotFoundError(f"data_dir is {config.data_dir}: must hold one of {known}; correct it")
    made = sum(report.row["depth rmse"] is not None for report in reports)
    table = named_table(
        "Every folder, calibrated by itself",
        [report.row for report in reports],
        formats=dict.fromkeys(("pictures", "no contact", "no zero level"), "d")
        | {"depth rmse": ".1f", "radius error": ".1f", "tip depth": ".2f", "all fields": ".0f"},
        units={"depth rmse": "µm", "radius error": "%", "tip depth": "mm", "all fields": "Hz"},
        meanings={
            "depth rmse": "held out, median over presses",
            "no contact": "pictures flagged so",
            "no zero level": "pictures flagged so: absolute depth is unknown, that of the tip too",
        },
    )
    notes = [{"folder": report.row["folder"], "note": report.note} for report in reports]
    return Results(
        verdict=(f"{made} of {len(reports)} folders calibrate with one setting; the notes give the others' reasons.",),
        tables=(table, named_table("What the calibration says", notes)),
        pictures=tuple(report.picture for report in reports),
    )


def folder_report(name: str, folder: RecordingFolder, root: pathlib.Path, config: RealConfig) -> FolderReport:
    """Calibrate one folder, extract the fields of its pictures and draw some of them."""
    frames, names, background = read_folder(folder, root)
    made, held_out, note = _calibrated(folder, frames, names, background, config.folds)
    extractor = Extractor(background, folder.mm_per_px, made)
    began = time.perf_counter()
    fields = extractor.extract(frames)
    hz = len(frames) / (time.perf_counter() - began)
    rejected, floating = (
        int(np.count_nonzero(fields.flags & np.uint32(f))) for f in (Flag.NO_CONTACT, Flag.NO_ZERO_LEVEL)
    )
    row: dict[str, Cell] = {"folder": name, "gel": extractor.evidence.pattern.value, "pictures": len(frames)}
    row |= held_out | {"no contact": rejected, "no zero level": floating, "all fields": hz}
    chosen = np.linspace(0, len(frames) - 1, min(config.shown, len(frames))).round().astype(int)
    drawn = [_drawn(fields, frames, background, int(i), names[i]) for i in chosen]
    picture = Picture(
        name=name.replace(",", "").replace(" ", "-"),
        title=name,
        caption=". ".join(s for s in (folder.remark, *extractor.refused) if s)
        or "Change of colour, depth, contact, deformation.",
        content=field_rows(drawn, folder.mm_per_px),
        kind="png",
    )
    return FolderReport(row=row, note=note, picture=picture)


def _calibrated(
    folder: RecordingFolder, frames: np.ndarray, names: tuple[str, ...], background: np.ndarray, folds: int
) -> tuple[Calibration | None, dict[str, Cell], str]:
    """The folder's calibration, its held-out figures, and what the user must know of it."""
    nothing: dict[str, Cell] = dict.fromkeys(HELD_OUT)
    if folder.ball_diameter_mm is None:
        return None, nothing, "no ball of known diameter"
    try:
        presses = BallPresses(
            pictures=frames, background=background, radius_mm=folder.ball_diameter_mm / 2, mm_per_px=folder.mm_per_px
        )
        made, report = calibrate(presses, names, "gelsight_mini", CalibrateConfig(folds=folds))
    except CalibrationError as refusal:
        return None, nothing, str(refusal).splitlines()[0]
    figures = report.errors.figures()
    cells: dict[str, Cell] = {column: figures[key] for column, key in HELD_OUT.items()}
    return made, cells, f"{len(report.left_out)} presses left out"


def _drawn(fields: Fields, frames: np.ndarray, background: np.ndarray, i: int, name: str) -> DrawnFields:
    arrays = {key: None if array is None else array[i] for key, array in fields.arrays().items()}
    flags = Flag(int(fields.flags[i])) & ~Flag.REFUSED
    return DrawnFields(
        name=name,
        change=np.clip(128 + (frames[i].astype(np.int16) - background), 0, 255).astype(np.uint8),
        depth_mm=arrays["depth_mm"],
        contact=fields.contact[i],
        deformation_mm=arrays["deformation_mm"],
        flags=", ".join(str(f.name).lower().replace("_", " ") for f in Flag if f & flags) or "no flag",
    )


EXPERIMENT = Experiment(
    name="real_sensors", config=RealConfig(), run=run, scales={"smoke": RealConfig(folders=1, shown=3, folds=2)}
)
