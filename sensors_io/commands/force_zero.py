"""`python -m sensors_io force-zero`."""

import dataclasses
import pathlib
import time

import numpy as np
from rich.table import Table

from sensors_io.commands.choices import Bench, readers, stop_on_interrupt
from sensors_io.commands.console import OUT, live_display
from sensors_io.devices.errors import StreamEndedError
from sensors_io.devices.reader import Reader
from sensors_io.force import ForceError
from sensors_io.json_files import require_writable
from sensors_io.poses import ForceZero, PoseConfig, PoseFinder, PoseReading, fit_poses

_LOOK_S = 0.02  # between two looks at the readings


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceZeroing(Bench):
    """Measure bias, mass and centre of mass of what sits on a force sensor, from static poses without contact.

    Turn the sensor slowly into different directions and hold each of them still until it is counted; end in the pose in
    which you will record.  Nothing needs to be known of the poses: their directions follow from gravity.
    """

    out: pathlib.Path
    """JSON for `record --gravity`."""
    poses: int = 8
    """Number of poses to hold; use six or more, in all directions."""
    wait_s: float = 300.0
    """Time limit for all poses together."""
    still: PoseConfig = dataclasses.field(default_factory=PoseConfig)
    """Criterion for a hand at rest."""

    def run(self) -> int:
        if self.poses < 4:
            raise ForceError(f"poses is {self.poses}: must be ≥ 4, a sphere has four unknowns; hold six or more")
        require_writable(self.out)
        with stop_on_interrupt() as stop, readers((self.device,), numbers=True) as (sensor,):
            finder = PoseFinder(self.still)
            end_s = time.monotonic() + self.wait_s
            with live_display(10) as live:
                while len(finder.poses) < self.poses and not stop.is_set() and time.monotonic() < end_s:
                    try:
                        newest = _take(sensor, finder, self.poses)
                    except StreamEndedError:
                        break
                    if newest is not None:
                        live.update(_board(finder, self.poses, newest))
                    stop.wait(_LOOK_S)
            name = sensor.identity.sensor
        if len(finder.poses) < self.poses:
            raise ForceError(
                f"{name}: {len(finder.poses)} of {self.poses} poses were held still: hold each for "
                f"{self.still.hold_s} s, turn further between them, or raise --still-n above the sensor's noise"
            )
        zero = fit_poses(finder.poses)
        zero.save(self.out)
        OUT.print(report(zero, finder.poses))
        OUT.print(f"wrote {self.out}", highlight=False)
        return 0


def _take(sensor: Reader, finder: PoseFinder, wanted: int) -> np.ndarray | None:
    """Hand on everything that came; the newest force, `None` if none came."""
    newest = None
    for sample in sensor.drain():
        if "force_n" not in sample.arrays:
            raise ForceError(f"{sensor.identity.sensor} measures no force: give a force sensor, such as netft")
        newest = sample.arrays["force_n"]
        moment = sample.arrays["moment_nmm"] if "moment_nmm" in sample.arrays else np.zeros(3)
        if len(finder.poses) < wanted:
            finder.offer(sample.host_time_ns, newest, moment)
    return newest


def _board(finder: PoseFinder, wanted: int, force_n: np.ndarray) -> Table:
    table = Table.grid(padding=(0, 2))
    found = len(finder.poses)
    table.add_row("poses", f"{found} of {wanted}", "turn to another direction and hold still" if found < wanted else "")
    table.add_row("reading", f"{np.linalg.norm(force_n):.2f} N", " ".join(f"{v:+.2f}" for v in force_n))
    return table


def report(zero: ForceZero, poses: list[PoseReading]) -> Table:
    """Report of the fit and its residuals."""
    model = zero.model
    table = Table("what", "figure", title="force sensor without contact")
    table.add_row("bias", f"{_vector(model.bias_n)} N, {_vector(model.bias_nmm)} N mm")
    table.add_row("mass", f"{1e3 * model.mass_kg:.1f} g")
    heavy = model.weight_n > 0 and np.linalg.norm(model.first_moment_nmm) > 0
    table.add_row("centre of mass", f"{_vector(model.centre_mm)} mm" if heavy else "–")
    table.add_row("residual", f"{model.rms_n:.4f} N, {model.rms_nmm:.3f} N mm over {model.poses} poses")
    table.add_row("largest spread while held", f"{max(p.spread_n for p in poses):.4f} N")
    table.add_row("down in the last pose", _vector(zero.down))
    return table


def _vector(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in values) + ")"
