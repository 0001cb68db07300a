"""`python -m sensors_io record`."""

import contextlib
import dataclasses
import pathlib
import shutil
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import rich.console
import rich.panel
import rich.progress_bar
import rich.table

from sensors_io.commands.choices import Bench, readers, stop_on_interrupt
from sensors_io.commands.console import ERR, OUT, live_display
from sensors_io.commands.extraction import Extraction
from sensors_io.devices.errors import DeviceNotFoundError, StreamEndedError
from sensors_io.devices.reader import Reader
from sensors_io.devices.rgbd import contact_region
from sensors_io.devices.rgbd_camera import RgbdCameraConfig
from sensors_io.force import Mount
from sensors_io.offsets import Offsets
from sensors_io.poses import ForceZero
from sensors_io.recording.book import ATTEMPTS, ObjectView, Report
from sensors_io.recording.coach import CoachConfig
from sensors_io.recording.session import SessionConfig, Status, record_session
from sensors_io.viewer.presenter import Presenter
from sensors_io.viewer.server import LiveView

_VIEW_WAIT_S = 10.0  # for the first colour and depth pair of an RGB-D camera


@dataclasses.dataclass(frozen=True, kw_only=True)
class MountConfig:
    """Mounting of the first sensor's gel on the force sensor.

    Args:
      turn_deg: turns the force sensor's axes into the gel's (x right, y down, z out of the gel): about x, then y, then
        z, all of them fixed.
      offset_mm: from the force sensor's origin to the centre of the window, in the force sensor's frame.
      sign: 1 where the sensor reads the force on what is mounted on it, −1 where it reads the reaction.
    """

    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sign: int = 1

    def mount(self) -> Mount:
        """The mount, R = Rz Ry Rx."""
        x, y, z = np.deg2rad(self.turn_deg)
        about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
        return Mount(rotation=about_z @ about_y @ about_x, offset_mm=np.array(self.offset_mm), sign=self.sign)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record(Bench):
    """Record one object by protocol: a press to 20 N, then six motions at 2, 5 and 10 N, led by the live force.

    Devices are joined by a + of its own: record --out R --object-id cup uvc --serial S + tac3d + netft --host H.  All
    tactile sensors are recorded at once, into one contact each time; the force sensor carries the first of them.  Stop
    with Ctrl-C and start again: what is complete is not asked for again, and a killed session loses at most the frame
    in flight.
    """

    out: pathlib.Path
    """Directory of the records."""
    object_id: str
    """Identifier of the object; `label` adds its labels later."""
    site: int = 0
    """Number of the place on the object."""
    free_s: float = 0.0
    """If > 0, record free motion for this many seconds instead of the protocol."""
    gravity: pathlib.Path | None = None
    """Bias and dead weight from `force-zero` (JSON); without it, force readings are stored uncorrected."""
    sync: pathlib.Path | None = None
    """Delays of the sensors from `sync` (JSON); without it, timestamps are stored uncorrected."""
    mount: MountConfig = dataclasses.field(default_factory=MountConfig)
    """Mounting of the gel on the force sensor."""
    contact_mm: tuple[float, float, float] | None = None
    """Centre of the contact in the frame of the RGB-D camera (X right, Y down, Z forward); stores its image region."""
    window_mm: float = 20.0
    """Side of the sensing window; used with `--contact-mm`."""
    licence: str = "all rights reserved"
    """Licence of the recordings."""
    coach: CoachConfig = dataclasses.field(default_factory=CoachConfig)
    """Thresholds of force and time."""
    port: int | None = None
    """Port of a live view in the browser; without one, only the terminal shows the recording."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest; enables fields in the live view."""
    calibration: pathlib.Path | None = None
    """Calibration from `calibrate`; enables depth in the live view."""

    def run(self) -> int:
        parts = self.parts()
        parts.require_tactile()
        if self.contact_mm is not None and parts.view is None:
            raise DeviceNotFoundError(
                f"contact_mm is {self.contact_mm}: no RGB-D camera is named to see it; add + rgbd …, or leave it out"
            )
        offsets = None if self.sync is None else Offsets.load(self.sync)
        config = self.session(offsets)
        _warn_of_little_disk(self.out)
        with contextlib.ExitStack() as stack:
            stop = stack.enter_context(stop_on_interrupt())
            tactile = stack.enter_context(readers(parts.tactile))
            force = stack.enter_context(readers((parts.force,) if parts.force else ()))
            if offsets is not None:
                offsets.require([device.identity.sensor for device in (*tactile, *force)], self.sync)
            view = None if parts.view is None else self.look(parts.view)
            board = _Board()
            show = stack.enter_context(board.shown())
            if self.port is not None:
                stack.enter_context(self._live_view(tactile, force, board))
            report = record_session(
                self.out, config, tactile, force[0] if force else None, show=show, view=view, stop=stop.is_set
            )
        OUT.print(f"{report.contacts} contacts written, {report.recovered} recovered, {report.incomplete} incomplete")
        _tell_losses(self.object_id, report)
        if report.given_up:
            stages = ", ".join(report.given_up)
            OUT.print(f"given up after {ATTEMPTS} attempts: {stages}; name another --site", soft_wrap=True)
        elif not report.contacts and not stop.is_set():
            OUT.print(
                f"nothing was missing: {self.object_id}, site {self.site} is complete; name another --site",
                markup=False,
            )
        if report.ended:
            asked = f"{self.free_s:g} s of free motion" if self.free_s > 0 else f"all {len(config.stages)} contacts"
            raise StreamEndedError(
                f"{report.ended}, before {asked} were complete: what there was is in {self.out}; replay a longer "
                "recording, or repeat it with --seconds"
            )
        return 0

    def session(self, offsets: Offsets | None) -> SessionConfig:
        """Configuration of the recording, with everything that was measured beforehand."""
        zero = None if self.gravity is None else ForceZero.load(self.gravity)
        given: dict[str, Any] = {} if zero is None else {"gravity": zero.model, "down": zero.down}
        return SessionConfig(
            object_id=self.object_id,
            site=self.site,
            licence=self.licence,
            free_s=self.free_s,
            coach=self.coach,
            mount=self.mount.mount(),
            late_s={} if offsets is None else offsets.late_s,
            **given,
        )

    def look(self, camera: RgbdCameraConfig) -> ObjectView:
        """One picture of the object before anything touches it, and where the contact shows in it."""
        with camera.open() as device:
            sample = device.read(_VIEW_WAIT_S)
        region = None
        if self.contact_mm is not None:
            region = contact_region(camera.intrinsics, np.array(self.contact_mm), self.window_mm)
        assert sample.frame is not None
        return ObjectView(picture=sample.frame, depth_mm=sample.arrays["view_depth_mm"], region_px=region)

    @contextlib.contextmanager
    def _live_view(self, tactile: list[Reader], force: list[Reader], board: "_Board") -> Iterator[None]:
        """A page that is drawn in other threads while the recording goes on."""
        assert self.port is not None
        channels = Extraction(self.background, self.calibration, _MINI_MM_PER_PX).channels(tactile)
        with LiveView(port=self.port) as live:
            OUT.print(f"live view at {live.address}", highlight=False)
            with Presenter(channels, force[0] if force else None, live, board.words).in_thread():
                yield


def _tell_losses(object_id: str, report: Report) -> None:
    """Say what a session left out, flagged or dropped."""
    for count, problem in (
        (
            report.left_out,
            "were left out: their size or arrays differ from most of their contact; fix the size of the camera, as "
            "with --width of uvc",
        ),
        (report.broken, "hold values that no sensor measures: flagged incomplete"),
    ):
        if count:
            OUT.print(f"{count} frames {problem}", highlight=False, soft_wrap=True)
    if report.view_dropped:
        OUT.print(
            f"{object_id} has a view from an earlier session, which is kept: give --contact-mm in that picture's frame",
            highlight=False,
            soft_wrap=True,
        )
    for sensor, count in report.absent.items():
        OUT.print(f"{sensor} gave no frame in {count} of {report.contacts} contacts", highlight=False)
    for sensor, count in (+report.silent).items():
        OUT.print(
            f"{sensor} was silent at the beginning or end of {count} of {report.contacts} contacts: the frame "
            "next to the gap is flagged time_gap; look at its connection",
            highlight=False,
            soft_wrap=True,
        )


_LITTLE_BYTES = 5e9
_BYTES_PER_S = 320 * 240 * 3 * 25  # of one camera, uncompressed as in the journal


def _warn_of_little_disk(out: pathlib.Path) -> None:
    """Say before anything is recorded that the disk will not carry much."""
    there = next(path for path in (out, *out.absolute().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if free < _LITTLE_BYTES:
        ERR.print(
            f"only {free / 1e9:.1f} GB are free at {there}: about {free / _BYTES_PER_S / 60:.0f} minutes of one camera "
            "of 320 × 240 at 25 Hz; free some, or record elsewhere",
            markup=False,
        )


_MINI_MM_PER_PX = 0.0634  # of a GelSight Mini at 320 × 240, where no device states its pitch


class _Board:
    """The terminal's picture of a session, and its words for the page."""

    def __init__(self) -> None:
        self._status: Status | None = None

    def words(self) -> tuple[str, str]:
        """Prompt and alarm."""
        status = self._status
        return ("", "") if status is None else (status.advice.prompt, status.alarm)

    @contextlib.contextmanager
    def shown(self) -> Iterator[Callable[[Status], None]]:
        """A function that shows a status, while the block runs."""
        with live_display(12, self._render) as live:
            del live

            def show(status: Status) -> None:
                self._status = status  # drawn by the thread of the terminal, twelve times a second

            yield show

    def _render(self) -> rich.console.RenderableType:
        return "waiting for the first sample" if self._status is None else drawn(self._status)


def drawn(status: Status) -> rich.console.RenderableType:
    """Display for the operator: the prompt, the force and its target, lost samples."""
    advice = status.advice
    top = max(advice.target_n * 1.25, 1.0)
    table = rich.table.Table.grid(padding=(0, 2))
    bar = rich.progress_bar.ProgressBar(total=top, completed=min(max(advice.normal_n, 0.0), top), width=50)
    normal_n = advice.normal_n + 0.0  # nothing measured is −0
    table.add_row("force", bar, f"{normal_n:6.2f} N" + (f" of {advice.target_n:g} N" if advice.target_n else ""))
    for stream in status.streams:
        counts = stream.counts
        words = f"lost {counts.lost}, twice {counts.duplicates}, waiting {counts.waiting}"
        table.add_row(stream.sensor, f"{stream.frames} frames", words)
        if stream.drift is not None:
            mean = ", ".join(f"{v:+.1f}" for v in stream.drift.mean)
            table.add_row("", "background drift", f"{stream.drift.rms:.1f} grey levels; R, G, B {mean}")
    if status.force is not None:
        table.add_row("force sensor", f"{status.force.delivered} readings", f"lost {status.force.lost}")
    if status.alarm:
        table.add_row("alarm", status.alarm, "", style="bold red")
    style = "bold red" if advice.prompt.startswith("STOP") else "bold green" if advice.complete else "bold"
    title = f"{status.stage.motion} at {status.stage.force_n:g} N" if advice.target_n else status.stage.motion
    return rich.console.Group(rich.panel.Panel(advice.prompt, title=title, style=style, width=80), table)
