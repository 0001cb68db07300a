"""`python -m sensors_io view`."""

import contextlib
import dataclasses
import pathlib
import time

from sensors_io.clock import NS_PER_S
from sensors_io.commands.choices import Force, Tactile, opened, stop_on_interrupt
from sensors_io.commands.console import OUT
from sensors_io.devices.background import Background, Drift
from sensors_io.devices.base import Sample
from sensors_io.devices.errors import DeviceTimeoutError, StaleFrameError, StreamEndedError
from sensors_io.devices.intake import Counts
from sensors_io.devices.reader import Reader
from sensors_io.fields.extract import Extractor
from sensors_io.fields.types import Calibration
from sensors_io.importers.pictures import read_picture
from sensors_io.viewer.panels import panels
from sensors_io.viewer.server import LiveView, Numbers

_TOUCH_N = 0.1  # less is no contact, three times the noise of a 6-D sensor
_WAIT_S = 0.5  # for a fresh frame, before Ctrl-C is looked at again


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Show a sensor in the browser: picture, fields, force, losses; until Ctrl-C."""

    device: Tactile
    """The tactile sensor."""
    force: Force = None
    """The force sensor."""
    port: int = 8765
    """Of the page."""
    host: str = "127.0.0.1"
    """0.0.0.0 shows it to the whole network, without any password."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest: fields are then extracted from the camera's frames."""
    calibration: pathlib.Path | None = None
    """Of the colours, from `calibrate`; without one there is no depth."""
    mm_per_px: float = 0.0634
    """Pitch of the frames where no calibration tells it; that of a GelSight Mini at 320 × 240."""
    seconds: float = 0.0
    """> 0 ends after so long."""

    def run(self) -> int:
        with contextlib.ExitStack() as stack:
            stop = stack.enter_context(stop_on_interrupt())
            tactile = stack.enter_context(Reader(opened(self.device)))
            force = None if self.force is None else stack.enter_context(Reader(opened(self.force)))
            live = stack.enter_context(LiveView(port=self.port, host=self.host))
            OUT.print(f"{tactile.identity.sensor} at {live.address}, Ctrl-C ends", highlight=False)
            extractor = self._extractor()
            began_s, background = time.monotonic(), Background()
            while not stop.is_set() and not (self.seconds and time.monotonic() - began_s > self.seconds):
                try:
                    sample = [tactile.next(_WAIT_S), *tactile.drain()][-1]
                except DeviceTimeoutError:
                    continue
                except StreamEndedError:
                    break
                if extractor is not None and sample.frame is not None:
                    sample = with_fields(sample, extractor)
                self._show(live, tactile, force, sample, background)
        return 0

    def _extractor(self) -> Extractor | None:
        if self.background is None:
            return None
        calibration = None if self.calibration is None else Calibration.load(self.calibration)
        pitch = self.mm_per_px if calibration is None else calibration.mm_per_px
        extractor = Extractor(read_picture(self.background), pitch, calibration)
        for reason in extractor.refused:
            OUT.print(f"not shown: {reason}", highlight=False)
        return extractor

    def _show(
        self, live: LiveView, tactile: Reader, force: Reader | None, sample: Sample, background: Background
    ) -> None:
        newtons = _force_of(sample, force)
        if sample.frame is not None and sample.frame.ndim == 3 and newtons is not None:
            background.offer(sample.frame, touched=abs(newtons[2]) >= _TOUCH_N)
        counts = tactile.counts
        live.publish(
            panels(sample),
            Numbers(
                title=f"{tactile.identity.sensor} {tactile.identity.serial}",
                time_s=sample.host_time_ns / NS_PER_S,
                force_n=newtons,
                numbers=_listed(counts, background.drift(), newtons),
                alarm="" if not tactile.overloaded else "overload: frames are lost",
            ),
        )


def with_fields(sample: Sample, extractor: Extractor) -> Sample:
    """The sample with the fields of its picture among its arrays, those that the sensor tells itself left alone."""
    assert sample.frame is not None
    fields = extractor.read(sample.frame).arrays()
    found = {name: a[0] for name, a in fields.items() if a is not None and name != "flags"}
    return dataclasses.replace(sample, arrays=found | dict(sample.arrays))


def _force_of(sample: Sample, force: Reader | None) -> tuple[float, float, float] | None:
    arrays = sample.arrays
    if force is not None:
        try:
            arrays = force.latest(_WAIT_S).arrays
        except StaleFrameError:
            return None
    if "force_n" not in arrays:
        return None
    x, y, z = map(float, arrays["force_n"])
    return x, y, z


def _listed(counts: Counts, drift: Drift | None, newtons: tuple[float, float, float] | None) -> dict[str, str]:
    listed = {
        "frames": str(counts.arrived),
        "missing": str(counts.missing),
        "twice": str(counts.duplicates),
        "disconnects": str(counts.disconnects),
    }
    if newtons is not None:
        listed["normal force"] = f"{-newtons[2]:.2f} N"
    if drift is not None:
        listed["background drift"] = f"{drift.rms:.2f} grey levels"
    return listed
