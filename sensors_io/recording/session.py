"""A recording session: one object, its sites, one tactile sensor, one force sensor.

Every contact goes into a journal of its own while it is recorded, and into the records when it is over.  A session that
was stopped or killed is gone on with by starting it again: journals that lie there are brought into the records first,
the contacts that are complete are not asked for again.
"""

import collections
import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from sensors_io.devices.background import Background, Drift
from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import DeviceError
from sensors_io.devices.intake import Counts
from sensors_io.force import ForceError, GravityModel, Mount
from sensors_io.recording.book import Book, Report
from sensors_io.recording.coach import Advice, Coach, CoachConfig, FreeCoach, Phase, Stage, protocol
from sensors_io.recording.journal import JournalWriter
from sensors_io.records import RecordsMeta, RecordWriter
from sensors_io.schema import ContactKey

_JOURNALS = ".journals"
_BEFORE = 8  # frames kept from before a contact is armed: the gel untouched
_IDLE_S = 0.002  # between looks at the devices; a tenth of the fastest camera's period


class Feed(Protocol):
    """What a session reads from; `Reader` is one."""

    @property
    def identity(self) -> Identity: ...
    @property
    def counts(self) -> Counts: ...
    def drain(self) -> list[Sample]: ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class SessionConfig:
    """What is recorded.

    Args:
      object_id: of the object, as in its card.
      site: number of the place on the object.
      licence: of the recordings.
      stages: contacts asked for.
      free_s: > 0 records one contact of free motion for so long, and no stages.
      coach: thresholds of force and time.
      gravity: bias and dead weight of the force sensor; `None` leaves readings as they are.
      down: unit vector of gravity in the force sensor's frame, [3].
      mount: how the gel sits on the force sensor.
      lag_s: of the frames behind the force, see `force.estimate_lag`.
      mm_per_px: of the frames; `None` where unknown.
    """

    object_id: str
    site: int = 0
    licence: str = "all rights reserved"
    stages: tuple[Stage, ...] = dataclasses.field(default_factory=protocol)
    free_s: float = 0.0
    coach: CoachConfig = dataclasses.field(default_factory=CoachConfig)
    gravity: GravityModel | None = None
    down: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    mount: Mount = dataclasses.field(default_factory=Mount)
    lag_s: float = 0.0
    mm_per_px: float | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Status:
    """What a session shows while it goes on."""

    stage: Stage
    advice: Advice
    frames: int
    tactile: Counts
    force: Counts | None
    drift: Drift | None
    newest: Sample | None


def record_session(
    out: pathlib.Path,
    config: SessionConfig,
    tactile: Feed,
    force: Feed | None,
    *,
    show: Callable[[Status], None],
    stop: Callable[[], bool] = lambda: False,
) -> Report:
    """Record what is missing of a session; a second call goes on behind the first.

    Args:
      out: directory of the records.
      config: what is recorded.
      tactile: an open sensor.
      force: an open force sensor; `None` takes the force that the tactile sensor tells, or none in free motion.
      show: called after every look at the devices.
      stop: asked as often; True ends the session after bringing what was recorded into the records.

    Raises:
      RecordsError: the records are another data set's, or are being written.
      ForceError: nothing tells the force that the protocol is led by.
      DeviceError: a device failed for good; what was recorded is in the records.
    """
    sensor = tactile.identity.sensor
    meta = RecordsMeta(source="recorded", licence=config.licence, config_hash="recorded-1", sensors=(sensor,))
    journals = out / _JOURNALS
    report = Report()
    with RecordWriter(out, meta=meta, resume=True) as writer:
        journals.mkdir(exist_ok=True)
        book = Book(writer, journals, report)
        book.add_object(config.object_id)
        book.recover()
        session = _Session(config, tactile, force, show, stop, book)
        try:
            for stage in _stages(config):
                while not stop() and (key := book.wanted(config.object_id, config.site, stage)) is not None:
                    session.contact(stage, key)
        finally:
            book.publish()
    return report


def _stages(config: SessionConfig) -> tuple[Stage, ...]:
    return (Stage(motion="free", force_n=0.0),) if config.free_s > 0 else config.stages


class _Session:
    """Reads the devices and leads the hand, one contact at a time."""

    def __init__(
        self,
        config: SessionConfig,
        tactile: Feed,
        force: Feed | None,
        show: Callable[[Status], None],
        stop: Callable[[], bool],
        book: Book,
    ):
        self._config, self._tactile, self._force = config, tactile, force
        self._show, self._stop, self._book = show, stop, book
        self._before: collections.deque[Sample] = collections.deque(maxlen=_BEFORE)
        self._background = Background()

    def contact(self, stage: Stage, key: ContactKey) -> None:
        """Record one contact from the prompt to the records."""
        c = self._config
        coach = FreeCoach(c.free_s) if c.free_s > 0 else Coach(stage, c.coach)
        path = self._book.path(key)
        complete, failure = False, None
        with JournalWriter(path) as journal:
            journal.append("start", self._start(key, stage))
            try:
                complete = self._run(stage, coach, journal)
            except DeviceError as error:
                failure = error  # raised below, when what was recorded is in the records
            journal.append("end", {"complete": complete, "counts": dataclasses.asdict(self._tactile.counts)})
        self._before.clear()
        self._book.store(path)
        if failure is not None:
            raise failure

    def _run(self, stage: Stage, coach: Coach | FreeCoach, journal: JournalWriter) -> bool:
        """Read until the coach says done; whether the contact is complete."""
        phase: Phase | None = None
        advice: Advice | None = None
        written = 0
        while not self._stop():
            frames = self._tactile.drain()
            times, forces, moments = self._forces(frames)
            for at, one in zip(times, forces, strict=True):
                advice = coach.step(int(at), one)
                if advice.recording and advice.phase != phase:
                    phase = advice.phase
                    journal.append("phase", {"time_ns": int(at), "phase": int(phase)})
            recording = advice is not None and (advice.recording or advice.done)
            if len(times) and self._force is not None:
                journal.append("force", {}, time_ns=times, force_n=forces, moment_nmm=moments)
            written += self._frames(frames, recording, advice, journal)
            if advice is not None:
                self._show(self._status(stage, advice, written, frames))
                if advice.done:
                    return advice.complete
            if not frames and not len(times):
                time.sleep(_IDLE_S)
        return False

    def _frames(self, frames: list[Sample], recording: bool, advice: Advice | None, journal: JournalWriter) -> int:
        """Journal the frames of a contact, and those just before it; others are the background."""
        if not recording:
            touched = advice is None or abs(advice.normal_n) >= self._config.coach.touch_n
            for sample in frames:
                self._before.append(sample)
                if sample.frame is not None and sample.frame.ndim == 3:
                    self._background.offer(sample.frame, touched=touched)
            return 0
        whole = [*self._before, *frames]
        self._before.clear()
        for sample in whole:
            plain = {"time_ns": sample.host_time_ns, "device_time_ns": sample.device_time_ns, "index": sample.index}
            picture = {} if sample.frame is None else {"frame": sample.frame}
            journal.append("frame", plain, **picture, **sample.arrays)
        return len(whole)

    def _forces(self, frames: list[Sample]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times [n], forces and moments [n, 3] on the gel; those of the tactile sensor where there is no other."""
        samples = frames if self._force is None else self._force.drain()
        times = np.array([s.host_time_ns for s in samples], np.int64)
        if samples and "force_n" not in samples[0].arrays and not self._config.free_s:
            raise ForceError(
                f"{self._tactile.identity.sensor} tells no force, which leads the protocol; give a force "
                "sensor, or record free motion"
            )
        nothing = np.zeros(3)
        force, moment = (
            np.array([s.arrays.get(name, nothing) for s in samples], np.float64).reshape(-1, 3)
            for name in ("force_n", "moment_nmm")
        )
        if self._force is None:
            return times, force, moment
        if self._config.gravity is not None:
            force, moment = self._config.gravity.contact(force, moment, self._config.down)
        return times, *self._config.mount.to_gel(force, moment)

    def _start(self, key: ContactKey, stage: Stage) -> dict[str, Any]:
        identity = dataclasses.asdict(self._tactile.identity)
        return {
            "key": dataclasses.asdict(key),
            "identity": identity | {"settings": dict(identity["settings"])},
            "target_n": stage.force_n,
            "lag_s": self._config.lag_s,
            "mm_per_px": self._config.mm_per_px,
            "reader": dataclasses.asdict(self._tactile.counts),
        }

    def _status(self, stage: Stage, advice: Advice, frames: int, newest: list[Sample]) -> Status:
        return Status(
            stage=stage,
            advice=advice,
            frames=frames,
            tactile=self._tactile.counts,
            force=None if self._force is None else self._force.counts,
            drift=self._background.drift(),
            newest=newest[-1] if newest else None,
        )
