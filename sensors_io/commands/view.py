"""`python -m sensors_io view`."""

import contextlib
import dataclasses
import pathlib
import time

from sensors_io.commands.choices import Bench, readers, stop_on_interrupt
from sensors_io.commands.console import OUT
from sensors_io.commands.extraction import Extraction
from sensors_io.devices.errors import StreamEndedError
from sensors_io.viewer.presenter import Presenter
from sensors_io.viewer.server import LiveView


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(Bench):
    """Show sensors in the browser: pictures, fields, force, rates, losses, flags; until Ctrl-C.

    Devices are joined by a + of its own: view uvc --product "GelSight Mini" + tac3d + netft --host H.
    """

    port: int = 8765
    """Port of the page."""
    host: str = "127.0.0.1"
    """0.0.0.0 shows it to the whole network, to those who know the token in the printed address."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest: fields are then extracted from the first camera's frames."""
    calibration: pathlib.Path | None = None
    """Calibration from `calibrate`; without one, no depth is shown."""
    mm_per_px: float = 0.0634
    """Millimetres per pixel if neither calibration nor device states them; default: a GelSight Mini at 320 × 240."""
    seconds: float = 0.0
    """If > 0, stop after this time."""

    def run(self) -> int:
        parts = self.parts()
        looking = (*parts.tactile, *((parts.view,) if parts.view else ()))
        with contextlib.ExitStack() as stack:
            stop = stack.enter_context(stop_on_interrupt())
            devices = stack.enter_context(readers(looking))
            force = stack.enter_context(readers((parts.force,) if parts.force else ()))
            live = stack.enter_context(LiveView(port=self.port, host=self.host))
            extraction = Extraction(self.background, self.calibration, self.mm_per_px)
            channels = extraction.channels(devices)
            presenter = Presenter(channels, force[0] if force else None, live)
            OUT.print(f"{', '.join(c.name for c in channels)} at {live.address}, Ctrl-C ends", highlight=False)
            end_s = time.monotonic() + self.seconds if self.seconds else float("inf")
            with presenter.in_thread():
                while not stop.is_set() and time.monotonic() < end_s:
                    try:
                        for reader in (*devices, *force):
                            reader.drain()  # what nobody reads in order would count as overwritten
                    except StreamEndedError as end:
                        OUT.print(str(end), markup=False)
                        break
                    stop.wait(_DRAIN_S)
        return 0


_DRAIN_S = 0.1  # a hundredth of what the rings hold
