"""One tactile sensor of a session: the frames from before a contact, the gel at rest, what goes into the journal."""

import collections
import dataclasses
from typing import Any, Protocol

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.devices.background import Drift, GelBackground
from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import DeviceDataError
from sensors_io.devices.intake import Counts
from sensors_io.recording.journal import JournalWriter

_BEFORE = 8  # frames kept from before a contact is armed: the gel untouched
_LAMPS_LEVELS = 20.0  # that a channel of the gel at rest may change by; lamps that warm up change it by some percent
_SETTLE_S = 0.3  # after a camera was opened: its first frames may be dark, or cut off
_DRIFT_EVERY = 25  # untouched frames: drift is slow, and takes half a millisecond to measure


class SampleReader(Protocol):
    """Source of a session's samples; `Reader` is one."""

    @property
    def identity(self) -> Identity: ...
    @property
    def counts(self) -> Counts: ...
    def drain(self) -> list[Sample]: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class StreamStatus:
    """State of one sensor in a session, for display.

    Args:
      sensor: its name.
      frames: journaled of this contact.
      counts: where its samples went.
      drift: of the gel at rest; `None` before enough of it was seen.
      newest: sample of the last look, `None` if none came.
    """

    sensor: str
    frames: int
    counts: Counts
    drift: Drift | None
    newest: Sample | None


class Stream:
    """A feed, and what a session remembers of it.

    Args:
      number: of the stream in the session.
      feed: an open sensor.
      late_s: by which its stamps lie behind those of the force sensor, or of the first stream.

    Attributes:
      frames: journaled of this contact.
      seen_ns: when the last sample that was looked at was taken, on the common clock.
    """

    def __init__(self, number: int, feed: SampleReader, late_s: float):
        self.feed, self.late_s = feed, late_s
        self.frames = 0
        self.seen_ns = 0
        self._number = number
        self._before: collections.deque[Sample] = collections.deque(maxlen=_BEFORE)
        self._background = GelBackground()
        self._early: np.ndarray | None = None  # the gel at rest before the camera settled, for want of a later one
        self._drift: Drift | None = None
        self._disconnects, self._settled_ns = -1, 0  # -1: not even opened yet
        self._newest: Sample | None = None

    @property
    def sensor(self) -> str:
        """Name of the sensor."""
        return self.feed.identity.sensor

    def look(self) -> list[Sample]:
        """Everything that came since the last look."""
        samples = self.feed.drain()
        self._newest = samples[-1] if samples else None
        if samples:
            self.seen_ns = int(self.time_ns(samples)[-1])
        return samples

    def time_ns(self, samples: list[Sample]) -> np.ndarray:
        """When samples were taken, on the common clock, int64 [n]."""
        late_ns = round(self.late_s * NS_PER_S)
        return np.array([s.host_time_ns for s in samples], np.int64) - late_ns

    def keep(self, samples: list[Sample]) -> None:
        """Keep frames that belong to no contact, the last few of them, in case one begins."""
        self._before.extend(samples)

    def refresh(self, samples: list[Sample], *, rest_ns: tuple[int, int] | None) -> None:
        """Refresh the background by what shows the gel at rest.

        Args:
          samples: of the last look.
          rest_ns: since and until when it was, by the force; `None` where there is none and the pictures must show it.
        """
        times = self.time_ns(samples).tolist()
        if samples and self.feed.counts.disconnects != self._disconnects:
            self._disconnects, self._settled_ns = self.feed.counts.disconnects, times[0] + round(_SETTLE_S * NS_PER_S)
        for time_ns, sample in zip(times, samples, strict=True):
            if sample.frame is None or sample.frame.dtype != np.uint8 or sample.frame.shape[2:] != (3,):
                continue
            if rest_ns is None:
                touched = self._background.looks_touched(sample.frame)
            else:
                touched = not rest_ns[0] <= time_ns < rest_ns[1]
            if time_ns < self._settled_ns:
                self._early = self._early if touched else sample.frame
                continue
            self._background.offer(sample.frame, touched=touched)
            if not touched and self._background.frames % _DRIFT_EVERY == 0:
                self._drift = self._background.drift()

    def journal(self, samples: list[Sample], journal: JournalWriter) -> None:
        """Journal frames of a contact, behind those just before it.

        Raises:
          DeviceDataError: an array of anything but numbers, such as the objects that NumPy makes of ragged lists.
        """
        whole = [*self._before, *samples]
        self._before.clear()
        times = self.time_ns(whole).tolist()
        for time_ns, sample in zip(times, whole, strict=True):
            plain = {
                "stream": self._number,
                "time_ns": time_ns,
                "device_time_ns": sample.device_time_ns,
                "index": sample.index,
            }
            arrays = sample.arrays if sample.frame is None else {"frame": sample.frame, **sample.arrays}
            for name, x in arrays.items():
                if (dtype := np.asarray(x).dtype).kind not in "biuf":
                    what = f"{name} of {self.sensor} has type {dtype}"
                    raise DeviceDataError(f"{what}: must be numbers; correct its driver")
            journal.append("frame", plain, **arrays)
        self.frames += len(whole)

    @property
    def background(self) -> np.ndarray | None:
        """The gel at rest, uint8 [H, W, 3]; `None` before it was seen."""
        return self._background.picture() if self._background.frames else self._early

    @property
    def alarm(self) -> str:
        """Warning that lamps or exposure have changed, by the gel at rest; empty if they are as they were at first."""
        levels = 0.0 if self._drift is None else float(np.abs(self._drift.mean).max())
        if levels <= _LAMPS_LEVELS:
            return ""
        return f"{self.sensor} at rest has changed by {levels:.0f} grey levels: look at its lamps, exposure and lens"

    def begin(self) -> dict[str, Any]:
        """First entry of a journal: identity, delay, counts, and the drift of the background."""
        identity = dataclasses.asdict(self.feed.identity)
        drift = self._background.drift()
        return {
            "identity": identity | {"settings": dict(identity["settings"])},
            "late_s": self.late_s,
            "reader": dataclasses.asdict(self.feed.counts),
            "drift": None if drift is None else {"rms": drift.rms, "mean": drift.mean.tolist()},
        }

    def end(self) -> None:
        """Forget the frames that came after a contact."""
        self._before.clear()
        self.frames = 0

    def status(self) -> StreamStatus:
        """State for display."""
        return StreamStatus(
            sensor=self.sensor,
            frames=self.frames,
            counts=self.feed.counts,
            drift=self._drift,
            newest=self._newest,
        )
