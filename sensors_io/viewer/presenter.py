"""Display of a bench: the newest sample of every sensor with its fields, the force, rates, losses, flags."""

import collections
import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Seq
from typing import Protocol

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.devices.background import Drift, GelBackground
from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import DeviceError, StaleFrameError
from sensors_io.devices.intake import Counts
from sensors_io.fields.extract import Extractor
from sensors_io.schema import Flag
from sensors_io.viewer.panels import SCALES, Panel, panels
from sensors_io.viewer.server import LiveView, Numbers

_OVERLOAD_N = 22.0  # at which the hand must stop; half of what the sensors bear
_RATE_S = 1.0  # over which rates are measured
_STALE_S = 1.0  # an older sample is not shown as if it were new
_FRAME_S = 1 / 30  # between two published states: screens show no more


class Watched(Protocol):
    """Source of a device's display; `Reader` is one."""

    @property
    def identity(self) -> Identity: ...
    @property
    def counts(self) -> Counts: ...
    @property
    def overloaded(self) -> bool: ...
    def latest(self, max_age_s: float) -> Sample: ...


class Channel:
    """One sensor on the page.

    Args:
      device: open; its ring is left alone.
      extractor: of the fields of its pictures; `None` shows the fields of the sensor itself.
    """

    def __init__(self, device: Watched, extractor: Extractor | None = None):
        self.device = device
        self._extractor = extractor
        self._background = GelBackground()
        self._shown_ns = -1
        self._arrivals: collections.deque[tuple[float, int]] = collections.deque()
        self.sample: Sample | None = None
        self.drift: Drift | None = None
        self.flags = Flag.NONE
        self.refused = ""

    @property
    def name(self) -> str:
        """Of the sensor."""
        return self.device.identity.sensor

    @property
    def mm_per_px(self) -> float | None:
        """Pitch of its pictures, where extractor or device know it."""
        return self._extractor.mm_per_px if self._extractor is not None else self.device.identity.mm_per_px

    def look(self) -> bool:
        """Take the newest sample, with fields; whether it is a new one."""
        self._arrivals.append((time.monotonic(), self.device.counts.arrived))
        while self._arrivals[-1][0] - self._arrivals[0][0] > _RATE_S and len(self._arrivals) > 2:
            self._arrivals.popleft()
        try:
            sample = self.device.latest(_STALE_S)
        except StaleFrameError:
            return False
        if sample.host_time_ns == self._shown_ns:
            return False
        self._shown_ns = sample.host_time_ns
        self.sample = self._with_fields(sample)
        return True

    @property
    def rate_hz(self) -> float:
        """Samples that arrived a second, over the last one."""
        (t0, n0), (t1, n1) = self._arrivals[0], self._arrivals[-1]
        return (n1 - n0) / (t1 - t0) if t1 > t0 else 0.0

    def table(self) -> dict[str, str]:
        """Rows of its table."""
        counts = self.device.counts
        listed = {
            "rate": f"{self.rate_hz:.1f} Hz",
            "samples": str(counts.arrived),
            "lost": f"{counts.lost} ({counts.missing} not received)",
            "repeated": str(counts.duplicates),
            "disconnects": str(counts.disconnects),
        }
        if self.sample is not None:
            age_ms = (time.monotonic_ns() - self.sample.host_time_ns) / 1e6
            listed["age when shown"] = f"{age_ms:.0f} ms"
        names = [str(flag.name).lower().replace("_", " ") for flag in Flag if flag & self.flags]
        listed["flags"] = ", ".join(names) or "none"
        if self.refused:
            listed["fields"] = self.refused
        if self.drift is not None:
            listed["background drift"] = f"{self.drift.rms:.1f} grey levels"
        return listed

    def _with_fields(self, sample: Sample) -> Sample:
        """The sample with the fields of its picture among its arrays, without changing those of the sensor itself."""
        frame = sample.frame
        self.flags = Flag(int(sample.arrays["flags"])) if "flags" in sample.arrays else Flag.NONE
        if frame is None or frame.ndim != 3:
            return sample
        touched = self._background.looks_touched(frame)
        if self._extractor is not None and frame.shape != (rest := self._extractor.background).shape:
            self.refused = f"none: pictures are {frame.shape[:2]}, the gel at rest is {rest.shape[:2]}; crop both alike"
        elif self._extractor is not None:
            fields = self._extractor.read(frame)
            found = {name: a[0] for name, a in fields.arrays().items() if a is not None and name != "flags"}
            self.flags |= Flag(int(fields.flags[0]))
            touched = Flag.NO_CONTACT not in self.flags
            sample = dataclasses.replace(sample, arrays=found | dict(sample.arrays))
        self._background.offer(frame, touched=touched)
        if not touched:
            self.drift = self._background.drift()
        return sample


class Presenter:
    """Publishes what a bench shows.

    Args:
      channels: the sensors.
      force: the force sensor; without one the first force that a sensor measures is shown.
      live: where to.
      words: prompt and alarm of a session under way.
    """

    def __init__(
        self,
        channels: Seq[Channel],
        force: Watched | None,
        live: LiveView,
        words: Callable[[], tuple[str, str]] = lambda: ("", ""),
    ):
        self._channels, self._force, self._live, self._words = channels, force, live, words

    def step(self) -> bool:
        """Publish if there is anything new; whether there was."""
        new = [channel.look() for channel in self._channels]  # every one of them, not up to the first that is new
        if not any(new):
            return False
        newtons = self._newtons()
        prompt, alarm = self._words()
        numbers = Numbers(
            title=" + ".join(f"{c.name} {c.device.identity.serial}".strip() for c in self._channels),
            time_s=max(c.sample.host_time_ns for c in self._channels if c.sample is not None) / NS_PER_S,
            force_n=newtons,
            tables=self._tables(newtons),
            captions=self._captions(),
            alarm=alarm or self._alarm(newtons),
            prompt=prompt,
        )
        self._live.publish(self._panels(), numbers)
        return True

    def run(self, stop: Callable[[], bool]) -> None:
        """Publish, at most 30 times a second, until it is stopped or until a device ends."""
        while not stop():
            began_s = time.monotonic()
            try:
                self.step()
            except DeviceError:
                return  # whoever reads the device in order says why
            time.sleep(max(0.0, _FRAME_S - (time.monotonic() - began_s)))

    @contextlib.contextmanager
    def in_thread(self) -> Iterator[None]:
        """Publish from a thread of its own while the block runs: what goes on there never waits for a picture."""
        done = threading.Event()
        thread = threading.Thread(target=self.run, args=(done.is_set,), name="presenter", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def _panels(self) -> Mapping[str, Panel]:
        return {
            self._label(channel, name): panel
            for channel in self._channels
            if channel.sample is not None
            for name, panel in panels(channel.sample, channel.mm_per_px).items()
        }

    def _captions(self) -> dict[str, str]:
        return {self._label(channel, name): scale for channel in self._channels for name, scale in SCALES.items()}

    def _label(self, channel: Channel, name: str) -> str:
        return name if len(self._channels) == 1 else f"{channel.name}: {name}"

    def _newtons(self) -> tuple[float, float, float] | None:
        forces = [c.sample.arrays["force_n"] for c in self._channels if c.sample and "force_n" in c.sample.arrays]
        if self._force is not None:
            try:
                forces = [self._force.latest(_STALE_S).arrays["force_n"]]
            except StaleFrameError:
                return None
        if not forces:
            return None
        x, y, z = map(float, forces[0])
        return (x, y, z) if np.isfinite([x, y, z]).all() else None

    def _tables(self, newtons: tuple[float, float, float] | None) -> dict[str, Mapping[str, str]]:
        tables: dict[str, Mapping[str, str]] = {channel.name: channel.table() for channel in self._channels}
        if newtons is not None:
            tables["force"] = {
                "normal": f"{-newtons[2]:z.2f} N",
                "tangential": f"{float(np.hypot(*newtons[:2])):.2f} N",
            }
        if self._force is not None:
            tables["force"] = {**tables.get("force", {}), "lost": str(self._force.counts.lost)}
        return tables

    def _alarm(self, newtons: tuple[float, float, float] | None) -> str:
        """Problems, worst first."""
        if newtons is not None and float(np.linalg.norm(newtons)) >= _OVERLOAD_N:
            return f"overload: {float(np.linalg.norm(newtons)):.0f} N, release"
        silent = [c.name for c in self._channels if c.device.counts.disconnects > c.device.counts.reconnects]
        if silent:
            return f"{', '.join(silent)}: disconnected"
        late = [c.name for c in self._channels if c.device.overloaded]
        return f"{', '.join(late)}: samples are read too slowly and will be lost" if late else ""
