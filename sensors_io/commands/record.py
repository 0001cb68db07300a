"""`python -m sensors_io record`."""

import contextlib
import dataclasses
import json
import pathlib

import numpy as np
import rich.console
import rich.live
import rich.panel
import rich.progress_bar
import rich.table

from sensors_io.commands.choices import Force, Tactile, opened, stop_on_interrupt
from sensors_io.commands.console import OUT
from sensors_io.devices.errors import StreamEndedError
from sensors_io.devices.reader import Reader, ReaderConfig
from sensors_io.force import ForceError, GravityModel
from sensors_io.recording.coach import CoachConfig
from sensors_io.recording.session import SessionConfig, Status, record_session

_FORCE_CAPACITY = 8192  # readings: a second at the 7 kHz of a Net F/T


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """Record one object by protocol: a press to 20 N, then six motions at 2, 5 and 10 N, led by the live force.

    Stop with Ctrl-C and start again: what is complete is not asked for again, and a killed session loses at most the
    frame in flight.
    """

    out: pathlib.Path
    """Directory of the records."""
    object_id: str
    """Of the object; give its card with labels later."""
    device: Tactile
    """The tactile sensor."""
    force: Force = None
    """The force sensor; without one the sensor's own force leads, or nothing in free motion."""
    site: int = 0
    """Number of the place on the object."""
    free_s: float = 0.0
    """> 0 records free motion for so many seconds instead of the protocol."""
    gravity: pathlib.Path | None = None
    """JSON of bias and dead weight, as `force.GravityModel` names them, with `down`; none leaves readings alone."""
    lag_s: float = 0.0
    """By which frames are stamped later than forces, see `force.estimate_lag`."""
    licence: str = "all rights reserved"
    """Of the recordings."""
    coach: CoachConfig = dataclasses.field(default_factory=CoachConfig)

    def run(self) -> int:
        model, down = (None, np.array([0.0, 0.0, -1.0])) if self.gravity is None else load_gravity(self.gravity)
        config = SessionConfig(
            object_id=self.object_id,
            site=self.site,
            licence=self.licence,
            free_s=self.free_s,
            coach=self.coach,
            gravity=model,
            down=down,
            lag_s=self.lag_s,
        )
        with contextlib.ExitStack() as stack:
            stop = stack.enter_context(stop_on_interrupt())
            tactile = stack.enter_context(Reader(opened(self.device)))
            force = None
            if self.force is not None:
                force = stack.enter_context(Reader(opened(self.force), config=ReaderConfig(capacity=_FORCE_CAPACITY)))
            live = stack.enter_context(rich.live.Live(console=OUT, refresh_per_second=12))
            show = lambda status: live.update(board(status))
            try:
                report = record_session(self.out, config, tactile, force, show=show, stop=stop.is_set)
            except StreamEndedError as end:
                OUT.print(f"{end}: what was recorded is in {self.out}", markup=False)
                return 0
        OUT.print(f"{report.contacts} contacts written, {report.recovered} recovered, {report.incomplete} incomplete")
        return 0


def load_gravity(path: pathlib.Path) -> tuple[GravityModel, np.ndarray]:
    """Bias and dead weight, and the direction of gravity, from JSON.

    Raises:
      ForceError: a field is missing or is no number.
    """
    try:
        tree = json.loads(path.read_text())
        model = GravityModel(
            bias_n=np.array(tree["bias_n"], np.float64),
            bias_nmm=np.array(tree["bias_nmm"], np.float64),
            weight_n=float(tree["weight_n"]),
            first_moment_nmm=np.array(tree["first_moment_nmm"], np.float64),
            rms_n=float(tree["rms_n"]),
            rms_nmm=float(tree["rms_nmm"]),
            poses=int(tree["poses"]),
        )
        return model, np.array(tree["down"], np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise ForceError(
            f"{path} holds no gravity model ({error!r}); write down and the fields of GravityModel"
        ) from error


def board(status: Status) -> rich.console.RenderableType:
    """What the hand sees: the prompt, the force against its target, what has been lost."""
    advice = status.advice
    top = max(advice.target_n * 1.25, 1.0)
    table = rich.table.Table.grid(padding=(0, 2))
    bar = rich.progress_bar.ProgressBar(total=top, completed=min(max(advice.normal_n, 0.0), top), width=50)
    table.add_row("force", bar, f"{advice.normal_n:6.2f} N of {advice.target_n:g} N")
    counts = status.tactile
    table.add_row(
        "frames", str(status.frames), f"lost {counts.lost}, twice {counts.duplicates}, waiting {counts.waiting}"
    )
    if status.force is not None:
        table.add_row("readings", str(status.force.delivered), f"lost {status.force.lost}")
    if status.drift is not None:
        mean = ", ".join(f"{v:+.1f}" for v in status.drift.mean)
        table.add_row("background", f"{status.drift.rms:.1f} grey levels", f"mean of R, G, B {mean}")
    style = "bold red" if advice.prompt.startswith("STOP") else "bold green" if advice.complete else "bold"
    title = f"{status.stage.motion} at {status.stage.force_n:g} N" if advice.target_n else status.stage.motion
    return rich.console.Group(rich.panel.Panel(advice.prompt, title=title, style=style, width=80), table)
