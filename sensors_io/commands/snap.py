"""`python -m sensors_io snap`."""

import contextlib
import dataclasses
import functools
import pathlib
import re
from typing import Annotated

import cv2
import numpy as np
import tyro

from sensors_io.calibration.guide import Guidance, GuideConfig, PressGuide, drawn
from sensors_io.commands.choices import Bench, opened, stop_on_interrupt
from sensors_io.commands.console import OUT
from sensors_io.devices.base import Device
from sensors_io.devices.errors import DeviceDataError, DeviceNotFoundError, DeviceTimeoutError, StreamEndedError
from sensors_io.fields.sources import read_picture
from sensors_io.fields.types import CalibrationError
from sensors_io.index import INDEX
from sensors_io.json_files import write_whole
from sensors_io.locks import write_lock
from sensors_io.viewer.server import LiveView, Numbers

_TIMEOUT_S = 2.0  # for one frame


@dataclasses.dataclass(frozen=True, kw_only=True)
class Snap(Bench):
    """Take the pictures that `calibrate` needs, with guidance: the gel at rest, then presses of a ball all over it.

    Open the printed address: the page shows the circle found, what the presses cover, and where to press next.
    After an interruption the same command resumes with the presses that it has.
    """

    out: pathlib.Path
    """Folder to write: background.png and presses/."""
    ball_diameter_mm: float
    """Diameter of the ball."""
    mm_per_px: float | None = None
    """Millimetres per pixel, where the device does not state them."""
    port: int = 8765
    """Port of the page."""
    config: Annotated[GuideConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=GuideConfig)

    def run(self) -> int:
        if self.more:
            raise DeviceNotFoundError("snap takes one camera: leave the others out")
        with contextlib.ExitStack() as stack:
            stop = stack.enter_context(stop_on_interrupt())
            device = stack.enter_context(opened(self.device))
            pitch = device.identity.mm_per_px if self.mm_per_px is None else self.mm_per_px
            if pitch is None or not 0 < pitch < 1 or self.ball_diameter_mm <= 0:
                raise CalibrationError(
                    f"mm_per_px is {pitch}, ball_diameter_mm {self.ball_diameter_mm:g}: must lie in (0, 1) and be > 0; "
                    "measure them (mm_per_px: width of the gel that the picture shows over its pixels)"
                )
            if (self.out / INDEX).exists():
                raise CalibrationError(f"--out is {self.out}: holds records, and nothing else may; name another folder")
            self.out.mkdir(parents=True, exist_ok=True)
            stack.enter_context(write_lock(self.out))
            live = stack.enter_context(LiveView(port=self.port))
            OUT.print(f"guidance at {live.address}, Ctrl-C ends", highlight=False)
            guide, shown, ended, broken = self._guide(pitch), "", "", 0
            while not stop.is_set() and not guide.done:
                try:
                    sample = device.read(_TIMEOUT_S)
                except DeviceTimeoutError:
                    continue
                except DeviceDataError:
                    broken += 1
                    continue
                except StreamEndedError as end:
                    ended = str(end)
                    OUT.print(ended, markup=False)
                    break
                if sample.frame is None or sample.frame.ndim != 3:
                    raise DeviceNotFoundError(f"{device.identity.sensor} gives no pictures: snap needs a camera")
                guidance = self._see(guide, sample.frame)
                self._show(live, device, guide, sample.frame, guidance)
                if guidance.prompt.partition(",")[0] != shown:
                    shown = guidance.prompt.partition(",")[0]
                    OUT.print(guidance.prompt, markup=False, highlight=False)
        if broken:
            OUT.print(f"{broken} broken samples were left out", highlight=False)
        self._close(guide, pitch)
        if ended and not guide.touches:
            raise StreamEndedError(f"{ended}, before a press was taken; replay a longer recording")
        return 0

    @property
    def _background(self) -> pathlib.Path:
        return self.out / "background.png"

    def _guide(self, pitch: float) -> PressGuide:
        """A guide, with the presses of an earlier run."""
        if not self._background.exists():
            return PressGuide(self.ball_diameter_mm / 2, pitch, self.config)
        guide = PressGuide(self.ball_diameter_mm / 2, pitch, self.config, read_picture(self._background))
        for path in sorted((self.out / "presses").glob("*.png")):
            press = read_picture(path)
            self._require_size(guide, press, str(path))
            guide.resume(press)
        return guide

    def _require_size(self, guide: PressGuide, picture: np.ndarray, of: str) -> None:
        """Refuse a picture of another size than that of the gel at rest."""
        if guide.background is not None and picture.shape != guide.background.shape:
            (height, width), (rows, columns) = guide.background.shape[:2], picture.shape[:2]
            raise CalibrationError(
                f"{of} is {columns} × {rows}, {self._background} {width} × {height}: must be equal; give the camera "
                "that size again, or choose another --out"
            )

    def _see(self, guide: PressGuide, frame: np.ndarray) -> Guidance:
        """One frame; what it completes is written."""
        self._require_size(guide, frame, "the camera's picture")
        resting = guide.background is None
        guidance = guide.look(frame)
        if resting and guide.background is not None:
            _write(self._background, guide.background)
        if guidance.taken is not None:
            _write(_free(self.out / "presses"), guidance.taken)
        return guidance

    def _show(self, live: LiveView, device: Device, guide: PressGuide, frame: np.ndarray, guidance: Guidance) -> None:
        seen = guide.coverage((frame.shape[0], frame.shape[1]))
        table = {"presses": f"{len(guide.touches)} of {self.config.presses}", "covered": f"{seen.share:.0%}"}
        numbers = Numbers(
            title=device.identity.sensor,
            time_s=0.0,
            force_n=None,
            tables={"calibration": table},
            captions={"camera": "green: covered; cross: press here next; circle: the contact found"},
            alarm="",
            prompt=guidance.prompt,
        )
        live.publish({"camera": functools.partial(drawn, frame, guidance, seen)}, numbers)

    def _close(self, guide: PressGuide, pitch: float) -> None:
        """Say what there is and what to do with it."""
        OUT.print(f"{len(guide.touches)} of {self.config.presses} presses in {self.out / 'presses'}", highlight=False)
        if guide.touches:
            OUT.print(
                f"next: python -m sensors_io calibrate {self.out / 'presses'} --background {self._background} "
                f"--ball-diameter-mm {self.ball_diameter_mm:g} --mm-per-px {pitch:g} --out {self.out / 'cal.npz'}",
                highlight=False,
                soft_wrap=True,
            )


def _free(folder: pathlib.Path) -> pathlib.Path:
    """Path of the next press: past all that are there, of which some may have been removed."""
    found = (re.fullmatch(r"press_(\d+)", path.stem) for path in folder.glob("*.png"))
    return folder / f"press_{max((int(one[1]) for one in found if one), default=0) + 1:03d}.png"


def _write(path: pathlib.Path, picture: np.ndarray) -> None:
    """A picture, RGB, as PNG, whole or not at all.

    Raises:
      OSError: it cannot be written.
    """
    _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    write_whole(path, data.tobytes())
