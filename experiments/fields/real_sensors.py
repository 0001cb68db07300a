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
import textwrap
import time
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import ndimage

from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.look import LOOK, PALETTE, png
from experiments.core.results import Cell, Picture, Results, named_table
from experiments.core.runner import Experiment
from sensors_io.calibration.calibrate import CalibrateConfig, calibrate
from sensors_io.calibration.presses import BallPresses
from sensors_io.calibration.published import FOLDERS, RecordingFolder, read_folder
from sensors_io.fields.extract import Extractor
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.schema import Flag


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

_FLAGS = 42  # letters of a line of flags


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
    picture = Picture(
        name=name.replace(",", "").replace(" ", "-"),
        title=name,
        caption=". ".join(s for s in (folder.remark, *extractor.refused) if s)
        or "Change of colour, depth, contact, deformation.",
        content=field_rows(fields, chosen, [names[i] for i in chosen], changes),
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


def field_rows(fields: Fields, chosen: np.ndarray, names: Sequence[str], changes: np.ndarray) -> bytes:
    """A PNG of one row a chosen picture: `changes` of colour, depth, its profile, deformation.

    `fields` are those of all pictures; `names` and `changes`, uint8 [n, H, W, 3], of the chosen ones alone.
    """
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(11, 2.2 * len(chosen) + 0.3), dpi=110, layout="constrained")
        grid = figure.subplots(len(chosen), 4, squeeze=False)
        for (seen, depth, profile, moved), i, name, change in zip(grid, chosen, names, changes, strict=True):
            flags = Flag(int(fields.flags[i])) & ~Flag.REFUSED
            words = ", ".join(str(f.name).lower().replace("_", " ") for f in Flag if f & flags) or "no flag"
            seen.imshow(change)
            seen.set_title("\n".join((name, *textwrap.wrap(words, _FLAGS))), fontsize=7, loc="left")
            seen.set_axis_off()
            contact, pitch = fields.contact[i], fields.mm_per_px
            height, width = (n * pitch for n in contact.shape)
            _draw_depth(depth, None if fields.depth_mm is None else fields.depth_mm[i], contact, (width, height))
            _draw_profile(profile, None if fields.depth_mm is None else fields.depth_mm[i], contact, pitch)
            _draw_motion(moved, None if fields.deformation_mm is None else fields.deformation_mm[i], (width, height))
        return png(figure)


def _draw_depth(axes: Axes, depth_mm: np.ndarray | None, contact: np.ndarray, size_mm: tuple[float, float]) -> None:
    window = (0, size_mm[0], size_mm[1], 0)
    if depth_mm is None:
        axes.imshow(contact, cmap="Greys", extent=window)
        axes.set_title("contact, by colour", fontsize=7)
    else:
        axes.figure.colorbar(axes.imshow(depth_mm, cmap="cividis", vmin=0, extent=window), ax=axes)
        axes.set_title("depth, mm", fontsize=7)
    if contact.any() and not contact.all():
        x, y = (np.linspace(0, side, n) for side, n in zip(size_mm, contact.shape[::-1], strict=True))
        axes.contour(x, y, contact, [0.5], colors="w", linewidths=0.8)
    axes.grid(False)


def _draw_profile(axes: Axes, depth_mm: np.ndarray | None, contact: np.ndarray, mm_per_px: float) -> None:
    """Depth along the row and the column of the deepest pixel, where possible of a contact inside the picture."""
    if depth_mm is None:
        axes.set_axis_off()
        return
    labels, _ = ndimage.label(contact)
    at_border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    inner = contact & ~np.isin(labels, at_border)
    y, x = np.unravel_index(int(np.where(inner | ~inner.any(), depth_mm, -np.inf).argmax()), depth_mm.shape)
    for values, label in ((depth_mm[y], "along x"), (depth_mm[:, x], "along y")):
        axes.plot(np.arange(len(values)) * mm_per_px, values, lw=1, label=label)
    axes.set(xlabel="mm", ylabel="depth, mm")
    axes.legend(fontsize=7)


def _draw_motion(axes: Axes, moved_mm: np.ndarray | None, size_mm: tuple[float, float]) -> None:
    if moved_mm is None:
        axes.text(0.5, 0.5, "no markers:\nrefused", ha="center", va="center", fontsize=8, transform=axes.transAxes)
        axes.set_axis_off()
        return
    width, height = size_mm
    x, y = ((np.arange(n) + 0.5) / n * side for n, side in zip(moved_mm.shape[1::-1], size_mm, strict=True))
    axes.quiver(x, y, moved_mm[..., 0], moved_mm[..., 1], angles="xy", color=PALETTE[0])
    axes.set(aspect="equal", xlim=(0, width), ylim=(height, 0))
    axes.set_title(f"greatest {np.hypot(*np.moveaxis(moved_mm, -1, 0)).max():.2f} mm", fontsize=7)


EXPERIMENT = Experiment(
    name="real_sensors", config=RealConfig(), run=run, scales={"smoke": RealConfig(folders=1, shown=3, folds=2)}
)
