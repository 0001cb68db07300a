"""From the journal of one contact to the sequences that are stored, one per sensor.

All their times are on one clock: that of the host, less what each sensor is known to be stamped late by.
"""

import collections
import dataclasses
import itertools
import pathlib
from collections.abc import Mapping
from collections.abc import Sequence as Seq
from typing import Any

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.codec import FIELDS, LARGEST
from sensors_io.errors import MALFORMED, UserError
from sensors_io.force import ForceError, at_frames
from sensors_io.recording.journal import JournalEntry, JournalError, read_journal
from sensors_io.schema import FRAME_ARRAYS, ContactKey, Flag, Phase, Sequence

_GAP_PERIODS = 1.5  # between two frames: one is missing
_GAP_STEPS = 3.0  # of the usual size, where the period is unknown
_SILENT_S = 1.0  # while its counter goes on: a device is taken as lost sooner
_UNSEEN_S = 0.3  # without a frame in a phase, or at either end of a contact: a link is not so late
_UNSEEN_PERIODS = 3  # of a slow sensor
_INT64 = np.iinfo(np.int64)
_KINDS = ("start", "phase", "frame", "force", "end")
_MADE_HERE = ("frames", "host_time_ns", "device_time_ns", "force_time_ns", "target_force_n", "phase", "flags")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Assembled:
    """Contents of a journal.

    Args:
      sequences: one of each sensor that gave a frame, in the order of the session.
      backgrounds: the gel at rest before the contact, or else after it, uint8 [H, W, 3] by sensor.
      complete: whether the contact was, and every sensor that gave frames saw most of each of its phases.
    """

    sequences: tuple[Sequence, ...]
    backgrounds: Mapping[str, np.ndarray]
    complete: bool


def assemble(path: pathlib.Path) -> Assembled | None:
    """The sequences of a journal, also of one whose process was killed; `None` if it holds no frame.

    Raises:
      JournalError: a damaged journal, one that does not begin with a contact, or one of an earlier version.
    """
    entries = read_journal(path)
    if not entries:
        return None  # killed before or in its very first entry
    if entries[0].kind != "start":
        raise JournalError(f"{path} begins with {entries[0].kind!r}: must be 'start'; it is no contact's journal")
    start = entries[0].plain
    if "streams" not in start:
        raise JournalError(f"{path} was written by an earlier version: bring it in with that one, or move it away")
    try:
        return _assembled(start, entries)
    except UserError:
        raise
    except MALFORMED as error:
        raise JournalError(
            f"{path} holds entries of another layout ({error!r}): move it away, or bring it in with the version that "
            "wrote it"
        ) from error


def _assembled(start: Mapping[str, Any], entries: Seq[JournalEntry]) -> Assembled | None:
    streams = range(len(start["streams"]))
    for e in entries:  # one that nothing reads would be gone with its journal
        if e.kind not in _KINDS or (e.kind == "frame" and e.plain["stream"] not in streams):
            raise ValueError(f"{e.kind} of stream {e.plain.get('stream')!r}")
    ends = [e for e in entries if e.kind == "end"]
    end = ends[0].plain if ends else None
    frames = [[e for e in entries if e.kind == "frame" and e.plain["stream"] == i] for i in streams]
    if not any(frames):
        return None
    if end and end["complete"]:
        frames[0] = _with_force(frames[0], entries)
    backgrounds = _backgrounds(start, [entries[0], *ends])
    shared = _Shared(
        start=start,
        end=end,
        entries=entries,
        span_ns=_span_ns(entries),
        backgrounds=backgrounds,
        absent=tuple(s["identity"]["sensor"] for s, f in zip(start["streams"], frames, strict=True) if not f),
    )
    streams_frames = zip(start["streams"], frames, strict=True)
    seen = [_sees_all(_until_ns(shared.span_ns, stream), entries, own, stream) for stream, own in streams_frames if own]
    return Assembled(
        sequences=tuple(shared.sequence(i, own) for i, own in enumerate(frames) if own),
        backgrounds=backgrounds,
        complete=bool(end and end["complete"]) and all(seen),
    )


def _span_ns(entries: Seq[JournalEntry]) -> tuple[int, int]:
    """First and last moment of a contact: of its phases, since frames may be older, and of all that was measured."""
    phases = [e.plain["time_ns"] for e in entries if e.kind == "phase"]
    frames = [e.plain["time_ns"] for e in entries if e.kind == "frame"]
    force = [int(e.arrays["time_ns"][-1]) for e in entries if e.kind == "force"]
    return min(phases or frames), max(phases + frames + force)


def _sees_all(until_ns: int, entries: Seq[JournalEntry], frames: Seq[JournalEntry], stream: Mapping[str, Any]) -> bool:
    """False if the frames of a sensor leave out most of a phase from the first touch on.

    What was after `until_ns` is left out of account.
    """
    phases = [(e.plain["time_ns"], e.plain["phase"]) for e in entries if e.kind == "phase"]
    touched = list(itertools.dropwhile(lambda begun: begun[1] == Phase.APPROACH, phases))
    times = np.sort([e.plain["time_ns"] for e in frames])
    unseen_ns = _unseen_s(stream["identity"]["period_s"], times) * NS_PER_S
    begun_ns = [min(time_ns, until_ns) for time_ns, _ in touched]
    for since_ns, to_ns in itertools.pairwise([*begun_ns, until_ns]):
        edges = np.array([min(since_ns, times[0]), *times, max(to_ns, times[-1])])
        gone = np.diff(edges) > unseen_ns
        within_ns = np.minimum(edges[1:], to_ns) - np.maximum(edges[:-1], since_ns)
        if np.any(gone & (within_ns > (to_ns - since_ns) / 2)):
            return False
    return True


def _until_ns(span_ns: tuple[int, int], stream: Mapping[str, Any]) -> int:
    """Last moment of a contact that a sensor could show: what is stamped late came when it was over."""
    return span_ns[1] - max(0, round(stream["late_s"] * NS_PER_S))


def _unseen_s(period_s: float | None, time_ns: np.ndarray) -> float:
    """Seconds without a frame that no late link explains; the usual step may be longer than the stated period."""
    step_s = float(np.median(np.diff(np.sort(time_ns)))) / NS_PER_S if len(time_ns) > 1 else 0.0
    return max(_UNSEEN_S, _UNSEEN_PERIODS * max(period_s or 0.0, step_s))


def _with_force(frames: list[JournalEntry], entries: Seq[JournalEntry]) -> list[JournalEntry]:
    """Frames of a complete contact less those before the first reading of the force sensor and after the last."""
    times = [e.arrays["time_ns"] for e in entries if e.kind == "force"]
    if not times:
        return frames
    inside = [i for i, f in enumerate(frames) if times[0][0] <= f.plain["time_ns"] <= times[-1][-1]]
    return frames[inside[0] : inside[-1] + 1] if inside else frames


def background_name(key: ContactKey, sensor: str) -> pathlib.Path:
    """Path of the picture of the gel at rest, next to the records."""
    return pathlib.Path("backgrounds", f"{key.object_id}-{key.site}-{key.motion}-{key.trial}-{sensor}.png")


def _backgrounds(start: Mapping[str, Any], entries: Seq[JournalEntry]) -> dict[str, np.ndarray]:
    """The first picture that the entries hold of each stream."""
    found: dict[str, np.ndarray] = {}
    for i, stream in enumerate(start["streams"]):
        pictures = [e.arrays[f"background_{i}"] for e in entries if f"background_{i}" in e.arrays]
        for picture in pictures[:1]:
            if picture.dtype != np.uint8 or picture.shape[2:] != (3,) or not picture.size:
                raise ValueError(f"background_{i} is {picture.dtype}{list(picture.shape)}: must be uint8 [H, W, 3]")
            found[stream["identity"]["sensor"]] = picture
    return found


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Shared:
    """Values that all streams of a contact share."""

    start: Mapping[str, Any]
    end: Mapping[str, Any] | None
    entries: Seq[JournalEntry]
    span_ns: tuple[int, int]
    backgrounds: Mapping[str, np.ndarray]
    absent: tuple[str, ...]

    def sequence(self, number: int, frames: Seq[JournalEntry]) -> Sequence:
        """That of one stream."""
        start, stream = self.start, self.start["streams"][number]
        identity, key = stream["identity"], ContactKey(**start["key"])
        given = len(frames)
        frames = _alike(frames)
        time_ns = np.array([e.plain["time_ns"] for e in frames], np.int64)
        own = _own_arrays(frames)
        gaps = _gaps(time_ns, [e.plain["index"] for e in frames], identity["period_s"])
        gaps |= time_ns < np.maximum.accumulate(time_ns)  # by a wrong stamp
        silent_s = self._silent_s(time_ns, stream)
        gaps[0] |= silent_s[0] > 0
        gaps[-1] |= silent_s[1] > 0
        force = _Force.at(time_ns, self.entries if number == 0 else ())
        flags = np.where(gaps | force.uncovered, np.uint32(Flag.TIME_GAP), np.uint32(0))
        arrays: dict[str, Any] = {**own, **force.arrays}
        broken = _mend(arrays)
        incomplete = np.any([force.out_of_range, *broken.values()], axis=0)
        flags |= np.where(incomplete, np.uint32(Flag.INCOMPLETE), np.uint32(0))
        if "flags" in frames[0].arrays:  # of records that are replayed
            flags |= np.stack([e.arrays["flags"] for e in frames]).astype(np.uint32)
        device = [e.plain["device_time_ns"] for e in frames]
        timed = all(t is not None and _INT64.min <= t <= _INT64.max for t in device)
        pictures = [e.arrays["frame"] for e in frames if "frame" in e.arrays]
        region = start["contact_region_px"]
        return Sequence(
            key=key,
            sensor=identity["sensor"],
            serial=identity["serial"],
            camera={
                "settings": identity["settings"],
                "recording": self._recording(stream, key, force.residual_n)
                | {
                    "left_out": given - len(frames),
                    "without_force": sum(e.kind == "frame" and e.plain["stream"] == number for e in self.entries)
                    - given,
                    "broken": {name: int(rows.sum()) for name, rows in broken.items()},
                    "silent_s": silent_s,
                },
            },
            contact_region_px=None if region is None else tuple(region),
            mm_per_px=identity["mm_per_px"],
            frames=np.stack(pictures) if len(pictures) == len(frames) else None,
            host_time_ns=time_ns,
            device_time_ns=np.array(device, np.int64) if timed else None,
            target_force_n=np.full(len(frames), start["target_n"], np.float32),
            phase=_phases(self.entries, time_ns),
            flags=flags,
            **arrays,
        )

    def _silent_s(self, time_ns: np.ndarray, stream: Mapping[str, Any]) -> list[float]:
        """Seconds without a frame at the beginning and the end of a contact; 0 where that is no gap."""
        silent_ns = (time_ns.min() - self.span_ns[0], _until_ns(self.span_ns, stream) - time_ns.max())
        unseen_s = _unseen_s(stream["identity"]["period_s"], time_ns)
        return [s if s > unseen_s else 0.0 for s in (float(ns) / NS_PER_S for ns in silent_ns)]

    def _recording(self, stream: Mapping[str, Any], key: ContactKey, residual_n: float | None) -> dict[str, Any]:
        """Settings of the recording, as JSON."""
        sensor = stream["identity"]["sensor"]
        together = [s["identity"]["sensor"] for s in self.start["streams"]]
        return {
            "end": self.end,
            "torn": self.end is None,
            "sensors": together,
            "absent": list(self.absent),
            "force_sensor": self.start["force_sensor"],
            "force_residual_n": residual_n,
            "late_s": stream["late_s"],
            "reader": stream["reader"],
            "drift": stream["drift"],
            "background": background_name(key, sensor).as_posix() if sensor in self.backgrounds else None,
        }


def _alike(frames: Seq[JournalEntry]) -> Seq[JournalEntry]:
    """Frames whose arrays have the names, shapes and types of most: a device that changes them breaks its protocol."""
    kinds = [tuple((name, a.dtype.str, a.shape) for name, a in sorted(e.arrays.items())) for e in frames]
    (usual, _), *_ = collections.Counter(kinds).most_common(1)
    return [e for e, kind in zip(frames, kinds, strict=True) if kind == usual]


def _mend(arrays: dict[str, Any]) -> dict[str, np.ndarray]:
    """Put 0 where a value is not finite, or too large for the records; fields are not `valid` there.

    Returns:
      Array → rows with such a value, bool [N]; an array without any is left out.
    """
    broken = {}
    for name in [name for name in arrays if name in LARGEST]:
        value = arrays[name]
        good = np.isfinite(value) & (np.abs(value) <= LARGEST[name])
        if good.all():
            continue
        arrays[name] = np.where(good, value, np.float32(0))
        broken[name] = ~good.reshape(len(value), -1).all(1)
        if name in FIELDS:
            point = good.all(-1) if value.ndim == 4 else good
            arrays["valid"] = arrays.get("valid", True) & point
    return broken


def _own_arrays(frames: Seq[JournalEntry]) -> dict[str, np.ndarray]:
    """Arrays that the sensor itself gives besides pictures, stacked."""
    names = [n for n in frames[0].arrays if n in FRAME_ARRAYS and n not in _MADE_HERE]
    return {n: np.stack([e.arrays[n] for e in frames]).astype(FRAME_ARRAYS[n].dtype) for n in names}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Force:
    """Readings of the force sensor at the frames; no array where there is none."""

    arrays: Mapping[str, np.ndarray]
    uncovered: np.ndarray
    out_of_range: np.ndarray
    residual_n: float | None

    @classmethod
    def at(cls, time_ns: np.ndarray, entries: Seq[JournalEntry]) -> "_Force":
        """Force and moment, frames that no reading covers or a reading out of range, the residual of interpolation."""
        batches = [e.arrays for e in entries if e.kind == "force"]
        nowhere = np.zeros(len(time_ns), bool)
        if not batches:
            return cls(arrays={}, uncovered=nowhere, out_of_range=nowhere, residual_n=None)
        time, force, moment, beyond = (
            np.concatenate([b[name] for b in batches]) for name in ("time_ns", "force_n", "moment_nmm", "out_of_range")
        )
        time, order = np.unique(time, return_index=True)  # records of a datagram that was held up overlap the next
        try:
            with np.errstate(invalid="ignore"):  # readings that are not finite: `_mend` flags their frames
                found = at_frames(time_ns, time, np.concatenate([force, moment], -1)[order].astype(np.float64))
        except ForceError:  # killed before three readings: no force, and every frame says so
            return cls(arrays={}, uncovered=~nowhere, out_of_range=nowhere, residual_n=None)
        after = np.clip(np.searchsorted(time, time_ns), 1, len(time) - 1)
        values = found.value.astype(np.float32)
        return cls(
            arrays={"force_n": values[:, :3], "moment_nmm": values[:, 3:], "force_time_ns": found.time_ns},
            uncovered=~found.covered,
            out_of_range=beyond[order][after] | beyond[order][after - 1],
            residual_n=float(found.residual[np.isfinite(found.residual)].max(initial=0.0)),
        )


def _gaps(time_ns: np.ndarray, index: Seq[int | None], period_s: float | None) -> np.ndarray:
    """Frames at which the counter does not go on by one, or, without one, that come too late for the period.

    Where that is unknown, too late is three times the usual step, as times may be uneven; with a counter, it is so
    after a second of silence too, for one that begins anew may be just at the next number.
    """
    counter, steps = [i for i in index if i is not None], np.diff(time_ns, prepend=time_ns[0])
    later = steps[1:] if len(steps) > 1 else steps
    if len(counter) == len(index):
        latest = np.maximum.accumulate(time_ns)  # behind one wrong stamp there is no silence
        silent = np.diff(latest, prepend=latest[0]) > max(_SILENT_S * NS_PER_S, _GAP_STEPS * np.median(later))
        return silent | (np.diff(np.array(counter, np.int64), prepend=counter[0] - 1) != 1)
    if period_s is None:
        return steps > _GAP_STEPS * max(np.median(later), np.mean(later))  # the median of bursts is too short
    return steps > _GAP_PERIODS * period_s * NS_PER_S


def _phases(entries: Seq[JournalEntry], time_ns: np.ndarray) -> np.ndarray:
    """Phase under way at each frame."""
    changes = [(e.plain["time_ns"], e.plain["phase"]) for e in entries if e.kind == "phase"]
    if not changes:
        return np.zeros(len(time_ns), np.uint8)
    times, phases = (np.array(column) for column in zip(*changes, strict=True))
    return phases[np.clip(np.searchsorted(times, time_ns, "right") - 1, 0, None)].astype(np.uint8)
