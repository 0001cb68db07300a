"""What do the fields look like on every sensor whose pictures are published?

    python -m experiments real_sensors --data-dir DIR [--scale smoke]

Each folder of ball presses in DIR is calibrated by itself, with no labels and one setting, and the fields of some of
its pictures are drawn: change of colour, depth, contact, deformation where the gel has markers.  A folder that cannot
be calibrated says why.  Eight minutes on a core that others share (`smoke` takes the first folder only, half a minute).
Expected: the marker-less Minis calibrate to ten micrometres or so, marker gels to some tens; what has too few presses,
no ball or no zero level is refused depth or flagged, not guessed.
"""

import dataclasses
import pathlib
import time

import numpy as np

from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Cell, Column, Picture, Results, Table
from experiments.core.runner import Experiment
from experiments.fields.field_drawings import DrawnFields, field_rows
from experiments.fields.recording_folders import FOLDERS, RecordingFolder, read_folder
from sensors_io.calibration.calibrate import CalibrateConfig, calibrate
from sensors_io.calibration.presses import BallPresses
from sensors_io.fields.extract import Extractor
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.schema import Flag


@dataclasses.dataclass(frozen=True, kw_only=True)
class RealConfig:
    """What is read.

    Args:
      data_dir: the folders of recordings.
      folders: at most so many of them.
      shown: pictures drawn of each.
      folds: of the held-out errors.
    """

    data_dir: pathlib.Path | None = None
    folders: int = 99
    shown: int = 5
    folds: int = 5


def run(config: RealConfig, context: Context) -> Results:
    """Calibrate each folder, extract, draw."""
    if config.data_dir is None:
        raise ConfigurationError("data_dir is None: must be the folder of recordings; give --data-dir")
    rows: list[tuple[Cell, ...]] = []
    notes: list[tuple[Cell, ...]] = []
    pictures = []
    there = [f for f in FOLDERS if (config.data_dir / f.path).is_dir()][: config.folders]
    for folder in context.each("folders", there):
        context.print(folder.name)
        row, note, picture = study(folder, config.data_dir, config)
        rows.append(row)
        notes.append((folder.name, note))
        pictures.append(picture)
    if not rows:
        known = ", ".join(f.path for f in FOLDERS)
        raise FileNotFoundError(f"data_dir is {config.data_dir}: must hold one of {known}; correct it")
    made = sum(row[3] is not None for row in rows)
    return Results(
        verdict=(f"{made} of {len(rows)} folders calibrate with one setting; the others say why they do not.",),
        tables=(_table(rows), _notes(notes)),
        pictures=tuple(pictures),
    )


def study(folder: RecordingFolder, root: pathlib.Path, config: RealConfig) -> tuple[tuple[Cell, ...], str, Picture]:
    """One folder: a row of figures, what there is to say, and a picture of fields."""
    frames, names, background = read_folder(folder, root)
    made, figures, note = _calibrated(folder, frames, names, background, config.folds)
    extractor = Extractor(background, folder.mm_per_px, made)
    chosen = np.linspace(0, len(frames) - 1, min(config.shown, len(frames))).round().astype(int)
    began = time.perf_counter()
    fields = extractor.extract(frames)
    hz = len(frames) / (time.perf_counter() - began)
    rejected, floating = (
        int(np.count_nonzero(fields.flags & np.uint32(f))) for f in (Flag.NO_CONTACT, Flag.NO_ZERO_LEVEL)
    )
    row = (folder.name, extractor.evidence.pattern.value, len(frames), *figures, rejected, floating, hz)
    drawn = [_row(fields, frames, background, int(i), names[i]) for i in chosen]
    picture = Picture(
        name=folder.name.replace(",", "").replace(" ", "-"),
        title=folder.name,
        caption=". ".join(s for s in (folder.remark, *extractor.refused) if s)
        or "Change of colour, depth, contact, deformation.",
        content=field_rows(drawn, folder.mm_per_px),
        kind="png",
    )
    return row, note, picture


def _calibrated(
    folder: RecordingFolder, frames: np.ndarray, names: tuple[str, ...], background: np.ndarray, folds: int
) -> tuple[Calibration | None, tuple[Cell, ...], str]:
    """The folder's own calibration, its held-out figures, and what there is to say."""
    nothing: tuple[Cell, ...] = (None, None, None)
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
    keys = ("depth rmse median, um", "radius error median, %", "tip depth median, mm")
    return made, tuple(figures[key] for key in keys), f"{len(report.left_out)} presses left out"


def _row(fields: Fields, frames: np.ndarray, background: np.ndarray, i: int, name: str) -> DrawnFields:
    arrays = {key: None if array is None else array[i] for key, array in fields.arrays().items()}
    return DrawnFields(
        name=name,
        change=np.clip(128 + (frames[i].astype(np.int16) - background), 0, 255).astype(np.uint8),
        depth_mm=arrays["depth_mm"],
        contact=fields.contact[i],
        deformation_mm=arrays["deformation_mm"],
        flags=", ".join(_words(Flag(int(fields.flags[i])) & ~Flag.REFUSED)) or "no flag",
    )


def _words(flags: Flag) -> list[str]:
    return [str(f.name).lower().replace("_", " ") for f in Flag if f & flags]


def _notes(rows: list[tuple[Cell, ...]]) -> Table:
    return Table(
        title="What the calibration says", columns=(Column(name="folder"), Column(name="note")), rows=tuple(rows)
    )


def _table(rows: list[tuple[Cell, ...]]) -> Table:
    return Table(
        title="Every folder, calibrated by itself",
        columns=(
            Column(name="folder"),
            Column(name="gel"),
            Column(name="pictures", format="d"),
            Column(name="depth rmse", unit="µm", format=".1f", meaning="held out, median over presses"),
            Column(name="radius error", unit="%", format=".1f"),
            Column(name="tip depth", unit="mm", format=".2f"),
            Column(name="no contact", format="d", meaning="pictures flagged so"),
            Column(
                name="no zero level",
                format="d",
                meaning="pictures whose absolute depth, the tip's too, hangs on nothing",
            ),
            Column(name="all fields", unit="Hz", format=".0f"),
        ),
        rows=tuple(rows),
    )


EXPERIMENT = Experiment(
    name="real_sensors", config=RealConfig(), run=run, scales={"smoke": RealConfig(folders=1, shown=3, folds=2)}
)
