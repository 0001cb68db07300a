"""What do the fields look like on every sensor whose pictures are published?

    python -m experiments real_sensors --data-dir DIR [--scale smoke]

Each folder of ball presses in DIR is calibrated by itself, without labels and with one setting, and the fields of some
of its pictures are drawn: change of colour, depth, contact, and deformation where the gel has markers.  For a folder
that cannot be calibrated the report gives the reason.  Eight minutes on a shared core (`smoke` takes the first folder
only, half a minute).  Expected: the marker-less Minis calibrate to about ten micrometres, marker gels to some tens;
with too few presses, no ball or no zero level depth is refused or flagged, not guessed.
"""

import dataclasses
import itertools
import pathlib
import textwrap
import time

import numpy as np

from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.pictures import image_grid
from experiments.core.results import Cell, Picture, Results, named_table
from experiments.core.runner import Experiment
from sensors_io.calibration.calibrate import CalibrateConfig, calibrate
from sensors_io.calibration.presses import BallPresses
from sensors_io.calibration.published import FOLDERS, RecordingFolder, read_folder
from sensors_io.fields.extract import Extractor
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.schema import Flag
from sensors_io.viewer.panels import arrows, coloured, outlined, with_bar


@dataclasses.dataclass(frozen=True, kw_only=True)
class RealConfig:
    """Folders to read."""

    data_dir: pathlib.Path | None = None  # the folder of recordings
    folders: int = 99  # at most so many of them
    shown: int = 5  # pictures drawn of each
    folds: int = 5  # of the held-out errors


HELD_OUT = {
    "depth rmse": "depth rmse median, um",
    "radius error": "radius error median, %",
    "tip depth": "tip depth median, mm",
}
"""Column → figure of a calibration on the presses left out of it."""

LETTERS = 18  # of a line next to the pictures


def run(config: RealConfig, context: Context) -> Results:
    """Calibrate each folder, extract, draw."""
    if config.data_dir is None:
        raise ConfigurationError("data_dir is None: must be the folder of recordings; give --data-dir")
    rows, notes, pictures = [], [], []
    there = [name for name, folder in FOLDERS.items() if (config.data_dir / folder.path).is_dir()][: config.folders]
    for name in context.each("folders", there):
        context.print(name)
        row, note, picture = folder_report(name, FOLDERS[name], config.data_dir, config)
        rows.append(row)
        notes.append({"folder": name, "note": note})
        pictures.append(picture)
    if not rows:
        known = ", ".join(folder.path for folder in FOLDERS.values())
        raise FileNotFoundError(f"data_dir is {config.data_dir}: must hold one of {known}; correct it")
    table = named_table(
        "Every folder, calibrated by itself",
        rows,
        formats=dict.fromkeys(("pictures", "no contact", "no zero level"), "d")
        | {"depth rmse": ".1f", "radius error": ".1f", "tip depth": ".2f", "all fields": ".0f"},
        units={"depth rmse": "µm", "radius error": "%", "tip depth": "mm", "all fields": "Hz"},
        meanings={
            "depth rmse": "held out, median over presses",
            "no contact": "pictures flagged so",
            "no zero level": "pictures flagged so: absolute depth is unknown, that of the tip too",
        },
    )
    made = sum(row["depth rmse"] is not None for row in rows)
    return Results(
        verdict=(f"{made} of {len(rows)} folders calibrate with one setting; the notes give the others' reasons.",),
        tables=(table, named_table("What the calibration says", notes)),
        pictures=tuple(pictures),
    )


def folder_report(
    name: str, folder: RecordingFolder, root: pathlib.Path, config: RealConfig
) -> tuple[dict[str, Cell], str, Picture]:
    """Calibrate one folder and extract its fields; its row of figures, the calibration's remark, a picture."""
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
    changes = np.clip(128 + (frames[chosen].astype(np.int16) - background), 0, 255).astype(np.uint8)
    rows = {
        row_name(names[i], int(fields.flags[i])): field_pictures(fields, i, change)
        for i, change in zip(chosen, changes, strict=True)
    }
    picture = Picture(
        name=name.replace(",", "").replace(" ", "-"),
        title=name,
        caption=". ".join(s for s in (folder.remark, *extractor.refused) if s),
        content=image_grid(rows, ("change, contact", "depth", "deformation"), cell_inch=2.2),
        kind="png",
    )
    return row, note, picture


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
    return made, {column: figures[key] for column, key in HELD_OUT.items()}, f"{len(report.left_out)} presses left out"


def field_pictures(fields: Fields, i: int, change: np.ndarray) -> list[np.ndarray]:
    """Change of colour with the contact outlined, depth and deformation of picture i; white where there is none."""
    shown = [outlined(change, fields.contact[i])]
    for field, draw in ((fields.depth_mm, coloured), (fields.deformation_mm, arrows)):
        if field is None:
            shown.append(np.full((1, 1, 3), 255, np.uint8))
            continue
        size = field[i] if field.ndim == 3 else np.linalg.norm(field[i], axis=-1)
        top_mm = float(f"{max(float(np.nanmax(size)), 0.01):.2g}")
        shown.append(with_bar(draw(field[i], top_mm), top_mm))
    return shown


def row_name(name: str, flags: int) -> str:
    """The name of a picture and its flags, but for those that say what is refused in all pictures."""
    words = [str(f.name).lower().replace("_", " ") for f in Flag if f & flags & ~Flag.REFUSED]
    lines = (textwrap.wrap(part, LETTERS) for part in (name, ", ".join(words) or "no flag"))
    return "\n".join(itertools.chain(*lines))


EXPERIMENT = Experiment(
    name="real_sensors", config=RealConfig(), run=run, scales={"smoke": RealConfig(folders=1, shown=3, folds=2)}
)
