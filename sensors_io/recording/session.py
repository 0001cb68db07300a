"""A recording session: one object, its sites, one or more tactile sensors at once, one force sensor.

Every contact goes into a journal of its own while it is recorded, and into the records when it is over: one sequence
per sensor under one key, their times on one clock.  The same command continues a session that was stopped or
killed: its journals are brought into the records first, and contacts that are complete are not asked for again.
"""

import dataclasses
import pathlib
import time
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Seq
from typing import Any

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.devices.base import Sample
from sensors_io.devices.errors import DeviceError, StreamEndedError
from sensors_io.devices.intake import Counts
from sensors_io.force import ForceError, GravityModel, Mount
from sensors_io.index import JOURNALS
from sensors_io.recording.assemble import background_name
from sensors_io.recording.book import Book, ObjectView, Report, complete_view, require_own
from sensors_io.recording.coach import Advice, Coach, CoachConfig, ContactStage, FreeCoach, protocol
from sensors_io.recording.journal import JournalWriter
from sensors_io.recording.streams import SampleReader, Stream, StreamStatus
from sensors_io.records import RecordsMeta, RecordWriter
from sensors_io.schema import MOTIONS, ContactKey, Phase, SchemaError, require_name

_UNTOUCHED_S = 10.0  # of a pause before the first touch the last 10 to 20 s are kept: contacts are stored from memory
_NAME_BYTES = 255  # of a file, in the common file systems
_SILENT_S = 1.0  # of the force sensor while a camera goes on
_RELAX_S = 1.0  # after a touch no frame shows the gel at rest: it relaxes, and stamps may be late
_NEVER_NS = int(np.iinfo(np.int64).max)
_LATE_S = 1.0  # for frames that a link delivers when their contact is over
_IDLE_S = 0.002  # between looks at the devices; a tenth of the fastest camera's period


@dataclasses.dataclass(frozen=True, kw_only=True)
class SessionConfig:
    """Settings of a session.

    Args:
      object_id: of the object, as in its card.
      site: number of the place on the object.
      licence: of the recordings.
      stages: contacts asked for.
      free_s: > 0 records one contact of free motion for so long, and no stages.
      coach: thresholds of force and time.
      gravity: bias and dead weight of the force sensor; `None` leaves readings as they are.
      down: unit vector of gravity in the force sensor's frame, [3].
      mount: how the gel of the first sensor sits on the force sensor.
      late_s: by which stamps of a sensor lie behind those of the force sensor, by its name, see `taps.Offsets`; 0 for
        those that are not named.
    """

    object_id: str
    site: int = 0
    licence: str = "all rights reserved"
    stages: tuple[ContactStage, ...] = dataclasses.field(default_factory=protocol)
    free_s: float = 0.0
    coach: CoachConfig = dataclasses.field(default_factory=CoachConfig)
    gravity: GravityModel | None = None
    down: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    mount: Mount = dataclasses.field(default_factory=Mount)
    late_s: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Status:
    """State of a running session, for display.

    Args:
      stage: contact under way.
      advice: to the hand.
      streams: the sensors, in their order.
      force: where the readings of the force sensor went, `None` without one.
      alarm: what is wrong now; empty if nothing is.
    """

    stage: ContactStage
    advice: Advice
    streams: tuple[StreamStatus, ...]
    force: Counts | None
    alarm: str = ""


def record_session(
    out: pathlib.Path,
    config: SessionConfig,
    tactile: Seq[SampleReader],
    force: SampleReader | None,
    *,
    show: Callable[[Status], None],
    view: ObjectView | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Report:
    """Record what is missing of a session; a second call resumes after the first; the end of a replay ends it.

    Args:
      out: directory of the records.
      config: what is recorded.
      tactile: open sensors of different names; the first one sits on the force sensor.
      force: an open force sensor; `None` takes the force that a tactile sensor measures, or none in free motion.
      show: called after every look at the devices.
      view: of the object, stored once with its card.
      stop: asked as often; True ends the session after bringing what was recorded into the records.

    Raises:
      RecordsError: the records are another data set's, of other sensors, mixed with others, or are being written.
      SchemaError: no sensor, two of one name, or one that no file can be named by.
      ForceError: no device measures the force that leads the protocol.
      DeviceError: a device failed for good; what was recorded is in the records.
    """
    streams = tuple(Stream(i, feed, config.late_s.get(feed.identity.sensor, 0.0)) for i, feed in enumerate(tactile))
    for stream in streams:
        _require_names(config, stream.sensor)
    require_own(out)
    meta = _meta(config, streams)
    report = Report(view_dropped=view is not None and not complete_view(out, meta, config.object_id, view))
    with RecordWriter(out, meta=meta, resume=True) as writer:
        journals = out / JOURNALS
        journals.mkdir(exist_ok=True)
        book = Book(writer, journals, report)
        for other in writer.objects_done - {config.object_id}:
            if other.casefold() == config.object_id.casefold():
                raise SchemaError(
                    f"object_id is {config.object_id!r}, and there is {other!r}: must differ in more than capitals, "
                    "since their files have one name on many disks; correct it"
                )
        book.add_object(config.object_id, view)
        book.recover()
        session = _Session(config, streams, force, show, stop, book, None if view is None else view.region_px)
        try:
            for stage in _stages(config):
                while not stop() and (key := book.wanted(config.object_id, config.site, stage)) is not None:
                    session.contact(stage, key)
        except StreamEndedError as end:
            report.ended = str(end)
        finally:
            book.publish()
    return report


def _stages(config: SessionConfig) -> tuple[ContactStage, ...]:
    return (ContactStage(motion="free", force_n=0.0),) if config.free_s > 0 else config.stages


def _require_names(config: SessionConfig, sensor: str) -> None:
    """Refuse names of which a file could not be named before anything is recorded."""
    require_name("sensor", sensor)
    key = ContactKey(object_id=config.object_id, site=config.site, motion=max(MOTIONS, key=len), trial=99)
    rest = len(background_name(key, sensor).with_suffix(".tmp.png").name) - len(config.object_id) - len(sensor)
    if len(config.object_id) + len(sensor) > _NAME_BYTES - rest:
        raise SchemaError(
            f"object_id and sensor have {len(config.object_id)} and {len(sensor)} letters: must have at most "
            f"{_NAME_BYTES - rest} together, since files are named by them; shorten them"
        )


def _meta(config: SessionConfig, streams: Seq[Stream]) -> RecordsMeta:
    """That of the records; sessions of other sensors belong into others."""
    sensors = tuple(stream.sensor for stream in streams)
    if not sensors or len(set(sensors)) != len(sensors):
        raise SchemaError(
            f"sensors are {list(sensors)}: at least one, each once; name two of one kind apart, such as "
            "--sensor gelsight_mini.left"
        )
    together = "+".join(sorted(sensors))
    return RecordsMeta(source="recorded", licence=config.licence, config_hash=f"recorded-2 {together}", sensors=sensors)


class _Session:
    """Reads the devices and leads the hand, one contact at a time."""

    def __init__(
        self,
        config: SessionConfig,
        streams: Seq[Stream],
        force: SampleReader | None,
        show: Callable[[Status], None],
        stop: Callable[[], bool],
        book: Book,
        region_px: tuple[int, int, int, int] | None,
    ):
        self._config, self._streams, self._force = config, streams, force
        self._show, self._stop, self._book, self._region_px = show, stop, book, region_px
        self._leads: Stream | None = None
        self._alarm = ""
        self._force_ns: int | None = None  # time of its last reading
        self._touched_ns = 0  # time of the last reading of a touch
        self._rest_ns = (0, 0)  # since and until when the gel was last at rest

    def contact(self, stage: ContactStage, key: ContactKey) -> None:
        """Record one contact from the prompt to the records."""
        c = self._config
        coach = FreeCoach(c.free_s) if c.free_s > 0 else Coach(stage, c.coach)
        path = self._book.path(key)
        over_ns, failure = None, None
        with JournalWriter(path) as journal:
            begin = lambda: journal.append("start", self._start(key, stage), **self._backgrounds())
            begin()
            try:
                over_ns = self._run(stage, coach, journal, begin)
                if over_ns is not None:
                    self._hear_out(over_ns, journal)
            except DeviceError as error:
                failure = error  # raised below, when what was recorded is in the records
            journal.append("end", {"complete": over_ns is not None, "counts": self._counts()}, **self._backgrounds())
        for stream in self._streams:
            stream.end()
        self._book.store(path)
        if failure is not None and over_ns is None:  # else the next contact meets it, if one is wanted
            raise failure

    def _run(
        self, stage: ContactStage, coach: Coach | FreeCoach, journal: JournalWriter, begin: Callable[[], None]
    ) -> int | None:
        """Read until the coach says done; when a complete contact was over, `None` for another one."""
        phase: Phase | None = None
        advice: Advice | None = None
        waiting: tuple[int, Phase | None, int] | None = None  # time, phase and size of the journal
        while not self._stop():
            looked = [stream.look() for stream in self._streams]
            times, forces = self._forces(looked, journal)
            for at, one in zip(times, forces, strict=True):
                advice = coach.step(int(at), one)
                self._note_touch(int(at), advice)
                if advice.recording and advice.phase != phase:
                    phase = advice.phase
                    journal.append("phase", {"time_ns": int(at), "phase": int(phase)})
            self._take(looked, advice, journal)
            if len(times) and not coach.begun:
                if waiting is not None and times[-1] - waiting[0] > _UNTOUCHED_S * NS_PER_S:
                    _forget_before(waiting, journal, begin)
                    waiting = None
                waiting = waiting or (int(times[-1]), phase, journal.size)
            if advice is not None:
                self._show(self._status(stage, advice))
                if advice.done:
                    return int(times[-1]) if advice.complete else None
            if not len(times) and not any(looked):
                time.sleep(_IDLE_S)
        return None

    def _hear_out(self, over_ns: int, journal: JournalWriter) -> None:
        """Read on for frames of a contact that is over: a link may be late, though its stamps are right."""
        end_s = time.monotonic() + _LATE_S
        while not self._stop() and time.monotonic() < end_s:
            if not any(0 < over_ns - stream.seen_ns < _LATE_S * NS_PER_S for stream in self._streams):
                return
            for stream in self._streams:  # also those in time, whose rings would overflow
                samples = stream.look()
                kept = stream.time_ns(samples) <= over_ns
                stream.journal([s for s, keep in zip(samples, kept, strict=True) if keep], journal)
            if self._force is not None and (readings := self._force.drain()):
                self._force_ns = readings[-1].host_time_ns
            time.sleep(_IDLE_S)

    def _take(self, looked: Seq[list[Sample]], advice: Advice | None, journal: JournalWriter) -> None:
        """Journal the frames of a contact and those just before it; the untouched ones are the background."""
        recording = advice is not None and (advice.recording or advice.done)
        rest_ns = None if self._force is None and self._leads is None else self._rest_ns
        for stream, samples in zip(self._streams, looked, strict=True):
            stream.refresh(samples, rest_ns=rest_ns)
            if recording:
                stream.journal(samples, journal)
            else:
                stream.keep(samples)

    def _note_touch(self, time_ns: int, advice: Advice) -> None:
        """Begin or end the time at rest, to which frames that come later may belong."""
        if abs(advice.normal_n) >= self._config.coach.touch_n:
            self._touched_ns = time_ns
            self._rest_ns = (self._rest_ns[0], min(self._rest_ns[1], time_ns))
        elif self._rest_ns[1] != _NEVER_NS and time_ns - self._touched_ns >= _RELAX_S * NS_PER_S:
            self._rest_ns = (self._touched_ns + round(_RELAX_S * NS_PER_S), _NEVER_NS)

    def _forces(self, looked: Seq[list[Sample]], journal: JournalWriter) -> tuple[np.ndarray, np.ndarray]:
        """Times [n] and forces [n, 3] on the gel: the force sensor's, else those of a tactile sensor."""
        if self._force is not None:
            measured = self._measured(self._force, journal)
            self._watch(measured[0], looked)
            return measured
        with_force = [i for i, samples in enumerate(looked) if samples and "force_n" in samples[0].arrays]
        if self._leads is None and with_force:
            self._leads = self._streams[with_force[0]]
        if self._leads is not None:
            samples = looked[self._streams.index(self._leads)]
            return self._leads.time_ns(samples), _stacked(samples, "force_n", self._leads.sensor)
        if not self._config.free_s and all(stream.feed.counts.delivered for stream in self._streams):
            names = ", ".join(stream.sensor for stream in self._streams)
            raise ForceError(
                f"{names} measures no force, which leads the protocol; add a force sensor, as in "
                "+ netft --host HOST, or record free motion, as with --free-s 10"
            )
        times = [stream.time_ns(samples) for stream, samples in zip(self._streams, looked, strict=True)]
        every = np.sort(np.concatenate(times))
        return every, np.zeros((len(every), 3))

    def _measured(self, sensor: SampleReader, journal: JournalWriter) -> tuple[np.ndarray, np.ndarray]:
        """Readings of the force sensor, compensated, in the gel's frame; journaled."""
        samples, name = sensor.drain(), sensor.identity.sensor
        times = np.array([s.host_time_ns for s in samples], np.int64)
        force, moment = _stacked(samples, "force_n", name), _stacked(samples, "moment_nmm", name, lacking=0.0)
        beyond = np.array([bool(s.arrays.get("out_of_range", False)) for s in samples], bool)
        with np.errstate(invalid="ignore"):  # of readings that are not finite, which are journaled as they are
            if self._config.gravity is not None:
                force, moment = self._config.gravity.contact(force, moment, self._config.down)
            force, moment = self._config.mount.to_gel(force, moment)
        if samples:
            journal.append("force", {}, time_ns=times, force_n=force, moment_nmm=moment, out_of_range=beyond)
            self._alarm = "the force sensor is out of its range: release" if beyond[-1] else ""
        return times, force

    def _watch(self, times: np.ndarray, looked: Seq[list[Sample]]) -> None:
        """Raise the alarm if the pictures go on and the force does not: the prompt is that of its last reading."""
        self._force_ns = int(times[-1]) if len(times) else self._force_ns
        seen_ns = max((samples[-1].host_time_ns for samples in looked if samples), default=0)
        if self._force_ns is not None and seen_ns - self._force_ns > _SILENT_S * NS_PER_S:
            self._alarm = "the force sensor is silent: release, and look at its connection"

    def _start(self, key: ContactKey, stage: ContactStage) -> dict[str, Any]:
        return {
            "key": dataclasses.asdict(key),
            "streams": [stream.begin() for stream in self._streams],
            "force_sensor": None if self._force is None else dataclasses.asdict(self._force.identity),
            "target_n": stage.force_n,
            "contact_region_px": self._region_px,
        }

    def _backgrounds(self) -> dict[str, np.ndarray]:
        pictures = {f"background_{i}": stream.background for i, stream in enumerate(self._streams)}
        return {name: picture for name, picture in pictures.items() if picture is not None}

    def _counts(self) -> dict[str, Any]:
        force = {} if self._force is None else {"force": dataclasses.asdict(self._force.counts)}
        return {stream.sensor: dataclasses.asdict(stream.feed.counts) for stream in self._streams} | force

    def _status(self, stage: ContactStage, advice: Advice) -> Status:
        return Status(
            stage=stage,
            advice=advice,
            streams=tuple(stream.status() for stream in self._streams),
            force=None if self._force is None else self._force.counts,
            alarm=self._alarm or next(filter(None, (stream.alarm for stream in self._streams)), ""),
        )


def _forget_before(then: tuple[int, Phase | None, int], journal: JournalWriter, begin: Callable[[], None]) -> None:
    """Keep of a contact what was journaled since a time, at which it had a phase and the journal a size."""
    time_ns, phase, size = then
    with journal.only_since(size):
        begin()
        if phase is not None:
            journal.append("phase", {"time_ns": time_ns, "phase": int(phase)})


def _stacked(samples: list[Sample], name: str, sensor: str, lacking: float = np.nan) -> np.ndarray:
    """A vector of every sample of a sensor, float64 [n, 3]; `lacking` where one has none.

    Raises:
      DeviceError: an array of another shape, or of no numbers.
    """
    found = [np.asarray(s.arrays.get(name, np.full(3, lacking))) for s in samples]
    for x in found:
        if x.shape != (3,) or x.dtype.kind not in "fiu":
            what = f"{name} of {sensor} has shape {x.shape}, type {x.dtype}"
            raise DeviceError(f"{what}: must be 3 numbers; correct its driver")
    return np.array(found, np.float64).reshape(-1, 3)
