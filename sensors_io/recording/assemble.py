"""From the journal of one contact to the sequence that is stored."""

import dataclasses
import pathlib
from collections.abc import Mapping
from collections.abc import Sequence as Seq
from typing import Any

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.force import ForceError, at_frames
from sensors_io.recording.journal import Entry, JournalError, read_journal
from sensors_io.schema import FRAME_ARRAYS, ContactKey, Flag, Sequence

_GAP_PERIODS = 1.5  # between two frames: one is missing
_MADE_HERE = ("frames", "host_time_ns", "device_time_ns", "force_time_ns", "target_force_n", "phase", "flags")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Assembled:
    """What a journal held: the sequence, whether the contact was complete, bytes of an entry that was cut off."""

    sequence: Sequence
    complete: bool
    torn_bytes: int


def assemble(path: pathlib.Path, *, trial: int | None = None) -> Assembled | None:
    """The sequence of a journal, also of one whose process was killed; `None` if it holds no frame.

    Args:
      path: of the journal.
      trial: replaces the one that the journal was begun for.

    Raises:
      JournalError: a damaged journal, or one that does not begin with a contact.
    """
    entries, torn = read_journal(path)
    if not entries or entries[0].kind != "start":
        if torn or not entries:
            return None  # killed in its very first entry
        raise JournalError(f"{path} begins with {entries[0].kind!r}: must be 'start'; it is no contact's journal")
    frames = [e for e in entries if e.kind == "frame"]
    if not frames:
        return None
    ends = [e.plain for e in entries if e.kind == "end"]
    sequence = _sequence(entries[0].plain, entries, frames, ends[0] if ends else None, trial)
    return Assembled(sequence=sequence, complete=bool(ends and ends[0]["complete"]), torn_bytes=torn)


def _sequence(
    start: Mapping[str, Any], entries: Seq[Entry], frames: Seq[Entry], end: Mapping[str, Any] | None, trial: int | None
) -> Sequence:
    time_ns = np.array([e.plain["time_ns"] for e in frames], np.int64)
    own = {
        n: np.stack([e.arrays[n] for e in frames])
        for n in frames[0].arrays
        if n in FRAME_ARRAYS and n not in _MADE_HERE
    }
    own = {name: a.astype(FRAME_ARRAYS[name].dtype) for name, a in own.items()}
    gaps = _gaps(time_ns, [e.plain["index"] for e in frames], start["identity"]["period_s"])
    measured, uncovered, residual_n = _measured(entries, time_ns, start)
    flags = np.where(gaps | uncovered, np.uint32(Flag.TIME_GAP), np.uint32(0))
    device = [e.plain["device_time_ns"] for e in frames]
    pictures = [e.arrays["frame"] for e in frames if "frame" in e.arrays]
    session = {
        "end": end,
        "torn": end is None,
        "force_residual_n": residual_n,
        "lag_s": start["lag_s"],
        "reader": start["reader"],
    }
    arrays: dict[str, Any] = own | measured
    key = dict(start["key"]) | ({} if trial is None else {"trial": trial})
    return Sequence(
        key=ContactKey(**key),
        sensor=start["identity"]["sensor"],
        serial=start["identity"]["serial"],
        camera={"settings": start["identity"]["settings"], "recording": session},
        mm_per_px=start["mm_per_px"],
        frames=np.stack(pictures) if len(pictures) == len(frames) else None,
        host_time_ns=time_ns,
        device_time_ns=None if None in device else np.array(device, np.int64),
        target_force_n=np.full(len(frames), start["target_n"], np.float32),
        phase=_phases(entries, time_ns),
        flags=flags,
        **arrays,
    )


def _measured(
    entries: Seq[Entry], time_ns: np.ndarray, start: Mapping[str, Any]
) -> tuple[dict[str, np.ndarray], np.ndarray, float | None]:
    """Force and moment at the frames, which frames they do not cover, and the largest residual of interpolation."""
    batches = [e.arrays for e in entries if e.kind == "force"]
    if not batches:
        return {}, np.zeros(len(time_ns), bool), None
    time, force, moment = (np.concatenate([b[name] for b in batches]) for name in ("time_ns", "force_n", "moment_nmm"))
    order = np.flatnonzero(np.diff(time, prepend=time[0] - 1) > 0)
    try:
        found = at_frames(
            time_ns, time[order], np.concatenate([force, moment], -1)[order].astype(np.float64), lag_s=start["lag_s"]
        )
    except ForceError:
        return {}, np.ones(len(time_ns), bool), None  # killed before three readings: no force, and every frame says so
    values = found.value.astype(np.float32)
    measured = {"force_n": values[:, :3], "moment_nmm": values[:, 3:], "force_time_ns": found.time_ns}
    return measured, ~found.covered, float(found.residual.max())


def _gaps(time_ns: np.ndarray, index: Seq[int | None], period_s: float | None) -> np.ndarray:
    """Frames before which at least one is missing, by the counter or else by the period."""
    counter = [i for i in index if i is not None]
    if len(counter) == len(index):
        return np.diff(np.array(counter, np.int64), prepend=counter[0] - 1) > 1
    if period_s is None:
        return np.zeros(len(time_ns), bool)
    return np.diff(time_ns, prepend=time_ns[0]) > _GAP_PERIODS * period_s * NS_PER_S


def _phases(entries: Seq[Entry], time_ns: np.ndarray) -> np.ndarray:
    """Phase under way at each frame."""
    changes = [(e.plain["time_ns"], e.plain["phase"]) for e in entries if e.kind == "phase"]
    if not changes:
        return np.zeros(len(time_ns), np.uint8)
    times, phases = (np.array(column) for column in zip(*changes, strict=True))
    return phases[np.clip(np.searchsorted(times, time_ns, "right") - 1, 0, None)].astype(np.uint8)
