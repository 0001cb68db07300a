"""`python -m sensors_io calibrate`."""

import dataclasses
import pathlib
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from sensors_io.calibration.calibrate import CalibrateConfig, CalibrationReport, calibrate
from sensors_io.calibration.presses import BallPresses
from sensors_io.calibration.scale import measure_scale
from sensors_io.commands.console import OUT, progress_bar
from sensors_io.commands.straightening import Straightening
from sensors_io.fields.sources import PictureSequence, read_picture, read_pictures
from sensors_io.fields.types import Calibration, CalibrationError
from sensors_io.layer import Layer

_POISSON = 0.48  # of silicone, nearly incompressible


@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Fit the map from colour to slope from pictures of a ball pressed into the gel; print its error on unseen presses.

    Press one rigid ball a dozen times or more, all over the window, and take one picture of the gel at rest.
    """

    balls: tyro.conf.Positional[tuple[pathlib.Path, ...]]
    """Pictures of presses, or folders or videos of them."""
    background: pathlib.Path
    """Picture of the gel at rest."""
    ball_diameter_mm: float
    """Diameter of the ball."""
    out: pathlib.Path
    """Calibration file to write."""
    mm_per_px: float | None = None
    """Millimetres per pixel; not needed if a geometry or the press depths are given."""
    press_depths_mm: tuple[float, ...] = ()
    """Depth of the ball below first contact in each picture, in their order, or one depth for all; millimetres per
    pixel are then measured from the size of the contacts."""
    gel_thickness_mm: float = 4.5
    """Thickness of the soft layer, which determines the size of a contact at a given depth."""
    geometry: pathlib.Path | None = None
    """File written by `geometry`: pictures are rectified first. Give the same file to `extract`."""
    sensor: str = "gelsight_mini"
    """Name of the sensor."""
    config: Annotated[CalibrateConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=CalibrateConfig)

    def run(self) -> int:
        background = read_picture(self.background)
        pictures = _without(read_pictures(self.balls, self.sensor), background)
        pitch = self._measured_mm_per_px(pictures, background) if self.press_depths_mm else self.mm_per_px
        straight = Straightening.of(self.geometry, pitch, (background.shape[0], background.shape[1]))
        presses = BallPresses(
            pictures=np.stack([straight(frame) for frame in pictures.frames]),
            background=straight(background),
            radius_mm=self.ball_diameter_mm / 2,
            mm_per_px=straight.mm_per_px,
        )
        OUT.print(f"{len(presses)} pictures; finding circles, fitting, leaving parts out in turn …")
        with progress_bar("fits") as progress:
            made, report = calibrate(presses, pictures.names, self.sensor, self.config, progress)
        made = straight.signed(made)
        made.save(self.out)
        OUT.print(report_table(made, report))
        OUT.print(f"wrote {self.out}, hash {made.hash}", highlight=False)
        return 0

    def _measured_mm_per_px(self, pictures: PictureSequence, background: np.ndarray) -> float:
        """The pitch by which the contacts are as large as the ball makes them at the known depths."""
        if self.mm_per_px is not None or self.geometry is not None:
            raise CalibrationError(
                "press_depths_mm is given together with mm_per_px or geometry: must be alone, since it measures the "
                "pitch; leave one of them out"
            )
        depths = self.press_depths_mm * (len(pictures) if len(self.press_depths_mm) == 1 else 1)
        if len(depths) != len(pictures):
            raise CalibrationError(
                f"press_depths_mm has {len(depths)} depths: must have one, or one for each of {len(pictures)} pictures "
                f"({pictures.names[0]} … {pictures.names[-1]}); complete it"
            )
        if not self.gel_thickness_mm > 0:
            raise CalibrationError(f"gel_thickness_mm is {self.gel_thickness_mm}: must be > 0; measure it")
        gel = Layer(modulus_mpa=1.0, poisson=_POISSON, thickness_mm=self.gel_thickness_mm)
        scale, _ = measure_scale(
            pictures.frames, background, np.array(depths), ball_diameter_mm=self.ball_diameter_mm, gel=gel
        )
        OUT.print(
            f"{scale.mm_per_px:.5f} ± {scale.error:.5f} mm/px by {len(depths)} presses to known depth", highlight=False
        )
        return scale.mm_per_px


def report_table(made: Calibration, report: CalibrationReport) -> Table:
    """Table of the fit, its errors, and the presses left out with the reasons."""
    table = Table("what", "figure or reason", title=f"calibration of {made.sensor}")
    table.add_row("presses used", str(len(report.kept)))
    rows_mm, columns_mm = (side * made.mm_per_px for side in made.background.shape[:2])
    table.add_row("sensing window, mm (measure it)", f"{columns_mm:.1f} × {rows_mm:.1f}")
    contact_mm = float(np.median(report.touches.radius_px)) * made.mm_per_px
    table.add_row("radius of the contacts, mm (median)", f"{contact_mm:.2f}")
    table.add_row("strength of the smoothness prior", f"{report.ridge:.0e}")
    for name, value in report.errors.figures().items():
        table.add_row(f"held out: {name}", f"{value:.3g}")
    for warning in report.warnings:
        table.add_row("warning", warning)
    for press in report.left_out:
        table.add_row(f"left out: {press.name}", press.reason)
    return table


def _without(pictures: PictureSequence, background: np.ndarray) -> PictureSequence:
    """The pictures that are not the background itself, which often lies in the same folder."""
    kept = [i for i, frame in enumerate(pictures.frames) if not np.array_equal(frame, background)]
    return pictures.chosen(np.array(kept, np.int64))
