"""`python -m sensors_io sync`."""

import contextlib
import dataclasses
import pathlib
import time

from rich.table import Table

from sensors_io.commands.choices import Bench, readers, stop_on_interrupt
from sensors_io.commands.console import OUT, live_display
from sensors_io.devices.errors import StreamEndedError
from sensors_io.json_files import require_writable
from sensors_io.offsets import Offsets, OffsetsError
from sensors_io.recording.signals import By, Listener, measure_offsets

_LOOK_S = 0.02  # between two looks at the devices


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sync(Bench):
    """Measure by touch how late each sensor's timestamps are against the force sensor, or else the first one.

    Devices are joined by a + of its own: sync --out S.json uvc --serial S + tac3d + netft --host H.  Keep still for a
    second, then tap everything at once, sharply and irregularly, five times or more (`--by taps`), or press and release
    slowly (`--by presses`, against a force).
    """

    out: pathlib.Path | None = None
    """File for `record --sync` (JSON); without it, the delays are only printed."""
    check: pathlib.Path | None = None
    """File of an earlier `sync`: print the remaining delays; exit status 1 if one is too large."""
    most_s: float = 0.01
    """Largest remaining delay that `--check` accepts."""
    seconds: float = 15.0
    """Duration of the measurement."""
    by: By = "taps"
    """Events that are compared: the rise of taps, or the course of presses."""

    def run(self) -> int:
        parts = self.parts()
        parts.require_tactile()
        configs = (*((parts.force,) if parts.force else ()), *parts.tactile)
        if len(configs) < 2:
            raise OffsetsError("one device is named: two or more can be compared; join them by +")
        if self.out is not None and self.check is not None:
            raise OffsetsError(f"out is {self.out}, check {self.check}: --check writes no file; leave one of them out")
        earlier = None if self.check is None else Offsets.load(self.check)
        if self.out is not None:
            require_writable(self.out)
        with stop_on_interrupt() as stop, readers(configs) as devices:
            listeners = [Listener(device) for device in devices]
            end_s = time.monotonic() + self.seconds
            with live_display(10) as live, contextlib.suppress(StreamEndedError):
                while not stop.is_set() and time.monotonic() < end_s:
                    for listener in listeners:
                        listener.look()
                    live.update(_board(listeners, end_s - time.monotonic()))
                    stop.wait(_LOOK_S)
        first, *others = listeners
        signals = {listener.name: listener.signal() for listener in others}
        found = measure_offsets(first.signal(), signals, first.name, self.by)
        if earlier is not None:
            return self._check(found, earlier)
        OUT.print(report(found))
        if self.out is not None:
            found.save(self.out)
            OUT.print(f"wrote {self.out}", highlight=False)
        return 0

    def _check(self, found: Offsets, stored: Offsets) -> int:
        """Report the delays that remain after stored offsets; exit status 1 if any is too large."""
        before = stored.late_s
        stored.require(found.late_s, self.check)
        zero_s = before[found.reference]
        left_s = {name: offset.late_s - (before[name] - zero_s) for name, offset in found.sensors.items()}
        table = Table("sensor", "remaining delay", f"against {found.reference}, at most {1e3 * self.most_s:g} ms")
        for name, left in left_s.items():
            table.add_row(name, f"{1e3 * left:+.1f} ms", "good" if abs(left) <= self.most_s else "measure again")
        OUT.print(table)
        return 0 if all(abs(left) <= self.most_s for left in left_s.values()) else 1


def report(found: Offsets) -> Table:
    """Delay of each sensor's timestamps and its source."""
    table = Table("sensor", "late by", "spread of one tap", "known from", title=f"stamps against {found.reference}")
    for name, offset in found.sensors.items():
        spread = "–" if offset.spread_s is None else f"{1e3 * offset.spread_s:.1f} ms"
        known = f"{offset.events} taps" if offset.by == "taps" else f"presses, correlation {offset.agreement:.2f}"
        table.add_row(name, f"{1e3 * offset.late_s:+.1f} ms", spread, known)
    return table


def _board(listeners: list[Listener], left_s: float) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_row("touch all of them now", f"{max(0.0, left_s):.0f} s left")
    for listener in listeners:
        table.add_row(listener.name, f"{listener.newest:.2f}")
    return table
